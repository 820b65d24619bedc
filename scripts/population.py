"""Simulate a large population of houses on several devices under the static prefilter; prints speed, memory and MAE.

python scripts/population.py --houses 10000000 --devices 2 --hours 200
"""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import tyro

from jaxouter import cli, plants
from jaxouter.identification import steady_state
from jaxouter.plants import Plant
from jaxouter.plants.heaters import Law
from jaxouter.training.devices import Processes, connect, spread


@dataclass(frozen=True)
class Options:
    """Simulate a large population of houses on several devices, under the static prefilter."""

    houses: int = 10_000_000
    """Houses, a multiple of the devices."""
    devices: int = 1
    """Devices to split them over."""
    hours: int = 200
    """Length of the run."""
    law: Law = "euler-maruyama"
    """How the noise of an hour is drawn."""
    r: float = 20.0
    """Set-point of the mean temperature, degC."""
    seed: int = 0
    """Seed of starts and noise."""


@partial(jax.jit, static_argnums=(0, 4))
def run(plant: Plant, params: Any, r_tilde: jax.Array, key: chex.PRNGKey, hours: int) -> tuple[jax.Array, jax.Array]:
    """Mean temperature (hours,), and the share of houses that moved by more than the comfort limit in each hour."""
    key_start, key_run = jax.random.split(key)
    limit = plant.rate_limit or jnp.inf

    def step(state: Any, key: chex.PRNGKey) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        after = plant.step(params, state, r_tilde, key)
        outside = jnp.abs(after.x - state.x) > limit
        return after, (plant.output(params, after), jnp.mean(outside.astype(float)))

    return jax.lax.scan(step, plant.init(key_start, params), jax.random.split(key_run, hours))[1]


def main() -> None:
    """The script."""
    options = tyro.cli(Options)
    with cli.user_errors():
        connect(options.devices, Processes())
        base = steady_state.static(*plants.make("heaters"), jax.random.key(options.seed))[1]  # of four houses
        plant, params = plants.make("heaters", n=options.houses, law=options.law)
        params = spread(params, options.houses, options.devices)
    r_tilde = jnp.clip(base.offset + base.r * options.r, *plant.r_tilde_bounds)
    begun = time.perf_counter()
    compiled = run.lower(plant, params, r_tilde, jax.random.key(options.seed), options.hours).compile()
    compiling = time.perf_counter() - begun
    y, outside = jax.block_until_ready(compiled(params, r_tilde, jax.random.key(options.seed)))
    seconds = time.perf_counter() - begun - compiling
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # KiB on Linux
    print(f"{options.houses:,} houses, {options.hours} h, {options.devices} devices ({jax.devices()[0].device_kind})")
    rate = options.houses * options.hours / seconds
    print(f"compiled in {compiling:.1f} s, run in {seconds:.1f} s: {rate:,.0f} house-hours/s")
    print(f"peak memory {peak:.2f} GiB")
    print(f"MAE {jnp.mean(jnp.abs(y - options.r)):.3f} degC")
    print(f"outside {plant.rate_limit:g} degC/h: {100 * jnp.mean(outside):.2f} % of house-hours")


if __name__ == "__main__":
    cli.run(main)
