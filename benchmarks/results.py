"""What runs reached and what they cost, from run folders; summaries and main figures are kept in benchmarks/results.

    python benchmarks/results.py runs/{pitch,heaters}-{default,scratch,paper}-0

`costs.md` has the environment steps, gradient steps and wall time of each run.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from statistics import median
from typing import Any

import tyro
from tables import made, table

from jaxouter.evaluation import scenarios
from jaxouter.training.run import RunFolder

RESULTS = Path(__file__).parent / "results"


def maes(results: list[dict[str, Any]], policy: str, scenario: str) -> list[float]:
    """MAE of each run of a policy, a diverged one as infinite."""
    values = [r["scenarios"][scenario]["mae"] for r in results if r["policy"] == policy]
    return [float("inf") if value is None else value for value in values]


def cost(run: RunFolder, seconds: float) -> list[str]:
    """Cells of a run that trained all its seeds in so many seconds; all are of one seed."""
    config = run.config
    steps = config.environment_steps - config.identification_steps
    updates = config.pretraining.gradient_steps + config.total_updates
    each = config.identification_steps, steps, updates
    return [f"{config.plant}, `{config.preset}`", *(f"{n:,}" for n in each), f"{seconds / config.seeds:.0f} s"]


def main(runs: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    rows: dict[str, dict[str, str]] = {}
    costs = []
    for path in runs:
        run = RunFolder.open(path)
        name = f"{run.config.plant}-{run.config.preset}"
        content = (run.path / "summary.json").read_text()
        (RESULTS / f"{name}.json").write_text(content)
        shutil.copy(run.figures / "paper.png", RESULTS / f"{name}.png")
        if run.config.epochs:
            shutil.copy(run.figures / "learning-curve.png", RESULTS / f"{name}-learning.png")
        summary = json.loads(content)
        results = summary["results"]
        costs.append(cost(run, summary["training_seconds"]))
        for scenario in scenarios.reported(run.config.plant):
            row = rows.setdefault(scenario, {})
            row["inner"], row["static"] = (f"{maes(results, p, scenario)[0]:.2f}" for p in ("none", "static"))
            paper = scenarios.get(scenario, 1).paper
            row["published"] = "" if paper is None else f"{paper[1]:.2f} of {paper[0]:.2f}"
            values = maes(results, "learned", scenario)
            row[run.config.preset] = f"{median(values):.2f} ({min(values):.2f} to {max(values):.2f})"
    columns = ["run", "recorded steps", "environment steps", "gradient steps", "wall time"]
    about = "Each number is for one seed. Wall time is that of all seeds divided by their number, compilation included."
    command = f"python benchmarks/results.py {' '.join(map(str, runs))}"
    (RESULTS / "costs.md").write_text(f"{table(columns, costs)}\n\n{about} {made(command)}\n")
    columns = ["inner", "static", "published", "paper", "scratch", "default"]
    print(table(["scenario", *columns], ([name, *(row.get(key, "") for key in columns)] for name, row in rows.items())))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
