"""Generated content of the site, by hooks in mkdocs.yml: figures and tables of benchmarks/results, and `--help`.

It is made when the site is built, so nothing is stored twice.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import io
import json
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from jaxouter.evaluation import scenarios

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
COLUMNS = 100  # of --help
PRESETS = ("paper", "default")


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the figures as results/NAME.png, and the page of the commands."""
    for path in sorted([*RESULTS.glob("*.png"), *RESULTS.glob("*.webp")]):
        files.append(File.generated(config, f"results/{path.name}", abs_src_path=str(path)))
    files.append(File.generated(config, "reference/commands.md", content=commands()))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in what is kept in benchmarks/results.

    `{{ results }}` is the table of the paper's test cases, `{{ NAME.md }}` that file without its title,
    `{{ mae of POLICY on SCENARIO }}` a number.
    """
    del page, config, files
    with_table = re.sub(r"\{\{ results \}\}", lambda _: results(), markdown)
    with_files = re.sub(r"\{\{ ([\w-]+\.md) \}\}", lambda match: included(match[1]), with_table)
    return re.sub(r"\{\{ (\w+) of (\S+)\s+on\s+(\S+) \}\}", lambda match: figure(*match.groups()), with_files)


def included(name: str) -> str:
    """A file of benchmarks/results without its title."""
    return re.sub(r"\A# .*\n+", "", (RESULTS / name).read_text()).rstrip()


class Comments(griffe.Extension):
    """Shows the comment at the end of the line of a field or constant as its description in the reference."""

    def on_attribute(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Use the comment as docstring if there is none."""
        comment = attr.lines[-1].partition("  # ")[2] if attr.lines else ""
        if attr.docstring is None and comment and not comment.startswith(("type:", "noqa")):
            attr.docstring = griffe.Docstring(comment, parent=attr)


def commands() -> str:
    """The page with the `--help` of each command."""
    names = [path.stem for path in sorted((ROOT / "jaxouter").glob("*.py")) if "cli.run(main)" in path.read_text()]
    parts = [f"## {name}\n\n```text\n{usage(name)}\n```\n" for name in names]
    return (
        "# Commands\n\nWhat `--help` says. `train` shows the defaults of the plant and preset named.\n\n"
        + "\n".join(parts)
    )


def usage(name: str) -> str:
    """The `--help` of a command."""
    out = io.StringIO()
    width = patch.dict(os.environ, COLUMNS=str(COLUMNS))
    with width, contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        importlib.import_module(f"jaxouter.{name}").main(["--help"])
    return "\n".join(line.rstrip() for line in out.getvalue().strip().splitlines())


def results() -> str:
    """Table of the paper's test cases: MAE in the paper and here, as median (least to greatest) over the seeds."""
    lines = [
        "| test case | inner loop alone | static prefilter | the paper's DRL | `--preset paper` | `default` |",
        "|---|---|---|---|---|---|",
    ]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for plant in ("pitch", "heaters") for row in rows(plant))])


def rows(plant: str) -> Iterator[list[str]]:
    """Rows of a plant."""
    kept = {preset: json.loads((RESULTS / f"{plant}-{preset}.json").read_text())["results"] for preset in PRESETS}
    for name in scenarios.reported(plant):
        published = scenarios.get(name, 1).paper
        yield [
            name,
            *(f"{maes(kept['default'], policy, name)[0]:.3g}" for policy in ("none", "static")),
            "-" if published is None else f"{published[1]:.2f} of {published[0]:.2f}",
            *(spread(maes(kept[preset], "learned", name)) for preset in PRESETS),
        ]


@cache
def compared(plant: str) -> list[dict[str, str]]:
    """Rows of a plant's comparison."""
    return list(csv.DictReader((RESULTS / f"compare-{plant}.csv").read_text().splitlines()))


def figure(merit: str, policy: str, scenario: str) -> str:
    """A metric in the comparison, median over the seeds.

    Args:
        merit: column.
        policy: name, or the preset of a run.
        scenario: id.

    Raises:
        ValueError: it is not in the comparison.
    """
    plant = scenario.split("/")[0]
    values = [
        float(row[merit])
        for row in compared(plant)
        if row["scenario"] == scenario and (row["policy"] == policy or f"{plant}-{policy}-" in row["run"])
    ]
    if not values:
        raise ValueError(f"there is no {merit} of {policy} on {scenario} in {RESULTS}")
    return f"{median(values):.3g}"


def maes(kept: list[dict[str, Any]], policy: str, scenario: str) -> list[float]:
    """MAE of each run of a policy on a scenario."""
    return [run["scenarios"][scenario]["mae"] for run in kept if run["policy"] == policy]


def spread(values: list[float]) -> str:
    """Median (least to greatest)."""
    return f"{median(values):.3g} ({min(values):.3g} to {max(values):.3g})"
