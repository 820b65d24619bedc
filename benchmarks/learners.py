"""Our learners side by side, each from scratch on the static prefilter: MAE over wall time and environment steps.

    python benchmarks/learners.py                    # pitch, five seeds of each; an hour on 2 cores
    python benchmarks/learners.py --plant heaters
    python benchmarks/learners.py --agent td3 sac    # some of them; results of the others stay as they are
    python benchmarks/learners.py --peers            # pitch alone: also those of stable-baselines3 and sbx; hours

Each run is a process of its own that begins with nothing cached, see `time_to_quality.py`; its time counts from its
start, imports and compilation included. `ddpg` learns without pairs here, as the others do; `ddpg, then pairs` is the
preset `scratch`. `r not held` shows what holding the set-point is worth to a learner of either kind. Training never
sees the scenario of the MAE. Table, figure and numbers go to results/learners-PLANT after each learner.
"""

from __future__ import annotations

import json
from datetime import date
from functools import partial
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Annotated

import numpy as np
import tyro
from tables import machine, table
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
NOT_HELD, PAIRED = ", r not held", "ddpg, then pairs"
LEARNERS = (*agents.AGENTS, PAIRED, *(f"{name}{NOT_HELD}" for name in ("ddpg", "ppo")))


def runs(name: str) -> tuple[str, ...]:
    """Options of the command for a learner."""
    if name == PAIRED:
        return ("--preset", "scratch")
    held = ("--agent.no-hold",) if name.endswith(NOT_HELD) else ()
    return ("--preset", "scratch", "--agent", name.removesuffix(NOT_HELD), "--pairs.rounds", "0", *held)


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
        agent: learners, by their names in the table; default: all.
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
    stem = RESULTS / f"learners-{plant}"
    path = stem.with_suffix(".json")
    known = json.loads(path.read_text()) if path.exists() else {"dates": {}, "runs": {}}
    dates: dict[str, str] = known["dates"]
    found: dict[str, list[list[Point]]] = known["runs"]
    wanted = {name: partial(ours, runs(name), below=0.0, seconds=seconds, plant=plant) for name in agent or LEARNERS}
    if with_peers:
        of = partial(partial, peers, of_peers(), below=NEAR[-1] * least, seconds=seconds)
        wanted |= {f"{library} {learner}": of(library, learner) for library, learner in PEERS}
    for name, run in wanted.items():
        found[name], dates[name] = [], date.today().isoformat()
        for seed in range(seeds):
            found[name].append(list(run(seed=seed)))
            print(name, seed, found[name][-1][-1:], flush=True)
        found = dict(sorted(found.items(), key=lambda item: [*LEARNERS, item[0]].index(item[0])))
        about = {"machine": machine(), "levels": levels, "minutes": minutes, "dates": dates}
        write_json(path, about | {"runs": found})
        write(stem, found, dates, levels, scenario, seconds)


def write(
    stem: Path,
    found: dict[str, list[list[Point]]],
    dates: dict[str, str],
    levels: dict[str, float],
    scenario: str,
    seconds: float,
) -> None:
    """The figure and the table."""
    unit = figures.symbol(scenarios.get(scenario).plant.y_unit)
    figures.keep(draw(found, levels, scenario, unit), stem.with_suffix(".png"))
    columns = [
        "learner",
        f"MAE at the end, {unit}",
        "environment steps",
        "wall time",
        *(f"to {near:g}" for near in NEAR),
        "date",
    ]
    on, command = machine(), f"python benchmarks/learners.py --plant {stem.name.removeprefix('learners-')}"
    said = ", ".join(f"{name} {value:.3f}" for name, value in levels.items())
    seeds = min(len(of_seeds) for of_seeds in found.values())
    text = [
        f"MAE on {scenario}, median (least to greatest) of {seeds} seeds, and wall time of the whole process until it "
        f"is within a factor of the limit; {seconds / 60:g} minutes where it never is. {said.capitalize()} {unit}.",
        table(columns, ([*cells, dates[cells[0]]] for cells in rows(found, levels["limit"], seconds))),
        f"On {on['cores']} cores of {on['cpu']} (jax {on['jax']}, python {on['python']}): `{command}`",
    ]
    stem.with_suffix(".md").write_text("\n\n".join(text) + "\n")
    print(text[1], flush=True)


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
