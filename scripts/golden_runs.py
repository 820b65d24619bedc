"""Golden run folders: a small run of each preset of both plants, in tests/runs, which every later version must load.

    python scripts/golden_runs.py            # compares what their policies do with tests/runs/r_tilde.json
    python scripts/golden_runs.py --write    # makes them anew, with the version of this checkout; --only NAME ...: some

Make them anew only if the format of run folders changes on purpose; see CONTRIBUTING.md. They are made from the presets
with fewer steps and smaller networks, and evaluated on one episode of each scenario. Figures are not kept.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# isort: off
import jaxouter  # before JAX, as it configures JAX's messages

# isort: on
import numpy as np
import tyro

from jaxouter import tasks
from jaxouter.plants import make

FOLDER = Path(__file__).resolve().parent.parent / "tests" / "runs"
EXPECTED = FOLDER / "r_tilde.json"
PLANTS = ("pitch", "heaters")
STEPS = 10  # of the policy
TOLERANCE = 1e-4  # of the range of r~
NOT_KEPT = ("lock", "process")
OFF_POLICY = dict(steps=400, environments=1, epoch=100)
PRETRAINED = dict(environments=2, pretraining=dict(gradient_steps=20, episodes=8, batch_size=8))
PAIRED = dict(pairs=dict(rounds=1, states=64, kept=1, environments=2, horizon=5, updates=2, batch_size=8), compared=8)
OF_PITCH = (0.1, (("d1", 0.45), ("d2", 0.45))), (100.0, (("d1", 5.65), ("d2", 0.6)))
OF_HEATERS = (10.0, (("Pi", 0.42),)), (10.0, (("Pi", 18.0),))
BANKED = dict(gradient_steps=20, episodes=8, batch_size=8, closed_loop=8)
SETTINGS: dict[str, dict[str, Any]] = {
    "default": PAIRED | PRETRAINED,
    "scratch": PAIRED | OFF_POLICY,
    "record": PRETRAINED | dict(compared=8),
    "pitch-robust": dict(
        history=10, bank=OF_PITCH, environments=2, pretraining=BANKED | dict(lags=70, episode_steps=200)
    ),
    "heaters-robust": dict(history=10, bank=OF_HEATERS, environments=2, pretraining=BANKED),
    "paper": OFF_POLICY,
}
AGENT = dict(hidden=(16, 16), batch_size=32, prefill=200, replay=400)


def names() -> Iterator[tuple[str, str]]:
    """Plants, and the presets of each."""
    return ((plant, preset) for plant in PLANTS for preset in tasks.presets(plant))


def path(plant: str, preset: str) -> Path:
    """The folder of a golden run."""
    return FOLDER / f"{plant}-{preset}"


def acted(run: jaxouter.Run) -> list[float]:
    """What the policy of a run chooses after a step of r, on a y that approaches it."""
    low, high = make(run.config.plant)[0].setpoint_range
    y, r = low + 0.25 * (high - low), low + 0.75 * (high - low)
    carry, chosen = run.policy.init(r, y), []
    for _ in range(STEPS):
        carry, r_tilde = run.policy.act(carry, r, y)
        chosen.append(float(r_tilde))
        y += 0.2 * (r - y)
    return chosen


def deviation(run: jaxouter.Run) -> float:
    """The largest difference from what the policy chose when the run was made, in ranges of r~."""
    low, high = make(run.config.plant)[0].r_tilde_bounds
    expected = json.loads(EXPECTED.read_text())[run.path.name]
    return float(np.abs(np.subtract(acted(run), expected)).max() / (high - low))


def made(plant: str, preset: str) -> jaxouter.Run:
    """Train a golden run, and keep what a later version must read."""
    of_agent: dict[str, Any] = {f"agent.{name}": value for name, value in AGENT.items()}
    out = path(plant, preset)
    settings = (SETTINGS.get(out.name) or SETTINGS[preset]) | of_agent
    run = jaxouter.learn(plant, preset, out=out, progress=False, episodes=1, **settings)
    shutil.rmtree(out / "figures", ignore_errors=True)
    for name in NOT_KEPT:
        (out / name).unlink(missing_ok=True)
    older = sorted(out.glob("seed-*/checkpoint-*.npz"))[:-1]
    for checkpoint in older if preset != "paper" else ():  # whose newest one a test takes away
        checkpoint.unlink()
    return run


def main(write: bool = False, only: tuple[str, ...] = ()) -> None:
    """Compare the policies of the golden runs with what they did, or make the runs anew: all, or `only` some."""
    if write:
        expected = json.loads(EXPECTED.read_text()) if only else {}
        for name in names():
            if not only or path(*name).name in only:
                shutil.rmtree(path(*name), ignore_errors=True)
                expected[path(*name).name] = acted(made(*name))
        EXPECTED.write_text(json.dumps(expected, indent=1) + "\n")
    wrong = []
    for run in (jaxouter.load(path(*name)) for name in names()):
        if (far := deviation(run)) > TOLERANCE:
            wrong.append(f"{run.path.name} deviates by {far:.1g} of the range of r~")
    size = sum(file.stat().st_size for file in FOLDER.rglob("*") if file.is_file())
    print("\n".join(wrong) or f"{len(list(names()))} golden runs, {size / 1e6:.2f} MB: each policy does what it did")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
