"""The comparison tables of the README, from comparison folders; what they show is kept in benchmarks/results.

The last table answers the paper: each of its test cases, its figure, ours of each preset, `lq`, the best other baseline
and the limit.

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
from jaxouter.evaluation.statistics import Line

RESULTS = Path(__file__).parent / "results"


def claims(content: Comparison) -> Iterator[dict[str, str]]:
    """A line for each scenario that stands in the paper, by column; `!` leaves the plant's limits."""
    lines = statistics.lines(content.rows, content.policies)
    others = [line for line in lines if line.kind == "baseline" and line.policy not in ("lq", "none")]
    for name in scenarios.reported(content.plant):
        inner, drl = scenarios.get(name, 1).paper or (math.nan, math.nan)

        def shown(line: Line, name: str = name) -> str:
            mae = line.median(name, "mae")
            return "diverges" if mae is None else f"{mae:.3g}{'' if line.within_limits(name) else '!'}"

        by_label = {line.label: line for line in lines}
        best = min(others, key=lambda line: line.median(name, "mae") or math.inf)
        limits = [row.mae / row.ratio_to_limit for row in content.rows if row.scenario == name and row.ratio_to_limit]
        yield {
            "test case": name,
            "alone (the paper's)": f"{shown(by_label['none'])} ({inner:.2f})",
            "the paper's DRL": f"{drl:.2f}",
            **{preset(line): shown(line) for line in lines if line.run is not None},
            "`lq`": shown(by_label["lq"]),
            "best other baseline": f"{shown(best)} ({best.label})",
            "limit": f"{limits[0]:.3g}" if limits else "",
        }


def preset(line: Line) -> str:
    """That of a run whose folder has the name that training gives it, PLANT-PRESET-SEED."""
    return f"`{Path(line.run or '').name.split('-')[1]}`"


def show(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    for line in (columns, ["---"] * len(columns), *rows):
        print("| " + " | ".join(line) + " |")


def main(folders: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    answers: list[dict[str, str]] = []
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
    print("\nMAE of the paper's test cases\n")
    show([*answers[0]], ([*answer.values()] for answer in answers))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
