"""Updates a second of a peer's DDPG on the work of our preset `paper`, stepping `pitch_numpy.py`.

    PYTHON=$(bash scripts/peers.sh)
    $PYTHON benchmarks/peers/run.py sbx --updates 1000 --json

400-300, batch 64, one update a step, on the CPU, but for what a library does not offer: stable-baselines3 has one
learning rate for actor and critic, and in neither can the action enter the critic at its second layer or the critic
alone have an L2 penalty. The replay is allocated for 1e6 rows and holds those of the run. PyTorch and JAX use as many
threads as they choose. PyTorch's wait for each other busily: where other programs want the cores too, its rate falls to
a small part, so measure on a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
from pitch_numpy import Pitch
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise  # pyright: ignore[reportMissingImports]

PACKAGES = {
    "stable-baselines3": ["stable-baselines3", "torch", "gymnasium", "numpy"],
    "sbx": ["sbx-rl", "stable-baselines3", "jax", "jaxlib", "gymnasium", "numpy"],
}
LEARNING_STARTS = 200  # steps with random actions, as the preset


class Timed(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Adds up the seconds that pass inside the environment."""

    seconds = 0.0

    def reset(self, **options: Any) -> Any:
        """As the environment."""
        begin = time.perf_counter()
        result = self.env.reset(**options)
        self.seconds += time.perf_counter() - begin
        return result

    def step(self, action: np.ndarray) -> Any:
        """As the environment."""
        begin = time.perf_counter()
        result = self.env.step(action)
        self.seconds += time.perf_counter() - begin
        return result


def learner(library: str, env: gymnasium.Env[np.ndarray, np.ndarray]) -> Any:
    """The library's DDPG with the settings of our preset `paper`."""
    if library == "sbx":
        from sbx import DDPG  # pyright: ignore[reportMissingImports]

        rates = {"learning_rate": 1e-4, "qf_learning_rate": 1e-3}
    else:
        from stable_baselines3 import DDPG  # pyright: ignore[reportMissingImports]

        rates = {"learning_rate": 1e-4}
    return DDPG(
        "MlpPolicy",
        env,
        **rates,
        buffer_size=1_000_000,
        learning_starts=LEARNING_STARTS,
        batch_size=64,
        tau=0.001,
        gamma=0.99,
        train_freq=1,
        gradient_steps=1,
        action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.2 * np.ones(1), theta=0.15, dt=1.0),
        policy_kwargs={"net_arch": [400, 300]},
        seed=0,
        device="cpu",
    )


def seconds_of(model: Any, updates: int) -> float:
    """Seconds that so many environment steps take, with an update each."""
    done, begin = model._n_updates, time.perf_counter()
    model.learn(updates, reset_num_timesteps=False)
    seconds = time.perf_counter() - begin
    if model._n_updates - done != updates:
        raise RuntimeError(f"{model._n_updates - done} updates were made in {updates} steps; they should be as many")
    return seconds


def measure(library: str, updates: int, windows: int) -> dict[str, Any]:
    """Rates of `windows` windows, and from one more the environment's share of the time."""
    model = learner(library, Pitch())
    model.learn(LEARNING_STARTS + 100)  # fills what must be filled and compiles
    seconds_of(model, updates)
    rates = [updates / seconds_of(model, updates) for _ in range(windows)]
    timed = Timed(Pitch())
    model.set_env(timed)
    total = seconds_of(model, updates)
    versions = {name: version(name) for name in PACKAGES[library]}
    return {
        "case": f"peer/{library}",
        "rates": rates,
        "unit": "updates/s",
        "environment_share": timed.seconds / total,
        "versions": {"python": platform.python_version(), **versions},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", choices=list(PACKAGES))
    parser.add_argument("--updates", type=int, default=1000, help="updates of each window (default: %(default)s)")
    parser.add_argument("--windows", type=int, default=5, help="windows to measure (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    options = parser.parse_args()
    for name in ("updates", "windows"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} is {getattr(options, name)}; it must be at least 1")
    row = measure(options.peer, options.updates, options.windows)
    if options.json:
        print(json.dumps(row))
    else:
        low, middle, high = np.quantile(row["rates"], [0.0, 0.5, 1.0])
        share = 100 * row["environment_share"]
        print(f"{row['case']}: {middle:.0f} {row['unit']} ({low:.0f} to {high:.0f}), {share:.1f} % in the environment")


if __name__ == "__main__":
    main()
