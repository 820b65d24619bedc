"""Our learners side by side, each from scratch on the static prefilter: MAE over wall time and environment steps.

    python benchmarks/learners.py                    # pitch, five seeds of each; an hour on 2 cores
    python benchmarks/learners.py --plant heaters
    python benchmarks/learners.py --peers            # pitch alone: also those of stable-baselines3 and sbx; hours

Each run is a process of its own that begins with nothing cached, see `time_to_quality.py`; its time counts from its
start, imports and compilation included. `ddpg` learns without pairs here, as the others do; `ddpg, then pairs` is the
preset `scratch`. `r not held` shows what holding the set-point is worth to a learner of either kind. Training never
sees the scenario of the MAE. Table, figure and numbers go to results/learners-PLANT.
"""

from __future__ import annotations

import json
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import tyro
from tables import machine, made, table
from time_to_quality import NEAR, PEERS, Point, cell, limit, of_peers, ours, peers, reached

from jaxouter import agents, cli
from jaxouter.evaluation import figures, scenarios
from jaxouter.evaluation.drawing import Figure
from jaxouter.evaluation.policies import baseline, evaluate_on
from jaxouter.training.run import write_json

RESULTS = Path(__file__).parent / "results"
SCENARIO = {"pitch": "pitch/paper", "heaters": "heaters/paper-4"}
LEVELS = ("static", "lq")
POINTS = 200  # of a curve
HIGHEST = 1.8  # times the limit, in the figure
NOT_HELD = ", r not held"


def runs(name: str) -> tuple[str, ...]:
    """Options of the command for a learner."""
    return ("--preset", "scratch", "--agent", name, "--pairs.rounds", "0")


def curve(of_seeds: list[list[Point]], by: str) -> tuple[np.ndarray, np.ndarray]:
    """Times or steps (n,) from when all seeds have a first MAE, and the newest MAE of each then, (seeds, n)."""
    first = max(points[0][by] for points in of_seeds)
    last = min(points[-1][by] for points in of_seeds)
    at = np.geomspace(first, max(last, first), POINTS)
    newest = [np.searchsorted([point[by] for point in points], at, side="right") - 1 for points in of_seeds]
    return at, np.array([[points[i]["mae"] for i in rows] for points, rows in zip(of_seeds, newest, strict=True)])


def draw(found: dict[str, list[list[Point]]], levels: dict[str, float], scenario: str, unit: str) -> Figure:
    """MAE over wall time and over environment steps: medians, and from the least to the greatest seed."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    both = figure.subplots(1, 2, sharey=True)
    for axes, by, what in zip(both, ("seconds", "steps"), ("wall time, s", "environment steps"), strict=True):
        for i, (name, of_seeds) in enumerate(found.items()):
            at, maes = curve(of_seeds, by)
            as_came = name.endswith(NOT_HELD)
            color = f"C{list(found).index(name.removesuffix(NOT_HELD))}" if as_came else f"C{i}"
            axes.plot(at, np.median(maes, 0), lw=1.6, color=color, ls=":" if as_came else "-", label=name)
            if not as_came:
                axes.fill_between(at, maes.min(0), maes.max(0), color=color, alpha=0.1, lw=0)
        for (name, value), style in zip(levels.items(), cycle((":", "--", "-.")), strict=False):
            axes.axhline(value, color=figures.INNER, ls=style, lw=1.2, label=f"{name} {value:.3g}")
        axes.set_xscale("log")
        axes.set_xlabel(what)
        axes.set_ylim(0.98 * levels["limit"], HIGHEST * levels["limit"])
        figures.log_axis(axes, "y")
    figures.log_axis(both[0], "x")
    both[0].set_ylabel(f"MAE on {scenario}, {unit}")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8.5, frameon=False)
    return figures.styled(figure)


def rows(found: dict[str, list[list[Point]]], least: float, seconds: float) -> list[list[str]]:
    """Of the table."""
    lines = []
    for name, of_seeds in found.items():
        last = [points[-1] for points in of_seeds]
        maes = sorted(point["mae"] for point in last)
        times = [[reached(points, near * least, seconds)["seconds"] for points in of_seeds] for near in NEAR]
        at_end = f"{median(maes):.3f} ({maes[0]:.3f} to {maes[-1]:.3f})"
        spent = f"{median(point['steps'] for point in last):,.0f}", cell([point["seconds"] for point in last], "s")
        lines.append([name, at_end, *spent, *(cell(each, "s") for each in times)])
    return lines


def main(
    plant: str = "pitch",
    agent: tuple[str, ...] = (),
    seeds: int = 5,
    with_peers: Annotated[bool, tyro.conf.arg(name="peers")] = False,
    minutes: float = 30.0,
) -> None:
    """The command.

    Args:
        plant: pitch or heaters.
        agent: learners; default: all.
        seeds: of each, from 0.
        with_peers: also other libraries' learners.
        minutes: longest time of a run; counts where a level is never reached.
    """
    scenario, seconds = SCENARIO[plant], 60.0 * minutes
    least, on = limit(scenario), scenarios.get(scenario)
    levels = {"limit": least}
    for name in LEVELS:
        figure_of_merit = evaluate_on(baseline(name, plant), [on])[scenario].figures.mae
        assert figure_of_merit is not None
        levels[name] = figure_of_merit
    learners = {name: runs(name) for name in agent or agents.AGENTS}
    if not agent:
        learners["ddpg, then pairs"] = ("--preset", "scratch")
        learners |= {f"{name}{NOT_HELD}": (*runs(name), "--agent.no-hold") for name in ("ddpg", "ppo")}
    found: dict[str, list[list[Point]]] = {}
    for name, options in learners.items():
        for seed in range(seeds):
            found.setdefault(name, []).append(list(ours(options, seed, 0.0, seconds, plant)))
            print(name, seed, found[name][-1][-1:], flush=True)
    if with_peers:
        python = of_peers()
        for library, learner in PEERS:
            for seed in range(seeds):
                points = list(peers(python, library, learner, seed, NEAR[-1] * least, seconds))
                found.setdefault(f"{library} {learner}", []).append(points)
                print(library, learner, seed, points[-1:], flush=True)
    stem = RESULTS / f"learners-{plant}"
    about: dict[str, Any] = {"machine": machine(), "levels": levels, "minutes": minutes}
    write_json(stem.with_suffix(".json"), about | {"runs": found})
    unit = figures.symbol(on.plant.y_unit)
    figures.keep(draw(found, levels, scenario, unit), stem.with_suffix(".png"))
    columns = [
        "learner",
        f"MAE at the end, {unit}",
        "environment steps",
        "wall time",
        *(f"to {near:g}" for near in NEAR),
    ]
    said = ", ".join(f"{name} {value:.3f}" for name, value in levels.items())
    command = f"python benchmarks/learners.py --plant {plant}" + (" --peers" if with_peers else "")
    text = [
        f"MAE on {scenario}, median (least to greatest) of {seeds} seeds, and wall time of the whole process until it "
        f"is within a factor of the limit; {minutes:g} minutes where it never is. {said.capitalize()} {unit}.",
        table(columns, rows(found, least, seconds)),
        made(command),
    ]
    stem.with_suffix(".md").write_text("\n\n".join(text) + "\n")
    print(json.dumps(levels), text[1], sep="\n")


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
