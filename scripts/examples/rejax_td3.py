"""Train rejax's TD3 on the pitch plant, and compare it with the inner loop alone.

    PYTHONPATH=. $(bash scripts/peers.sh rejax) scripts/examples/rejax_td3.py

rejax is used as it is. It expects the environments of gymnax 0.0, as `jaxouter.runtime.gymnax` makes them. That also
scales: actions of -1 and 1 are the bounds of r~, and rewards are a tenth, so that the critic's values are of the order
of 1 to 10. TD3 makes one update for each step of 8 environments, a minute on 2 cores. The script prints the mean of
|r - y| over held-out episodes, and exits with status 1 if the learned policy is not better than both the untrained
actor and the inner loop alone.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
from rejax import TD3

from jaxouter.runtime import gymnax

ENVIRONMENTS = 8
EPISODES = 64  # of the evaluation
HELD_OUT = 10_000  # seed of the evaluation

Choose = Callable[[jax.Array, jax.Array], jax.Array]


def mae(env: gymnax.OuterLoop, params: gymnax.EnvParams, choose: Choose) -> float:
    """MAE over held-out episodes, crad; `choose(obs, r)` gives the action."""

    def episode(key: jax.Array) -> jax.Array:
        key, key_reset = jax.random.split(key)

        def step(carry, key):
            obs, state = carry
            obs, state, _, _, info = env.step(key, state, choose(obs, state.r), params)
            return (obs, state), jnp.abs(info["r"] - info["y"])

        start = env.reset(key_reset, params)
        return jax.lax.scan(step, start, jax.random.split(key, params.max_steps_in_episode))[1]

    return float(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(HELD_OUT), EPISODES)).mean())


def main() -> None:
    """Parse, train, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=128_000, help="environment steps (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="for networks, noise and episodes (default: %(default)s)")
    options = parser.parse_args()
    if options.steps < 1:
        parser.error(f"--steps is {options.steps}; it must be at least 1")
    env, params = gymnax.make("pitch", reward_scale=0.1)
    low, high = env.functional.plant.r_tilde_bounds
    learner = TD3.create(
        env=env,
        env_params=params,
        num_envs=ENVIRONMENTS,
        total_timesteps=options.steps,
        eval_freq=options.steps,
        skip_initial_evaluation=True,
        fill_buffer=4_000,  # with random actions
        buffer_size=16_384,  # rejax sorts the whole of it to draw a batch, which takes most of the time
        batch_size=256,
        learning_rate=3e-4,
        gamma=0.97,
        exploration_noise=0.1,
        target_noise=0.05,
        target_noise_clip=0.1,
    )
    key = jax.random.key(options.seed)

    def policy(trained) -> Choose:
        act = learner.make_act(trained)
        return lambda obs, r: act(obs, key)  # TD3 acts without noise

    alone = mae(env, params, lambda obs, r: (2.0 * r - low - high) / (high - low))
    before = mae(env, params, policy(learner.init_state(key)))
    trained, _ = jax.jit(learner.train)(key)
    after = mae(env, params, policy(trained))
    print(f"MAE {after:.2f} crad after {options.steps} steps; untrained {before:.2f}, inner loop alone {alone:.2f}")
    sys.exit(not after < min(before, alone))


if __name__ == "__main__":
    main()
