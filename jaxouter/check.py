"""`python -m jaxouter.check`: test whether a plant implements the interface, and show how it responds."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxouter import cli, plants
from jaxouter.evaluation import figures
from jaxouter.evaluation.cache import use_compilation_cache
from jaxouter.evaluation.policies import counter
from jaxouter.identification import recorded_data, steady_state, validation
from jaxouter.identification.dynamics import exploration
from jaxouter.identification.steady_state import LEVELS
from jaxouter.plants import Plant, interface, simulate
from jaxouter.plants.base import in_words
from jaxouter.plants.registry import add
from jaxouter.plants.simulators import PlantOptions
from jaxouter.progress import showing
from jaxouter.terminal import optional
from jaxouter.training.choice import choose
from jaxouter.training.config import preset

STEPS = (0.1, 0.25, 0.5)  # steps of r~ up and down from the middle of its range, as shares of the range
MOVED = 1e-3  # y has begun to respond at this share of the largest response soon after
SOON = 10  # least control steps after the start that count as soon


@dataclass(frozen=True)
class Options:
    """Test whether your own plant implements the interface, and show how it responds to r~.

    The exit status is 1 if it does not. For recorded data (log:FILE) the identified models are validated instead.
    --figure draws the result: step responses of y from the middle of the range of r~, or the validation.
    """

    plant: Annotated[str, tyro.conf.Positional]
    """Plant: FILE.py:NAME, gym:ID, fmu:FILE, log:FILE, an installed package's entry point, pitch or heaters."""
    set: cli.Settings = ()
    """Parameters of the plant, such as --set tau 0.7 or --set W 0.1 0.003 -0.01."""
    figure: Path | None = None
    """File for the figure; default: no figure."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""
    plant_options: Annotated[PlantOptions, tyro.conf.arg(name="")] = field(default_factory=PlantOptions)
    """What a plant gym:ID, fmu:FILE or log:FILE does not declare itself."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors(arguments), ExitStack() as stack:
        options = tyro.cli(Options, prog=cli.program("check"), args=arguments)
        figure = options.figure
        if figure is not None and not figure.resolve().parent.is_dir():
            raise ValueError(f"--figure is {figure}; its folder does not exist")
        progress = stack.enter_context(showing(True))
        plant, params = plants.make(add(options.plant, options.plant_options, cli.settings(options.set)))
        use_compilation_cache()
        slow = counter([plant])
        progress.phase("checking", interface.behaviour_steps(plant) if slow else 0, counter=slow)
        found = [("shapes and types", None), *interface.behaviour(plant, params)]
        rows = [[what, wrong or "implemented"] for what, wrong in found]
        cli.table(f"{plant.name}: the interface", ["what", "is"], rows)
        if plant.identified:
            progress.phase("validating", 0)
            draw = validation_report(plant, options.plant.partition(":")[2])
        else:
            steps = exploration(plant) + (LEVELS + 1 + 2 * len(STEPS)) * plant.episode_steps
            progress.phase("responding", steps if slow else 0, counter=slow)
            draw = response_report(plant, params)
        if figure is not None:
            progress.phase("drawing", 0)
            with optional("figure"):
                progress.print(f"figure: {draw(figure)}")
    if any(wrong for _, wrong in found):
        raise SystemExit(1)


def validation_report(plant: Plant, path: str) -> Callable[[Path], Path]:
    """Validate the models of recorded data; returns a function that draws the validation."""
    found = validation.validate(*recorded_data.identified(path))
    rows = [list(row) for row in validation.table(found, plant.y_unit, plant.time_unit)]
    cli.table(f"{plant.name}: model validation", ["what", "is"], rows)
    for warning in found.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return lambda path: figures.save(figures.validation_figure(found, plant.name, plant.y_unit, plant.time_unit), path)


def response_report(plant: Plant, params: object) -> Callable[[Path], Path]:
    """Show how the plant responds to r~; returns a function that draws it."""
    found = steady_state.dc_gain(plant, params, jax.random.key(0))
    moves, responses = step_responses(plant, params)
    choice = choose(preset(plant.name))
    lines = [
        *steady(plant, found),
        ("set-points", f"{plant.setpoint_range[0]:.3g} to {plant.setpoint_range[1]:.3g}{in_words(plant.y_unit)}"),
        ("dead time", f"{dead_time(responses)} control steps of {plant.control_step:g} {plant.time_unit}"),
        *([] if choice.said is None else [("training", choice.said)]),
    ]
    cli.table(f"{plant.name}: how it responds", ["what", "is"], [list(line) for line in lines])
    low, high = within_reach(plant, found)
    if found.unsettled is None and (low > plant.setpoint_range[0] or high < plant.setpoint_range[1]):
        print("warning: no r~ within its bounds holds y at every set-point", file=sys.stderr)
    for warning in choice.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return lambda path: figures.save(figures.step_responses(plant, moves, responses), path)


def within_reach(plant: Plant, found: steady_state.DcGain) -> list[float]:
    """Least and greatest steady-state y within the bounds of r~, by the DC gain."""
    return sorted(float(found.offset + found.gain * end) for end in plant.r_tilde_bounds)


def steady(plant: Plant, found: steady_state.DcGain) -> list[tuple[str, str]]:
    """Rows on the steady state of y, or on what y does instead of settling."""
    unit = in_words(plant.y_unit)
    if found.unsettled is not None:
        change = f"by {found.rate:.3g}{unit} a control step for each 1{unit} of r~ beyond {found.still:.3g}{unit}"
        return [("DC gain", f"none, {found.unsettled.partition(': ')[2]}"), ("y changes late", change)]
    low, high = within_reach(plant, found)
    return [
        ("DC gain", f"{float(found.gain):.3g}, y = {float(found.offset):.3g}{unit} at r~ = 0"),
        ("y within reach", f"{low:.3g} to {high:.3g}{unit}"),
    ]


def step_responses(plant: Plant, params: object) -> tuple[np.ndarray, np.ndarray]:
    """Steps of r~ from the middle of its range (n,), and the change of y they cause (n, T), under the same noise."""
    low, high = plant.r_tilde_bounds
    moves = (high - low) * np.array([-share for share in reversed(STEPS)] + list(STEPS))
    key = jax.random.key(0)
    state = plant.init(key, params)
    levels = (low + high) / 2 + jnp.asarray([0.0, *moves], float)
    y = [np.asarray(simulate(plant, params, jnp.full(plant.episode_steps, level), key, state)) for level in levels]
    return moves, np.stack(y[1:]) - y[0]


def dead_time(responses: np.ndarray) -> int:
    """Control steps before any response (n, T) begins, in addition to the one of sampling.

    A response has begun once it is not small compared with its value at twice the time, as it may grow without bound.
    """
    largest = np.maximum.accumulate(np.abs(responses).max(0))
    soon = np.minimum(2 * np.arange(len(largest)) + SOON, len(largest) - 1)
    return int(np.argmax(largest > MOVED * largest[soon]))


if __name__ == "__main__":
    cli.run(main)
