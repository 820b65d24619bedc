"""The paper's space heaters: presets, scenarios (the paper's and others), sweeps."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxouter.plants import heaters
from jaxouter.tasks.task import Axis, Families, Scenario, Sweep, Task

SETPOINTS = (15.0, 20.0, 17.0, 22.0)  # degC, 50 h each
NOISE_SEEDS = 32
HOUSES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0)
MANY = {"n": 1000, "x0_mean": 17.8}

HOURLY = {"integral_steps": None, "reward_scale": 1.0, "agent.discount": 0.95}
RECORD = {
    **HOURLY,
    "correction": 0.6,
    "pretraining.gradient_steps": 2_000,
    "disturbances.noise": 0.02,
    "disturbances.load": 0.2,
}
DEFAULT = {**RECORD, "reward.beta_h": 0.06, "reward.delta_b": 2.0, "pairs.rounds": 30, "pairs.change": 0.1}
SCRATCH = {
    **HOURLY,
    "agent.n_step": 3,
    "agent.updates": 3,
    "agent.noise_sigma": (0.005, 0.05),
    "pairs.horizon": 24,
}
# From a slow local law to one as fast as the Riccati root's; weather and houses of the slow one. Laws that pay less for
# moves leave the comfort limit where another law acts than that of the plant.
BANK = tuple(
    (10.0, numbers)
    for numbers in (
        (("Pi", 0.42),),
        (("Pi", 0.3),),
        (("Pi", 0.6),),
        (("Pi", 1.0),),
        (("Pi", 2.0),),
        (("Pi", 4.0),),
        (("Pi", 8.0),),
        (("Pi", 18.0),),
        (("Pi", 0.4), ("x_out", -20.0)),
        (("Pi", 0.4), ("x_out", 5.0)),
        (("Pi", 0.4), ("Ca", 13.0), ("Ua", 0.14)),
        (("Pi", 0.4), ("Ca", 7.0), ("Ua", 0.26)),
    )
)
ROBUST = {
    **RECORD,
    "base": "bank",
    "bank": BANK,
    "correction": 1.0,
    "pairs.rounds": 0,
    "compared": 0,
    "history": 20,
    "reward.beta_h": 0.06,
    "reward.delta_b": 6.0,
    "pretraining.gradient_steps": 3_000,
    "pretraining.closed_loop": 64,
    "pretraining.lags": 20,
}


def _mixed_stock(params: Any) -> Any:
    """Ca and Ua of each house uniform within 30 %, drawn anew for each episode."""
    shape, house = params.weights.shape, params.house
    key_Ca, key_Ua = jax.random.split(jax.random.key(1))
    house = house.replace(
        Ca=house.Ca[:, None] * jax.random.uniform(key_Ca, shape, float, 0.7, 1.3),
        Ua=house.Ua[:, None] * jax.random.uniform(key_Ua, shape, float, 0.7, 1.3),
    )
    return params.replace(house=house)


def _own_start(params: Any, key: jax.Array, episodes: int) -> Any:
    """A random mean temperature at the start of each episode."""
    low, high = heaters.HEATERS.setpoint_range
    return params.replace(x0_mean=jax.random.uniform(key, (episodes,), float, low, high))


def _houses(params: Any, repeats: int, houses: jax.Array) -> Any:
    """Only the first `houses` have weight: all counts share one shape, and so one compilation."""
    del repeats
    counts = jnp.arange(int(max(HOUSES)), dtype=houses.dtype)[None, :] < houses[:, None]
    return params.replace(weights=jnp.where(counts, 1.0 / houses[:, None], 0.0))


def _x_out(params: Any, repeats: int, x_out: jax.Array) -> Any:
    del repeats
    return params.replace(house=params.house.replace(x_out=x_out))


def _heterogeneity(params: Any, repeats: int, spread: jax.Array) -> Any:
    """Ca and Ua of each house uniform within `spread` %, drawn anew per repeat; each local law knows its own."""
    house, (episodes, n) = params.house, params.weights.shape
    stock = jax.random.uniform(jax.random.key(2), (2, repeats, n), float, -1.0, 1.0)
    factor = 1.0 + spread[None, :, None] / 100.0 * stock[:, jnp.arange(episodes) % repeats]
    return params.replace(house=house.replace(Ca=house.Ca[:, None] * factor[0], Ua=house.Ua[:, None] * factor[1]))


HEATERS = Task(
    make=heaters.make,
    presets={"default": DEFAULT, "scratch": SCRATCH, "record": RECORD, "robust": ROBUST, "paper": {"steps": 400_000}},
    scenarios={
        "paper-4": Scenario(SETPOINTS, episodes=NOISE_SEEDS, paper=(15.62, 1.17)),
        "paper-1000": Scenario(SETPOINTS, MANY, episodes=NOISE_SEEDS, paper=(15.07, 1.31)),
        "riccati": Scenario(SETPOINTS, {"Pi": 17.186}, episodes=NOISE_SEEDS),
        "cold": Scenario(SETPOINTS, {"x_out": -15.0}, episodes=NOISE_SEEDS),
        "mixed-stock": Scenario(SETPOINTS, episodes=NOISE_SEEDS, adapt=_mixed_stock),
        "load": Scenario(SETPOINTS, MANY, change={"x_out": -15.0}, episodes=NOISE_SEEDS),
        "noise": Scenario(SETPOINTS, MANY, episodes=NOISE_SEEDS, noise=0.1, smooth=True),
    },
    reported=("paper-4", "paper-1000"),
    stability=("paper-4", "riccati", "mixed-stock"),
    families=Families({"n": 1000}, _own_start),
    sweeps={
        "houses": Sweep("paper-1000", (Axis("houses", "1", HOUSES, 1000.0),), _houses, stride=2, repeats=2),
        "x-out": Sweep(
            "paper-1000", (Axis.linear("x_out", "degC", -20.0, 10.0, 13, -5.0),), _x_out, stride=3, repeats=4
        ),
        "heterogeneity": Sweep(
            "paper-1000", (Axis.linear("spread", "%", 0.0, 50.0, 11, 0.0),), _heterogeneity, stride=2, repeats=4
        ),
        "sensor-noise": Sweep("paper-1000", (Axis.linear("noise", "degC", 0.0, 0.5, 21, 0.0),), repeats=4),
    },
    start=("x0_mean", "x0_spread", "weights"),
)
