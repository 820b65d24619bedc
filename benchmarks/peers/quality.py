"""A peer's MAE on pitch/paper over the time it learns, with its own default settings, stepping `pitch_numpy.py`.

    PYTHON=$(bash scripts/peers.sh)
    $PYTHON benchmarks/peers/quality.py stable-baselines3 SAC --seed 0 --below 2.87 --minutes 30

Prints a line of JSON for each evaluation, every five episodes: seconds since the process began (without those that the
evaluations took), environment steps, MAE (crad). It ends at the first MAE below `--below`, or when the time is over.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time

BEGUN = time.perf_counter()  # before the imports, which a user waits for too

import numpy as np  # noqa: E402
from pitch_numpy import EPISODE, Pitch  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.noise import NormalActionNoise  # noqa: E402  # pyright: ignore[reportMissingImports]

ENVIRONMENTS = 8
SETPOINT = 14.66  # crad, of pitch/paper
ON_POLICY = ("PPO", "TRPO")
EVERY = 5 * EPISODE  # environment steps between two evaluations


def mae(model: object) -> float:
    """MAE on pitch/paper: one step from rest."""
    env, errors = Pitch(), []
    obs, _ = env.reset(options={"x": np.zeros(4), "r": SETPOINT})
    for _ in range(EPISODE):
        obs, *_ = env.step(model.predict(obs, deterministic=True)[0])  # pyright: ignore[reportAttributeAccessIssue]
        errors.append(abs(SETPOINT - env.y))
    return float(np.mean(errors))


class Watch(BaseCallback):
    """Evaluates now and then, and stops the learning at the wanted MAE or when the time is over."""

    def __init__(self, below: float, seconds: float) -> None:
        super().__init__()
        self.below, self.seconds, self.looked, self.evaluating = below, seconds, 0, 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps - self.looked < EVERY:
            return True
        begun, self.looked = time.perf_counter(), self.num_timesteps
        row = {"seconds": begun - BEGUN - self.evaluating, "steps": self.num_timesteps, "mae": mae(self.model)}
        print(json.dumps(row), flush=True)
        self.evaluating += time.perf_counter() - begun
        return row["mae"] > self.below and row["seconds"] < self.seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", choices=["stable-baselines3", "sb3-contrib", "sbx"])
    parser.add_argument("learner", choices=["DDPG", "TD3", "SAC", "PPO", "TRPO"])
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--below", type=float, default=0.0, help="MAE at which to stop, crad (default: never)")
    parser.add_argument("--minutes", type=float, default=30.0, help="longest time (default: %(default)s)")
    options = parser.parse_args()
    learners = importlib.import_module(
        {"sbx": "sbx", "sb3-contrib": "sb3_contrib"}.get(options.package, "stable_baselines3")
    )
    env = make_vec_env(Pitch, ENVIRONMENTS, seed=options.seed)
    settings = {} if options.learner in ON_POLICY else {"gradient_steps": -1}
    if options.learner in ("DDPG", "TD3"):
        settings["action_noise"] = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    model = getattr(learners, options.learner)("MlpPolicy", env, seed=options.seed, device="cpu", **settings)
    model.learn(10**9, callback=Watch(options.below, 60 * options.minutes))


if __name__ == "__main__":
    main()
