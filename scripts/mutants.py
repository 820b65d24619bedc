"""Mutation test: break the code on purpose, in ten places, and see whether the tests notice.

    python scripts/mutants.py          # writes benchmarks/results/mutants.md; about ten minutes

Each change is made in a copy of the repository, where only the test file named with it is run. The exit status is 1 if
no test notices a change.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "mutants.md"


@dataclass(frozen=True)
class Mutant:
    """One place, and how it is broken."""

    what: str
    file: str
    code: str
    broken: str
    tests: str


MUTANTS = (
    Mutant(
        "sign of the controller's integrator",
        "jaxouter/plants/pitch.py", "F = F.at[:4, 4].set(-p.gain", "F = F.at[:4, 4].set(p.gain",
        "tests/plants/test_pitch.py",
    ),
    Mutant(
        "delays one sample too long",
        "jaxouter/plants/delay.py", "left = newest + offset.astype(newest.dtype)",
        "left = newest - 1 + offset.astype(newest.dtype)", "tests/plants/test_delay.py",
    ),
    Mutant(
        "no bootstrap where time is up",
        "jaxouter/agents/returns.py", "jnp.where(terminated[last], 0.0, 1.0)",
        "jnp.where(terminated[last] | truncated[last], 0.0, 1.0)", "tests/agents/test_ddpg.py",
    ),
    Mutant(
        "soft update the wrong way round",
        "jaxouter/agents/ddpg.py", "incremental_update(actor, state.target_actor, cfg.polyak)",
        "incremental_update(state.target_actor, actor, cfg.polyak)", "tests/agents/test_ddpg.py",
    ),
    Mutant(
        "moves of just the threshold are free",
        "jaxouter/loop/rewards.py", "delta >= rho", "delta > rho", "tests/loop/test_rewards.py",
    ),
    Mutant(
        "noise of an Euler-Maruyama step grows with the step, not its root",
        "jaxouter/plants/heaters.py", "p.sigma * jnp.sqrt(h / params.houses)",
        "p.sigma * h * jnp.sqrt(1.0 / params.houses)", "tests/plants/test_heaters.py",
    ),
    Mutant(
        "the observation holds the true output",
        "jaxouter/loop/environment.py", "self.observer.record(state.memory, state.y_seen, loop.r_tilde)",
        "self.observer.record(state.memory, state.y, loop.r_tilde)", "tests/loop/test_environment.py",
    ),
    Mutant(
        "windows at the end of the replay's ring are stale",
        "jaxouter/agents/replay.py", "buffer, slab, twin, 1)", "buffer, slab, position, 1)",
        "tests/agents/test_replay.py",
    ),
    Mutant(
        "a loss that is not finite reaches the networks",
        "jaxouter/agents/updates.py", "finite = jnp.isfinite(loss)", "finite = ~jnp.isnan(loss)",
        "tests/agents/test_ddpg.py",
    ),
    Mutant(
        "checksums are not compared",
        "jaxouter/training/checkpoint.py", ".digest() != digest:", ".digest() == b'':",
        "tests/training/test_run.py",
    ),
)  # fmt: skip


def failing(mutant: Mutant, broken: bool = True) -> str | None:
    """The first test that fails with the change (`broken` False: without it); None: none fails.

    Raises:
        RuntimeError: the code to break is not there exactly once.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        for part in ("jaxouter", "tests"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        for part in ("pyproject.toml", "scripts", "benchmarks", "README.md"):
            (copy / part).symlink_to(ROOT / part)
        path = copy / mutant.file
        text = path.read_text()
        if text.count(mutant.code) != 1:
            raise RuntimeError(
                f"{mutant.file} has {mutant.code!r} {text.count(mutant.code)} times; it must be there once"
            )
        path.write_text(text.replace(mutant.code, mutant.broken if broken else mutant.code))
        command = [sys.executable, "-m", "pytest", "-x", "--no-header", "-p", "no:cacheprovider", mutant.tests]
        done = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    failed = [line.split(" ")[1] for line in done.stdout.splitlines() if line.startswith("FAILED ")]
    if done.returncode not in (0, 1) or (done.returncode == 1) != bool(failed):
        raise RuntimeError(f"the tests did not run: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return failed[0] if failed else None


def main(out: Path = RESULTS) -> None:
    """Break each place in turn, and write which test noticed."""
    rows, whole = [], set()
    for mutant in MUTANTS:
        if mutant.tests not in whole:
            whole.add(mutant.tests)
            if already := failing(mutant, broken=False):
                raise RuntimeError(f"{already} fails without any change")
        test = failing(mutant)
        rows.append((mutant.what, f"`{mutant.file}`", "nothing" if test is None else f"`{test}`"))
        print(" | ".join(rows[-1]), flush=True)
    lines = [
        "# Broken on purpose",
        "",
        f"By `python scripts/mutants.py` on {date.today()}: what was broken, and the first test that fails.",
    ]
    lines += ["", "| what | where | noticed by |", "| --- | --- | --- |", *(f"| {' | '.join(row)} |" for row in rows)]
    out.write_text("\n".join(lines) + "\n")
    noticed = sum(row[-1] != "nothing" for row in rows)
    print(f"{noticed} of {len(rows)} noticed")
    if noticed < len(rows):
        raise SystemExit(1)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
