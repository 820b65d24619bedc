"""`python -m jaxouter.check`: does a plant keep the contract, and what is it like."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxouter import cli, plants
from jaxouter.evaluation import figures
from jaxouter.loop import identify, log, trust
from jaxouter.plants import Plant, contract, simulate
from jaxouter.plants.simulators import PlantOptions
from jaxouter.plants.sources import add

STEPS = (0.1, 0.25, 0.5)  # moves of r~ up from the middle of its range, as shares of it, and as many down
MOVED = 1e-3  # of the largest response: y that has moved so far has begun to


@dataclass(frozen=True)
class Options:
    """Test whether a plant of your own keeps the contract, and show how it responds to r~.

    Exit status 1 where it does not. The picture shows y after r~ has moved up or down from the middle of its range.
    Of a log it is told, and shown, how far its models can be trusted.
    """

    plant: Annotated[str, tyro.conf.Positional]
    """FILE.py:NAME, the entry point of an installed package, gym:ID, fmu:FILE, log:FILE, pitch or heaters."""
    figure: Path | None = None
    """File for the picture; default: step-response.png, or log.png for a log."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the trace of an error too."""
    plant_options: Annotated[PlantOptions, tyro.conf.arg(name="")] = field(default_factory=PlantOptions)
    """What a plant gym:ID, fmu:FILE or log:FILE does not say itself."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors(arguments):
        options = tyro.cli(Options, prog="python -m jaxouter.check", args=arguments)
        plant, params = plants.make(add(options.plant, options.plant_options))
        cli.use_compilation_cache()
        figure = options.figure or Path("log.png" if plant.identified else "step-response.png")
        if not figure.resolve().parent.is_dir():
            raise ValueError(f"--figure is {figure}; its folder does not exist")
        found = [("shapes and types", None), *contract.behaviour(plant, params)]
        cli.table(f"{plant.name}: the contract", ["what", "is"], [[what, wrong or "kept"] for what, wrong in found])
        if plant.identified:
            picture = log_report(plant, options.plant.partition(":")[2], figure)
        else:
            picture = response_report(plant, params, figure)
    print(f"figure: {picture}")
    if any(wrong for _, wrong in found):
        raise SystemExit(1)


def log_report(plant: Plant, path: str, figure: Path) -> Path:
    """How far the log of this plant can be trusted, told and drawn."""
    told = trust.report(*log.identified(path))
    rows = [list(row) for row in trust.table(told, plant.y_unit, plant.time_unit)]
    cli.table(f"{plant.name}: how far the log can be trusted", ["what", "is"], rows)
    for warning in told.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return figures.log_report(figure, told, plant.name, plant.y_unit, plant.time_unit)


def response_report(plant: Plant, params: object, figure: Path) -> Path:
    """How the plant responds to r~, told and drawn."""
    gain, offset = identify.dc_gain(plant, params, jax.random.key(0))
    moves, responses = step_responses(plant, params)
    reached = sorted(float(offset + gain * end) for end in plant.r_tilde_bounds)
    lines = [
        ("DC gain", f"{float(gain):.3g}, y = {float(offset):.3g} {plant.y_unit} at r~ = 0"),
        ("y within reach", f"{reached[0]:.3g} to {reached[1]:.3g} {plant.y_unit}"),
        ("set-points", f"{plant.setpoint_range[0]:.3g} to {plant.setpoint_range[1]:.3g} {plant.y_unit}"),
        ("dead time", f"{dead_time(responses)} control steps of {plant.control_step:g} {plant.time_unit}"),
    ]
    cli.table(f"{plant.name}: how it responds", ["what", "is"], [list(line) for line in lines])
    if reached[0] > plant.setpoint_range[0] or reached[1] < plant.setpoint_range[1]:
        print("warning: no r~ within its bounds holds y at every set-point", file=sys.stderr)
    return figures.step_responses(figure, plant, moves, responses)


def step_responses(plant: Plant, params: object) -> tuple[np.ndarray, np.ndarray]:
    """Moves of r~ from the middle of its range (n,), and what y does more than without them (n, T); the same noise."""
    low, high = plant.r_tilde_bounds
    moves = (high - low) * np.array([-share for share in reversed(STEPS)] + list(STEPS))
    key = jax.random.key(0)
    state = plant.init(key, params)
    levels = (low + high) / 2 + jnp.asarray([0.0, *moves], float)
    y = [np.asarray(simulate(plant, params, jnp.full(plant.episode_steps, level), key, state)) for level in levels]
    return moves, np.stack(y[1:]) - y[0]


def dead_time(responses: np.ndarray) -> int:
    """Control steps before any response (n, T) begins, beyond the one of sampling."""
    begun = np.abs(responses).max(0) > MOVED * np.abs(responses).max()
    return int(begun.argmax())


if __name__ == "__main__":
    cli.run(main)
