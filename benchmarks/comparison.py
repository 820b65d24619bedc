"""The comparison tables of README and docs, from comparison folders; what they show is kept in benchmarks/results.

    python benchmarks/comparison.py runs/compare-pitch runs/compare-heaters

`compare-PLANT.md` has every policy on every scenario, `paper-cases.md` the paper's test cases: its figure, ours of each
preset, `lq`, the best other baseline and the limit. The README's table of these is written anew too.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
import tyro
from tables import made, table

from jaxouter.evaluation import scenarios, statistics
from jaxouter.evaluation.results import Comparison
from jaxouter.evaluation.statistics import Line

HERE = Path(__file__).parent
RESULTS = HERE / "results"
README = HERE.parent / "README.md"
FIGURES = ("errors", "effort", "stability")


def answers(content: Comparison) -> Iterator[dict[str, str]]:
    """A line for each scenario that stands in the paper, by column; `!` leaves the plant's limits."""
    lines = statistics.lines(content.rows, content.policies)
    others = [line for line in lines if line.kind == "baseline" and line.policy not in ("lq", "none")]
    by_label = {line.label: line for line in lines}
    for name in scenarios.reported(content.plant):
        inner, drl = scenarios.get(name, 1).paper or (math.nan, math.nan)

        def shown(line: Line, name: str = name) -> str:
            mae = line.median(name, "mae")
            return "diverges" if mae is None else f"{mae:.3g}{'' if line.within_limits(name) else '!'}"

        best = min(others, key=lambda line: line.median(name, "mae") or math.inf)
        own = [row for row in content.rows if row.scenario == name]
        limits = [row.mae / row.ratio_to_limit for row in own if row.mae and row.ratio_to_limit]
        yield {
            "test case": name,
            "alone (the paper's)": f"{shown(by_label['none'])} ({inner:.2f})",
            "the paper's DRL": f"{drl:.2f}",
            **{f"`{preset(line.label)}`": shown(line) for line in lines if line.run is not None},
            "`lq`": shown(by_label["lq"]),
            "best other baseline": f"{shown(best)} (`{best.label}`)",
            "limit": f"{limits[0]:.3g}" if limits and scenarios.get(name, 1).stable_alone else "unknown",
        }


def preset(label: str) -> str:
    """That of a run whose folder has the name that training gives it, PLANT-PRESET-SEED; other labels as they are."""
    return re.sub(r"learned \w+-(\w+)-\d+", r"\1", label)


def main(folders: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """The command."""
    cases: list[dict[str, str]] = []
    for folder in folders:
        content = msgspec.convert(json.loads((folder / "comparison.json").read_text()), Comparison)
        name = f"compare-{content.plant}"
        shutil.copy(folder / "comparison.csv", RESULTS / f"{name}.csv")
        for figure in (folder / "figures").glob("*.png"):
            if figure.stem in FIGURES or figure.stem.startswith("sweep-"):
                shutil.copy(figure, RESULTS / f"{name}-{figure.name}")
        columns, rows = statistics.table(content.rows, content.policies, "**{}**")
        written = f"{table([*map(preset, columns)], rows)}\n\n{made(content.command)}\n"
        (RESULTS / f"{name}.md").write_text(written)
        print(written)
        cases += answers(content)
    shown = table([*cases[0]], ([*case.values()] for case in cases))
    (RESULTS / "paper-cases.md").write_text(f"{shown}\n")
    marked = re.compile(r"(<!-- paper-cases -->\n).*?(?=<!-- end -->)", re.DOTALL)
    README.write_text(marked.sub(lambda match: f"{match[1]}{shown}\n", README.read_text()))
    print(shown)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
