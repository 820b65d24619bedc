"""The figures and tables that README and docs show: where each is shown, the command that makes it, and its date.

    python scripts/published.py                    # all of them
    python scripts/published.py compare-pitch      # those whose name begins so

The date is the one in the file, else that of the commit that last changed it. Numbers in sentences are read from these
files when the site is built; where a page states one itself, its command and date stand beside it.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import tyro

from jaxouter import cli

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
TRAIN = "python -m jaxouter.train"
COMPARED = (
    f"{TRAIN} PLANT --seeds 5; {TRAIN} PLANT --preset scratch --seeds 5; python -m jaxouter.compare PLANT "
    "--run runs/PLANT-default-0 runs/PLANT-scratch-0; "
    "python benchmarks/comparison.py runs/compare-pitch runs/compare-heaters"
)
RUNS = (
    f"{TRAIN} PLANT --seeds 5; {TRAIN} PLANT --preset scratch --seeds 5; "
    "python benchmarks/results.py runs/{pitch,heaters}-{default,scratch}-0"
)
MAKERS = (  # what a file's name begins with, the most special first, and what makes it
    (
        "animation",
        f"{TRAIN} pitch; {TRAIN} heaters; python scripts/animation.py runs/pitch-default-0 runs/heaters-default-0",
    ),
    ("compare-", COMPARED),
    ("paper-cases", COMPARED),
    ("pitch-paper", f"{TRAIN} pitch --preset paper --seeds 3; python benchmarks/results.py runs/pitch-paper-0"),
    ("heaters-paper", f"{TRAIN} heaters --preset paper --seeds 3; python benchmarks/results.py runs/heaters-paper-0"),
    ("pitch-", RUNS),
    ("heaters-", RUNS),
    ("costs", RUNS),
    (
        "robust-",
        f"for seed in 0 1 2 3 4; do {TRAIN} PLANT --preset robust --seed $seed --devices 2; done; "
        "python benchmarks/robust.py runs/PLANT-robust-*",
    ),
    ("sample-efficiency", "python benchmarks/sample_efficiency.py"),
    ("over-base", "python benchmarks/over_base.py"),
    ("learners-", "python benchmarks/learners.py --plant PLANT"),
    ("time-to-quality", "python benchmarks/time_to_quality.py --peers"),
    ("unstable", "python benchmarks/unstable.py"),
    ("undecided", "python benchmarks/undecided.py"),
    ("throughput", "python benchmarks/throughput.py --peers"),
    ("controller", "python benchmarks/controller.py"),
    ("presets", "the commands that it names"),
    ("fair-baselines", "the commands that it names"),
    ("learning", "python scripts/sweep.py"),
    ("soak", "python scripts/soak.py"),
    ("mutants", "python scripts/mutants.py"),
    ("tests", "bash scripts/test.sh --all"),
)
SHOWN = re.compile(r"results/([\w.-]+\.\w+)|\{\{ ([\w-]+\.md) \}\}")
README_TABLE = "paper-cases"  # between comments of this name
NUMBER = re.compile(r"\{\{ \w+ of \S+\s+on\s+(\w+)/\S+ \}\}")
PAPER = re.compile(r"\{\{ results \}\}")


def shown() -> dict[str, list[str]]:
    """Names of the files in benchmarks/results that README and docs show, and the pages that do."""
    found: dict[str, list[str]] = {}
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        text = path.read_text()
        names = {one or other for one, other in SHOWN.findall(text)}
        names |= {f"compare-{plant}.csv" for plant in NUMBER.findall(text)}
        names |= {f"{README_TABLE}.md"} if f"<!-- {README_TABLE} -->" in text else set()
        if PAPER.search(text):
            names |= {f"{plant}-{preset}.json" for plant in ("pitch", "heaters") for preset in ("paper", "default")}
        for name in names:
            found.setdefault(name, []).append(str(path.relative_to(ROOT)))
    return dict(sorted(found.items()))


def maker(name: str) -> str | None:
    """The command that makes a file of benchmarks/results; None: none is known."""
    plant = next((plant for plant in ("pitch", "heaters") if plant in name), "PLANT")
    return next((command.replace("PLANT", plant) for start, command in MAKERS if name.startswith(start)), None)


def made(name: str) -> str:
    """When a file of benchmarks/results was made: as it says itself, else when a commit last changed it."""
    dates = re.findall(r"[Oo]n (\d{4}-\d\d-\d\d)", (RESULTS / name).read_text()) if name.endswith(".md") else []
    if dates:
        return dates[-1]
    command = ["git", "log", "-1", "--format=%cs", "--", str(RESULTS / name)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def main(name: tyro.conf.Positional[str] = "") -> None:
    """The command."""
    files = {each: pages for each, pages in shown().items() if each.startswith(name)}
    for command in dict.fromkeys(map(maker, files)):
        print(*str(command).split("; "), sep="\n")
        for each, pages in files.items():
            if maker(each) == command:
                print(f"    {made(each)}  {each:30}  {', '.join(pages)}")


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
