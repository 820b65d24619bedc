"""What one policy of the preset `robust` reaches on the plants of all scenarios; it is not told which one it controls.

    python benchmarks/robust.py runs/pitch-robust-0      # results/robust-pitch.json, tables and a figure
    python benchmarks/robust.py runs/heaters-robust-*    # several runs differ by their seeds

If plants are unstable alone, one table has the columns of `unstable.py` for them and for the others: from rest without
and with sensor noise, and the share that is held of the drawn starts that some r~ can bring back. Another has all
scenarios that are stable alone, compared with the limit in results/compare-PLANT.csv, which knows the plant.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro
from tables import made, table
from unstable import NOISE, RESULTS, drawn, measured, possible

from jaxouter import cli
from jaxouter.evaluation import cache, scenarios
from jaxouter.evaluation.metrics import mae, share_outside
from jaxouter.evaluation.policies import NamedPolicy
from jaxouter.evaluation.rollout import rollout
from jaxouter.training.policy import LearnedParams
from jaxouter.training.run import RunFolder, surroundings, write_json

ALONE = "bank of laws alone"
DRAWN = {"pitch": ("pitch/paper", "pitch/delay-5.7"), "heaters": ("heaters/paper-4", "heaters/riccati")}


class Reached(NamedTuple):
    """What the seeds of a policy reach on a scenario."""

    mae: list[float]
    outside: list[float]  # share of the steps outside the limits of y


def limits(plant: str) -> dict[str, float]:
    """MAE of the limit on each scenario."""
    with (RESULTS / f"compare-{plant}.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["ratio_to_limit"] and row["mae"]]
    return {row["scenario"]: float(row["mae"]) / float(row["ratio_to_limit"]) for row in rows}


def main(runs: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """The command; several runs differ by their seeds."""
    cache.use_compilation_cache()
    learned: list[NamedPolicy] = []
    for run in map(RunFolder.open, runs):
        policy, plant = run.trainer[0].policy, run.config.plant
        learned += [NamedPolicy("learned", policy, run.policy(seed)[1], plant) for seed in run.seeds]
    first, plant = learned[0], learned[0].plant
    idle = LearnedParams(jax.tree.map(np.zeros_like, first.params.actor), first.params.base)
    policies = {"learned": learned, ALONE: [NamedPolicy(ALONE, first.policy, idle, plant)]}
    limit = limits(plant)
    selected = [scenarios.get(name) for name in scenarios.catalogue(plant) if name in limit]
    of_stability = [scenarios.get(name) for name in scenarios.for_stability(plant)]
    could: dict[str, float] = {}
    held: dict[str, dict[str, list[dict[str, float]]]] = {name: {} for name in policies}
    for scenario in of_stability if not all(each.stable_alone for each in of_stability) else []:
        could[scenario.id] = float(np.mean(possible(scenarios.perturbed(scenario.id))))
        for name, each in policies.items():
            held[name][scenario.id] = [measured(one, scenario.id) for one in each]
            print(scenario.id, name, held[name][scenario.id], flush=True)
    reached: dict[str, dict[str, Reached]] = {}
    for scenario in selected:
        if scenario.stable_alone:
            for name, each in policies.items():
                traces = [rollout(one.policy, one.params, scenario) for one in each]
                outside = [share_outside(one, scenario.plant) for one in traces]
                reached.setdefault(scenario.id, {})[name] = Reached(list(map(mae, traces)), outside)
            print(scenario.id, reached[scenario.id], flush=True)
    drawn(dict.fromkeys(DRAWN[plant], first), RESULTS / f"robust-{plant}.png")
    about: dict[str, Any] = {"machine": surroundings(), "can be held": could, "held": held, "scenarios": reached}
    write_json(RESULTS / f"robust-{plant}.json", about)
    tables = [of_plants(could, held)] if could else []
    tables.append(of_references(reached, limit))
    spread = f"Median (least to greatest) of {len(learned)} seeds." if len(learned) > 1 else "One seed."
    command = " ".join(["python benchmarks/robust.py", *map(str, runs)])
    text = "\n\n".join([*tables, f"{spread} {made(command)}"])
    (RESULTS / f"robust-{plant}.md").write_text(text + "\n")
    print(text)


def of_plants(could: Mapping[str, float], held: Mapping[str, Mapping[str, list[dict[str, float]]]]) -> str:
    """The table of the plants."""
    rows = []
    for name, of_scenarios in held.items():
        for scenario, found in of_scenarios.items():
            shares = [100.0 * each["held"] / could[scenario] for each in found]
            of_rest = [cell([each[column] for each in found]) for column in ("mae", "noisy")]
            rows.append([scenario, name, *of_rest, f"{100 * could[scenario]:.0f} %", cell(shares)])
    columns = ["plant", "policy", "MAE from rest", f"with noise of {NOISE}", "can be held", "of these held, %"]
    return table(columns, rows)


def of_references(reached: Mapping[str, Mapping[str, Reached]], limit: Mapping[str, float]) -> str:
    """The table of the scenarios that are stable alone."""
    rows = []
    for name, found in reached.items():
        ours, of_bank = found["learned"], found[ALONE]
        outside = f"{100 * median(ours.outside):.2g}"
        ratio = f"{median(ours.mae) / limit[name]:.2f}"
        rows.append([name, cell(of_bank.mae), cell(ours.mae), outside, f"{limit[name]:.3g}", ratio])
    columns = ["scenario", ALONE, "learned", "steps outside the limits, %", "limit", "learned / limit"]
    return table(columns, rows)


def cell(values: Sequence[float]) -> str:
    """Median, least and greatest value."""
    spread = f" ({min(values):.3g} to {max(values):.3g})" if len(values) > 1 else ""
    return f"{median(values):.3g}{spread}"


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
