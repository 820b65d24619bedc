"""Compares `pitch_numpy.py` with jaxouter's environment: the same starts, set-points and random r~, step by step.

In jaxouter's own environment, with its extra for Gymnasium:

    python benchmarks/peers/check.py

Prints the largest differences and ends with status 1 where one is too large: y by 1e-3 crad, reward and observation by
what that makes of them.
"""

from __future__ import annotations

import sys
import warnings

import jax
import numpy as np
from gymnasium.utils.env_checker import check_env
from pitch_numpy import EPISODE, Pitch

import jaxouter

ALLOWED = {"y": 1e-3, "reward": 2e-3, "observation": 1e-4}  # crad, reward, scaled


def random_r_tilde(rng: np.random.Generator) -> np.ndarray:
    """An episode of r~, at times beyond its bounds: held jumps with small moves on top; float32 (200,)."""
    jumps = np.repeat(rng.uniform(-70.0, 70.0, EPISODE), rng.integers(1, 30, EPISODE))[:EPISODE]
    return (jumps + rng.uniform(-2.0, 2.0, EPISODE)).astype(np.float32)


def largest_differences(episodes: int) -> dict[str, float]:
    """Over that many episodes, the last of which starts so that it diverges.

    Raises:
        AssertionError: an episode does not end alike in both, or not as it should.
    """
    env, params = jaxouter.make("pitch")
    step, rng, ours = jax.jit(env.step_env), np.random.default_rng(0), Pitch()
    worst = dict.fromkeys(ALLOWED, 0.0)
    for episode in range(episodes):
        obs, state = env.reset(jax.random.key(episode), params)
        if episode == episodes - 1:
            plant = state.plant._replace(x=state.plant.x.at[2:].set(np.array([40.0, 55.0])))
            memory, obs = env.observer.observe(env.observer.init(state.r, plant.x[3]), state.r, plant.x[3])
            state = state._replace(plant=plant, memory=memory, y=plant.x[3], y_seen=plant.x[3])
        obs_numpy, _ = ours.reset(options={"x": np.asarray(state.plant.x), "r": float(state.r)})
        worst["observation"] = max(worst["observation"], float(np.max(np.abs(obs - obs_numpy))))
        for r_tilde in random_r_tilde(rng):
            obs, state, reward, terminated, truncated, _ = step(jax.random.key(0), state, r_tilde, params)
            obs_numpy, reward_numpy, *ended = ours.step(np.array([r_tilde]))
            assert ended[:2] == [bool(terminated), bool(truncated)], (episode, ended, terminated, truncated)
            found = {
                "y": abs(float(state.y) - ours.y),
                "reward": abs(float(reward) - reward_numpy),
                "observation": float(np.max(np.abs(np.asarray(obs) - obs_numpy))),
            }
            worst = {name: max(worst[name], found[name]) for name in worst}
            if any(ended[:2]):
                assert ended[0] == (episode == episodes - 1), f"episode {episode} ended by divergence: {ended[0]}"
                break
    return worst


def main() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the action's bounds: r~ is in crad here, as in jaxouter
        check_env(Pitch(), skip_render_check=True)
    worst = largest_differences(episodes=6)
    for name, value in worst.items():
        print(f"{name:12} differs by at most {value:.1e} (allowed: {ALLOWED[name]:g})")
    sys.exit(any(value > ALLOWED[name] for name, value in worst.items()))


if __name__ == "__main__":
    main()
