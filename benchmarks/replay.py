"""What it costs to store windows of signals rather than packed transitions: updates a second, as a ratio.

Both fill a replay of the same number of steps, draw the same batch size and run the same update inside one jitted scan;
the packed one gathers one row that holds observation, action, reward, discount and next observation. Interleaved runs.

    python benchmarks/replay.py [--preset paper|default] [--updates 300] [--runs 5]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro

from jaxouter.agents.agent import Transitions
from jaxouter.training.config import preset
from jaxouter.training.off_policy import OffPolicyDriver
from jaxouter.training.trainer import build


def main(preset_name: Literal["paper", "default"] = "paper", updates: int = 300, runs: int = 5) -> None:
    trainer, params = build(preset("pitch", preset_name))
    driver, size = trainer.driver, trainer.env.observer.size
    assert isinstance(driver, OffPolicyDriver)
    state = trainer.prefill(trainer.start(0, params), params)
    steps = driver.replay.environments * driver.replay.steps
    packed = jax.random.normal(jax.random.key(0), (steps, 2 * size + 3)) * 0.1

    full = state.data._replace(written=jnp.asarray(driver.replay.steps))

    def from_windows(key: jax.Array) -> Transitions:
        bits = jax.random.bits(key, (driver.data.batch_size, driver.data.bits))
        return driver.batch(state._replace(data=full), params, bits)

    def from_packed(key: jax.Array) -> Transitions:
        rows = packed[jax.random.randint(key, (driver.data.batch_size,), 0, steps)]
        obs, action, reward, discount, next_obs = jnp.split(rows, [size, size + 1, size + 2, size + 3], axis=1)
        return Transitions(obs, action, reward[:, 0], discount[:, 0], next_obs)

    def loop(batch: Callable[[jax.Array], Transitions]) -> Callable[[Any], Any]:
        def step(learner: Any, key: jax.Array) -> tuple[Any, None]:
            return trainer.agent.update(learner, batch(key), key)[0], None

        keys = jax.random.split(jax.random.key(1), updates)
        return jax.jit(lambda learner: jax.lax.scan(step, learner, keys)[0])

    loops = {"windows": loop(from_windows), "packed": loop(from_packed)}
    rates: dict[str, list[float]] = {name: [] for name in loops}
    for function in loops.values():
        jax.block_until_ready(function(state.agent))
    for _ in range(runs):
        for name, function in loops.items():
            begin = time.perf_counter()
            jax.block_until_ready(function(state.agent))
            rates[name].append(updates / (time.perf_counter() - begin))
    for name, values in rates.items():
        print(f"{name:8} {median(values):7.0f} updates/s (min {min(values):.0f}, max {max(values):.0f})")
    ratio = median(a / b for a, b in zip(rates["windows"], rates["packed"], strict=True))
    print(f"windows / packed {ratio:.3f}; bytes a step {4 * len(driver.replay.fields)} and {4 * packed.shape[1]}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
