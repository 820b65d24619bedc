"""Wall time and environment steps until the MAE on pitch/paper is within 1.25, 1.10 and 1.05 of the limit.

    python benchmarks/time_to_quality.py                 # our presets, five seeds each; 15 minutes
    python benchmarks/time_to_quality.py --peers         # and the learners of stable-baselines3 and sbx; hours

Each run is a process of its own that begins with nothing cached, on an otherwise idle machine; its time counts from its
start, imports and compilation included. Training never sees pitch/paper. Ours are timed by when a row of metrics.jsonl
appears, so what the run spends on evaluation counts; a peer's evaluations don't. A peer has its library's own settings,
eight environments, and `--minutes`, which count where it never gets there. Table and numbers go to results/.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from statistics import median
from typing import Annotated

import tyro

from jaxouter import cli
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.baselines import LIMITS, SIMPLE
from jaxouter.evaluation.jobs import limit as best
from jaxouter.evaluation.policies import baseline, evaluate_on
from jaxouter.training.run import surroundings, write_json

HERE = Path(__file__).parent
RESULTS = HERE / "results"
SCENARIO = "pitch/paper"
OURS = {
    "default": (),
    "scratch (--base static)": ("--base", "static"),
    "record": ("--preset", "record"),
    "paper": ("--preset", "paper"),
}
PEERS = [(library, learner) for library in ("stable-baselines3", "sbx") for learner in ("DDPG", "TD3", "SAC", "PPO")]
PEERS.append(("sb3-contrib", "TRPO"))
NEAR = (1.25, 1.10, 1.05)  # times the limit

Point = dict[str, float]  # seconds, steps, mae


def limit(scenario: str = SCENARIO) -> float:
    """The least MAE of those that know the plant."""
    on = [scenarios.get(scenario)]
    policies = {name: baseline(name, scenario.partition("/")[0]) for name in (*LIMITS, *SIMPLE)}
    found = best({name: evaluate_on(policy, on)[scenario].figures for name, policy in policies.items()})
    assert found is not None
    return found


def ours(options: tuple[str, ...], seed: int, below: float, seconds: float, plant: str = "pitch") -> Iterator[Point]:
    """A training of ours, until the MAE is below or the time is over."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxouter.train", plant, *options, "--seed", str(seed), "--out", "run"]
        environment = os.environ | {"XDG_CACHE_HOME": str(Path(folder) / "cache"), "PYTHONPATH": str(HERE.parent)}
        metrics, seen = Path(folder) / "run" / f"seed-{seed}" / "metrics.jsonl", 0
        begun = time.perf_counter()
        nowhere = subprocess.DEVNULL
        with subprocess.Popen(command, cwd=folder, env=environment, stdout=nowhere, stderr=nowhere) as process:
            while process.poll() is None and time.perf_counter() - begun < seconds:
                time.sleep(0.05)
                rows = metrics.read_text().splitlines()[seen:] if metrics.exists() else []
                for row in map(json.loads, rows):
                    yield {"seconds": time.perf_counter() - begun, "steps": row["steps"], "mae": row["mae"]}
                    if row["mae"] <= below:
                        process.kill()
                seen += len(rows)
            process.kill()


def of_peers() -> str:
    """The interpreter of the peers."""
    script = ["bash", str(HERE.parent / "scripts" / "peers.sh")]
    return subprocess.run(script, check=True, capture_output=True, text=True).stdout.strip()


def peers(python: str, library: str, learner: str, seed: int, below: float, seconds: float) -> Iterator[Point]:
    """A training of a peer."""
    command = [python, str(HERE / "peers" / "quality.py"), library, learner, "--seed", str(seed)]
    command += ["--below", str(below), "--minutes", str(seconds / 60)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield from map(json.loads, process.stdout)


def reached(points: list[Point], level: float, seconds: float) -> Point:
    """Where the MAE was first below the level; the whole time where it never was."""
    never = {"seconds": seconds, "steps": float("nan"), "mae": float("nan")}
    return next((point for point in points if point["mae"] <= level), never)


def cell(values: list[float], unit: str) -> str:
    """Median, least and greatest."""
    low, middle, high = min(values), median(values), max(values)
    return f"{middle:,.0f} ({low:,.0f} to {high:,.0f}) {unit}"


def main(
    seeds: int = 5, with_peers: Annotated[bool, tyro.conf.arg(name="peers")] = False, minutes: float = 30.0
) -> None:
    """The command."""
    least, seconds = limit(), 60 * minutes
    levels = [near * least for near in NEAR]
    runs: dict[str, list[list[Point]]] = {}
    for name, options in OURS.items():
        for seed in range(seeds):
            runs.setdefault(name, []).append(list(ours(options, seed, levels[-1], seconds)))
            print(name, seed, runs[name][-1][-1:], flush=True)
    if with_peers:
        python = of_peers()
        for library, learner in PEERS:
            for seed in range(seeds):
                found = list(peers(python, library, learner, seed, levels[-1], seconds))
                runs.setdefault(f"{library} {learner}", []).append(found)
                print(library, learner, seed, found[-1:], flush=True)
    about = {"date": date.today().isoformat(), "machine": surroundings(), "limit": least, "minutes": minutes}
    write_json(RESULTS / "time-to-quality.json", about | {"runs": runs})
    lines = [
        f"Wall time of the whole process, from nothing cached, until the MAE on {SCENARIO} is within a factor of the "
        f"limit ({least:.3f} crad): median (least to greatest) of {seeds} seeds, at most {minutes:g} minutes.",
        "",
        "| | " + " | ".join(f"{near:g}" for near in NEAR) + f" | environment steps to {NEAR[1]:g} |",
        "|---|" + "---|" * (len(NEAR) + 1),
    ]
    for name, of_seeds in runs.items():
        at = [[reached(points, level, seconds) for points in of_seeds] for level in levels]
        times = [cell([point["seconds"] for point in each], "s") for each in at]
        lines.append(f"| {name} | {' | '.join(times)} | {cell([point['steps'] for point in at[1]], '')} |")
    command = "python benchmarks/time_to_quality.py" + (" --peers" if with_peers else "")
    text = "\n".join([*lines, "", f"`{command}`, {about['date']}"])
    (RESULTS / "time-to-quality.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
