"""Train variants of the default preset, and write what each gave to benchmarks/results/learning.md.

    python scripts/sweep.py                             # train what is missing, write the table
    python scripts/sweep.py --seeds 5 --only default

Each row of the table is one command of `python -m jaxouter.train`, with run folder runs/sweep/PLANT-NAME. The columns
are the median MAE over the seeds, for each scenario in which the inner loop alone is stable.
"""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import jax
import tyro

from jaxouter import cli
from jaxouter.evaluation import cache, scenarios
from jaxouter.evaluation.policies import NamedPolicy, evaluate_on
from jaxouter.training.run import RunFolder

RESULTS = Path(__file__).resolve().parent.parent / "benchmarks" / "results" / "learning.md"
VARIANTS: dict[str, tuple[str, ...]] = {
    "default": (),
    "scratch": ("--base", "static"),
    "scratch-without-pairs": ("--base", "static", "--pairs.rounds", "0"),
    "scratch-not-held": ("--base", "static", "--pairs.rounds", "0", "--agent.no-hold"),
    "scratch-relabelled": ("--base", "static", "--pairs.rounds", "0", "--agent.relabel", "0.5"),
    "record": ("--preset", "record"),
    "record-16-episodes": ("--preset", "record", "--pretraining.episodes", "16"),
    "record-undisturbed": ("--preset", "record", "--disturbances.noise", "0", "--disturbances.load", "0"),
}


@dataclass(frozen=True)
class Options:
    """Train every variant on both plants, and write the table of what each gave."""

    seeds: int = 2
    """Seeds of new runs."""
    only: tuple[str, ...] = tuple(VARIANTS)
    """Variants to train; the table has all that have a run folder."""
    runs: Path = Path("runs/sweep")
    """Folder for the runs."""


def selected_on(plant: str) -> list[str]:
    """The scenarios in which the inner loop alone is stable."""
    return [name for name in scenarios.catalogue(plant) if scenarios.get(name, 1).stable_alone]


def line(name: str, run: RunFolder) -> list[str]:
    """Variant, seeds, median MAE of each scenario, and seconds per seed for the whole command."""
    trainer, _ = run.trainer
    selected = [scenarios.get(identifier) for identifier in selected_on(run.config.plant)]
    policies = [
        NamedPolicy("learned", trainer.policy, trainer.policy_params(run.load(seed)[0]), run.config.plant)
        for seed in run.seeds
    ]
    found = [evaluate_on(policy, selected) for policy in policies]
    of_each = [[results[scenario.id].figures.mae for results in found] for scenario in selected]
    seconds = (run.path / "seconds").read_text()
    return [name, str(run.config.seeds), *(f"{statistics.median(maes):.3f}" for maes in of_each), seconds]


def train(plant: str, name: str, options: Options) -> None:
    """Run the command, unless its folder exists."""
    folder = options.runs / f"{plant}-{name}"
    if folder.exists():
        return
    command = ["-m", "jaxouter.train", plant, *VARIANTS[name], "--seeds", str(options.seeds), "--out", str(folder)]
    print(f"python {' '.join(command)}", flush=True)
    begun = datetime.now(UTC)
    subprocess.run([sys.executable, *command], check=True)
    (folder / "seconds").write_text(f"{(datetime.now(UTC) - begun).total_seconds() / options.seeds:.0f}")


def main(options: Options) -> None:
    """The command."""
    cache.use_compilation_cache()
    text = [
        "# What was tried, and what it gave",
        "",
        f"By `python scripts/sweep.py` on {datetime.now(UTC):%Y-%m-%d}, jax {jax.__version__}, Python "
        f"{platform.python_version()}, {os.cpu_count()} CPU cores. "
        "Median MAE over the seeds; seconds a seed, of the whole command.",
    ]
    for plant in ("pitch", "heaters"):
        for name in options.only:
            train(plant, name, options)
        header = ["change", "seeds", *(identifier.split("/")[1] for identifier in selected_on(plant)), "s"]
        rows = [
            line(name, RunFolder.open(options.runs / f"{plant}-{name}"))
            for name in VARIANTS
            if (options.runs / f"{plant}-{name}").exists()
        ]
        table = [header, ["---"] * len(header), *rows]
        text += ["", f"## {plant}", "", *(f"| {' | '.join(row)} |" for row in table)]
        commands = [f"- `{name}`: `{' '.join(('jaxouter.train', plant, *VARIANTS[name]))}`" for name, *_ in rows]
        text += ["", *commands]
    RESULTS.write_text("\n".join(text) + "\n")
    print(RESULTS.read_text())


if __name__ == "__main__":
    cli.run(lambda: main(tyro.cli(Options)))
