"""The comparison tables of the README, from comparison folders; what they show is kept in benchmarks/results.

python benchmarks/comparison.py runs/compare-pitch runs/compare-heaters
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import tyro

from jaxouter.evaluation import statistics

RESULTS = Path(__file__).parent / "results"


def main(folders: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    for folder in folders:
        content = json.loads((folder / "comparison.json").read_text())
        name = f"compare-{content['plant']}"
        shutil.copy(folder / "comparison.csv", RESULTS / f"{name}.csv")
        for figure in (folder / "figures").glob("*.png"):
            if figure.stem in ("errors", "effort", "certificate") or figure.stem.startswith("sweep-"):
                shutil.copy(figure, RESULTS / f"{name}-{figure.name}")
        columns, rows = statistics.table(content["rows"], content["policies"], "**{}**")
        print(f"\n{content['plant']}, MAE in {content['y_unit']}; {content['date']}, {content['seconds']:.0f} s\n")
        for line in (columns, ["---"] * len(columns), *rows):
            print("| " + " | ".join(line) + " |")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
