"""What one policy with a bank of base laws holds: the paper's five plants, and families on the nominal one.

    python benchmarks/bank.py runs/pitch-robust-0      # results/bank.json, two tables and a figure

Columns are those of `unstable.py`: from rest without and with sensor noise, and the share that is held of the drawn
starts that some r~ can bring back. The families are compared with the limit in results/compare-pitch.csv.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np
import tyro
from tables import made, table
from unstable import NOISE, RESULTS, drawn, measured, possible

from jaxouter import cli
from jaxouter.evaluation import cache, scenarios
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.policies import NamedPolicy
from jaxouter.evaluation.rollout import rollout
from jaxouter.training.policy import LearnedParams
from jaxouter.training.run import RunFolder, surroundings, write_json

ALONE = "bank of laws alone"
FAMILIES = ("paper", "steps", "staircase", "ramps", "doublets", "noise", "load")


def limits(path: Path = RESULTS / "compare-pitch.csv") -> dict[str, float]:
    """MAE of the limit on each scenario."""
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row["ratio_to_limit"] and row["mae"]]
    return {row["scenario"]: float(row["mae"]) / float(row["ratio_to_limit"]) for row in rows}


def main(runs: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """The command; several runs differ by their seeds."""
    cache.use_compilation_cache()
    learned: list[NamedPolicy] = []
    for run in map(RunFolder.open, runs):
        policy, plant = run.trainer[0].policy, run.config.plant
        learned += [NamedPolicy("learned", policy, run.policy(seed)[1], plant) for seed in run.seeds]
    first = learned[0]
    idle = LearnedParams(jax.tree.map(np.zeros_like, first.params.actor), first.params.base)
    policies = {"learned": learned, ALONE: [NamedPolicy(ALONE, first.policy, idle, first.plant)]}
    could, held = {}, {name: {} for name in policies}
    for identifier in scenarios.for_stability(first.plant):
        case = identifier.rpartition("/")[2]
        could[case] = float(np.mean(possible(scenarios.perturbed(identifier))))
        for name, each in policies.items():
            held[name][case] = [measured(one, case) for one in each]
            print(case, name, held[name][case], flush=True)
    of_families = {
        name: [mae(rollout(one.policy, one.params, scenarios.get(f"pitch/{name}"))) for one in learned]
        for name in FAMILIES
    }
    drawn({"paper": first, "delay-5.7": first}, RESULTS / "bank.png")
    about: dict[str, Any] = {"machine": surroundings(), "can be held": could, "held": held, "families": of_families}
    write_json(RESULTS / "bank.json", about)
    spread = f"Median (least to greatest) of {len(learned)} seeds." if len(learned) > 1 else "One seed."
    text = f"{of_plants(could, held)}\n\n{of_references(of_families)}\n\n{spread} "
    text += made(f"python benchmarks/bank.py {' '.join(map(str, runs))}")
    (RESULTS / "bank.md").write_text(text + "\n")
    print(text)


def of_plants(could: dict[str, float], held: dict[str, dict[str, list[dict[str, float]]]]) -> str:
    """The table of the plants."""
    rows = []
    for name, of_cases in held.items():
        for case, found in of_cases.items():
            shares = [100.0 * each["held"] / could[case] for each in found]
            of_rest = [cell([each[column] for each in found]) for column in ("mae", "noisy")]
            rows.append([f"pitch/{case}", name, *of_rest, f"{100 * could[case]:.0f} %", cell(shares)])
    columns = [
        "plant",
        "policy",
        "MAE from rest",
        f"with noise of {NOISE}",
        "can be held",
        "of these held, %",
    ]
    return table(columns, rows)


def of_references(found: dict[str, list[float]]) -> str:
    """The table of the families on the nominal plant."""
    limit = limits()
    rows = [
        [f"pitch/{name}", cell(maes), f"{limit[f'pitch/{name}']:.3g}", f"{median(maes) / limit[f'pitch/{name}']:.2f}"]
        for name, maes in found.items()
    ]
    return table(["scenario", "learned", "limit", "ratio"], rows)


def cell(values: Sequence[float]) -> str:
    """Median, least and greatest value."""
    spread = f" ({min(values):.3g} to {max(values):.3g})" if len(values) > 1 else ""
    return f"{median(values):.3g}{spread}"


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
