"""Kill a training run at random moments, resume it each time, and compare its end with that of an undisturbed run.

    python scripts/soak.py                  # 20 kills; writes benchmarks/results/soak.json
    python scripts/soak.py --kills 3 --out /tmp/soak.json

The run has two seeds, each with pretraining, prefill and epochs of DDPG. SIGKILL may hit at any time: while it imports,
makes its folder, records, pretrains, learns or saves. The final parameters must be equal to the last bit, and so must
the metrics, except wall times and rates.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from jaxouter import cli
from jaxouter.training import checkpoint
from jaxouter.training.run import RunFolder, surroundings, write_json

RESULTS = Path(__file__).resolve().parent.parent / "benchmarks" / "results" / "soak.json"
TRAINING = (  # so small that some gradient steps and epochs take no longer than the start of the process
    *("heaters", "--pretraining.gradient-steps", "400", "--pretraining.episodes", "8"),
    *("--pretraining.batch-size", "16", "--environments", "8", "--epoch", "800"),
    *("--agent.prefill", "640", "--agent.replay", "40000"),
    *("--agent.hidden", "32", "32", "--agent.batch-size", "32", "--agent.updates", "8"),
    *("--pairs.states", "512", "--pairs.environments", "8", "--pairs.updates", "50", "--compared", "64"),
)


@dataclass(frozen=True)
class Options:
    """Kill a training run at random moments, resume it each time, and compare it with an undisturbed one."""

    kills: int = 20
    """Number of kills."""
    seed: int = 0
    """Seed of the moments."""
    within: float = 8.0
    """Longest time from a start to its kill, s."""
    seeds: int = 2
    """Seeds of the training run."""
    steps: int = 400_640
    """Environment steps of each seed."""
    out: Path = RESULTS
    """File for the result."""


def command(folder: Path, options: Options) -> list[str]:
    """The command that begins or resumes the run."""
    size = ["--seeds", str(options.seeds), "--steps", str(options.steps)]
    start = ["--resume", str(folder)] if folder.exists() else [*TRAINING, *size, "--out", str(folder)]
    return [sys.executable, "-m", "jaxouter.train", *start]


def where(folder: Path) -> str:
    """How far the run in a folder is."""
    if not folder.exists():
        return "nothing there yet"
    names = sorted(str(path.relative_to(folder)) for path in folder.glob("seed-*/*") if "metrics" not in path.name)
    rows = [len(path.read_text().splitlines()) for path in sorted(folder.glob("seed-*/metrics.jsonl"))]
    return f"rows {rows}, {', '.join(names) or 'nothing saved'}"


def killed(folder: Path, options: Options) -> list[dict[str, Any]]:
    """Train to the end in spite of the kills.

    Raises:
        RuntimeError: the training failed by itself, or ended before the last kill.
    """
    draw, moments = random.Random(options.seed), []
    for i in range(options.kills):
        begun = time.monotonic()
        process = subprocess.Popen(command(folder, options), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            process.wait(draw.uniform(0.0, options.within))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
        _, errors = process.communicate()
        if process.returncode != -signal.SIGKILL:
            raise RuntimeError(
                f"it ended by itself with status {process.returncode} (0: take more steps): {errors.decode()[-2000:]}"
            )
        moments.append({"seconds": round(time.monotonic() - begun, 2), "found": where(folder)})
        print(f"kill {i + 1} after {moments[-1]['seconds']} s: {moments[-1]['found']}", flush=True)
    subprocess.run(command(folder, options), check=True, stdout=subprocess.DEVNULL)
    return moments


def differences(one: RunFolder, other: RunFolder) -> list[str]:
    """Differences between two runs: checkpoints, rows of the metrics, files."""
    found = []
    for seed in one.seeds:
        rows = [
            [{key: value for key, value in row.items() if "second" not in key} for row in run.rows(seed)]
            for run in (one, other)
        ]
        found += [] if rows[0] == rows[1] else [f"rows of seed {seed}"]
        (_, a), (_, b) = (checkpoint.read(list(run.checkpoints(seed).values())[-1]) for run in (one, other))
        found += [f"{name} of seed {seed}" for name in a | b if not np.array_equal(a.get(name), b.get(name))]
        kept = {"metrics.jsonl", *(path.name for path in other.checkpoints(seed).values())}
        found += [f"{path} is left over" for path in other.seed_folder(seed).iterdir() if path.name not in kept]
    return found


def soak(options: Options) -> dict[str, Any]:
    """Do both runs, and compare them.

    Raises:
        RuntimeError: the runs differ.
    """
    with tempfile.TemporaryDirectory() as folder:
        whole, disturbed = Path(folder) / "whole", Path(folder) / "disturbed"
        subprocess.run(command(whole, options), check=True, stdout=subprocess.DEVNULL)
        moments = killed(disturbed, options)
        one, other = RunFolder.open(whole), RunFolder.open(disturbed)
        if found := differences(one, other):
            raise RuntimeError(f"the runs differ in {', '.join(found)}")
        rows = sum(len(one.rows(seed)) for seed in one.seeds)
    about = {"date": date.today().isoformat(), "machine": surroundings(), "command": " ".join(TRAINING)}
    return about | {"seeds": options.seeds, "steps": options.steps, "rows": rows, "kills": moments, "differences": []}


def main(options: Options) -> None:
    """The command."""
    content = soak(options)
    write_json(options.out, content)
    print(f"{len(content['kills'])} kills; all parameters and {content['rows']} rows are equal")


if __name__ == "__main__":
    cli.run(lambda: main(tyro.cli(Options)))
