"""Train stable-baselines3's DDPG on the pitch plant, and compare it with the inner loop alone.

    PYTHONPATH=. $(bash scripts/peers.sh) scripts/examples/sb3.py

The replay is first filled under random r~, each held for about a second, since DDPG from scratch saturates for long.
Then it makes as many updates as environment steps, a minute on 2 cores. It prints the mean of |r - y| over held-out
episodes, and exits with status 1 if the learned policy is not better than both the untrained actor and the inner loop
alone. `make_vec` steps all episodes at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

import jaxouter.runtime.gymnasium  # noqa: F401 - registers the id
from jaxouter import plants

ID = "jaxouter/Pitch-v0"
ENVIRONMENTS = 16
RECORDED = 1000  # random steps of each
EPISODES = 64  # of the evaluation
HELD_OUT = 10_000  # first seed of the evaluation
REWARD_SCALE = 0.1  # brings the critic's values to the order of 1 to 10

Choose = Callable[[np.ndarray, np.ndarray], np.ndarray]


def mae(choose: Choose) -> float:
    """MAE over held-out episodes, crad; `choose(obs, r)` gives the actions.

    The last step is left out, as its observation is from the next episode.
    """
    loops = gymnasium.make_vec(ID, num_envs=EPISODES)
    obs, infos = loops.reset(seed=HELD_OUT)
    errors = []
    for _ in range(loops.unwrapped.functional.plant.episode_steps - 1):
        obs, _, _, _, infos = loops.step(choose(obs, infos["r"]))
        errors.append(np.abs(infos["r"] - infos["y"]))
    return float(np.mean(errors))


def inner_loop_alone(obs: np.ndarray, r: np.ndarray) -> np.ndarray:
    """r~ = r as an action, which is -1 and 1 at the bounds of r~."""
    low, high = plants.make("pitch")[0].r_tilde_bounds
    return ((2.0 * r - low - high) / (high - low))[:, None]


def record(model: DDPG, seed: int) -> None:
    """Fill the replay with random r~, each held for ten steps on average."""
    loops, rng = gymnasium.make_vec(ID, num_envs=ENVIRONMENTS), np.random.default_rng(seed)
    obs, _ = loops.reset(seed=seed)
    action = np.zeros((ENVIRONMENTS, 1), np.float32)
    for k in range(RECORDED):
        fresh = rng.uniform(-1.0, 1.0, action.shape).astype(np.float32)
        action = np.where((k == 0) | (rng.random(action.shape) < 0.1), fresh, action)
        after, reward, terminated, truncated, infos = loops.step(action)
        ended, last = terminated | truncated, after.copy()
        for i in np.flatnonzero(ended):
            last[i] = infos["final_obs"][i]
        limits = [{"TimeLimit.truncated": bool(each)} for each in truncated]
        model.replay_buffer.add(obs, last, action, REWARD_SCALE * reward, ended, limits)
        obs = after


def main() -> None:
    """Parse, train, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=6000, help="environment steps, and updates (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="for networks, noise and episodes (default: %(default)s)")
    options = parser.parse_args()
    if options.steps < 1:
        parser.error(f"--steps is {options.steps}; it must be at least 1")
    torch.set_num_threads(1)  # several threads busy-wait for each other, which is slow on shared cores
    envs = make_vec_env(
        ID,
        ENVIRONMENTS,
        seed=options.seed,
        env_kwargs={"render_mode": None},  # else it first tries to render
        wrapper_class=gymnasium.wrappers.TransformReward,
        wrapper_kwargs={"func": lambda reward: REWARD_SCALE * reward},
    )
    model = DDPG(
        "MlpPolicy",
        envs,
        learning_rate=3e-4,
        buffer_size=100_000,
        learning_starts=0,
        batch_size=256,
        gamma=0.97,
        train_freq=1,
        gradient_steps=-1,  # as many as environment steps
        action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)),
        policy_kwargs={"net_arch": [128, 128]},
        seed=options.seed,
        device="cpu",
    )

    def learned(obs: np.ndarray, r: np.ndarray) -> np.ndarray:
        return model.predict(obs, deterministic=True)[0]

    alone, before = mae(inner_loop_alone), mae(learned)
    record(model, options.seed)
    model.learn(options.steps)
    after = mae(learned)
    print(f"MAE {after:.2f} crad after {options.steps} steps; untrained {before:.2f}, inner loop alone {alone:.2f}")
    sys.exit(not after < min(before, alone))


if __name__ == "__main__":
    main()
