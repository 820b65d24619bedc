"""The comparison tables of the README, from comparison folders; what they show is kept in benchmarks/results.

The last table answers the paper: each of its test cases, its figure, ours, the best baseline and the limit.

python benchmarks/comparison.py runs/compare-pitch runs/compare-heaters
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec
import tyro

from jaxouter.evaluation import scenarios, statistics
from jaxouter.evaluation.results import Comparison

RESULTS = Path(__file__).parent / "results"


def claims(content: Comparison) -> Iterator[list[str]]:
    """A line for each scenario that stands in the paper."""
    lines = statistics.lines(content.rows, content.policies)
    for name in scenarios.reported(content.plant):
        inner, drl = scenarios.get(name, 1).paper or (math.nan, math.nan)
        maes = {line.label: (line.median(name, "mae") or math.inf, line) for line in lines}
        best = min((label for label in maes if maes[label][1].kind == "baseline"), key=lambda label: maes[label][0])
        cells = [f"{drl:.2f} of {inner:.2f}"]
        cells += [f"{maes[label][0]:.3g} of {maes['none'][0]:.3g}" for label in ("learned", best, "oracle")]
        outside = ["" if maes[label][1].within_limits(name) else "!" for label in ("learned", best, "oracle")]
        yield [name, cells[0], *(f"{a}{b}" for a, b in zip(cells[1:], outside, strict=True)), best]


def show(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    for line in (columns, ["---"] * len(columns), *rows):
        print("| " + " | ".join(line) + " |")


def main(folders: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    answers: list[list[str]] = []
    for folder in folders:
        content = msgspec.convert(json.loads((folder / "comparison.json").read_text()), Comparison)
        name = f"compare-{content.plant}"
        shutil.copy(folder / "comparison.csv", RESULTS / f"{name}.csv")
        for figure in (folder / "figures").glob("*.png"):
            if figure.stem in ("errors", "effort", "stability") or figure.stem.startswith("sweep-"):
                shutil.copy(figure, RESULTS / f"{name}-{figure.name}")
        columns, rows = statistics.table(content.rows, content.policies, "**{}**")
        print(f"\n{content.plant}, MAE in {content.y_unit}; {content.date}, {content.seconds:.0f} s\n")
        show(columns, rows)
        answers += claims(content)
    print("\nMAE, of that of the inner loop alone\n")
    show(["test case", "the paper's DRL", "ours", "best baseline", "limit", "that baseline"], answers)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
