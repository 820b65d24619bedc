"""The results table of the README, from run folders; their summaries and main figures are kept in benchmarks/results.

python benchmarks/results.py runs/pitch-default-0 runs/pitch-paper-0 runs/heaters-default-0 runs/heaters-paper-0
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from statistics import median
from typing import Any

import tyro

from jaxouter.evaluation import scenarios
from jaxouter.training.run import RunFolder

RESULTS = Path(__file__).parent / "results"


def maes(results: list[dict[str, Any]], policy: str, scenario: str) -> list[float]:
    """MAE of each run of a policy, a diverged one as infinite."""
    values = [r["scenarios"][scenario]["mae"] for r in results if r["policy"] == policy]
    return [float("inf") if value is None else value for value in values]


def main(runs: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    rows: dict[str, dict[str, str]] = {}
    for path in runs:
        run = RunFolder.open(path)
        name = f"{run.config.plant}-{run.config.preset}"
        content = (run.path / "summary.json").read_text()
        (RESULTS / f"{name}.json").write_text(content)
        shutil.copy(run.figures / "paper.png", RESULTS / f"{name}.png")
        if run.config.epochs:
            shutil.copy(run.figures / "learning-curve.png", RESULTS / f"{name}-learning.png")
        results = json.loads(content)["results"]
        for scenario in scenarios.reported(run.config.plant):
            row = rows.setdefault(scenario, {})
            row["inner"], row["static"] = (f"{maes(results, p, scenario)[0]:.2f}" for p in ("none", "static"))
            paper = scenarios.get(scenario, 1).paper
            row["published"] = "" if paper is None else f"{paper[1]:.2f} of {paper[0]:.2f}"
            values = maes(results, "learned", scenario)
            row[run.config.preset] = f"{median(values):.2f} ({min(values):.2f} to {max(values):.2f})"
    print("| scenario | inner loop alone | static prefilter | the paper's DRL | ours, `paper` | ours, `default` |")
    print("|---|---|---|---|---|---|")
    for scenario, row in rows.items():
        cells = [row.get(key, "") for key in ("inner", "static", "published", "paper", "default")]
        print(f"| {scenario} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
