"""A heated room whose thermostat falls short: a plant with presets, scenarios and a sweep of its own."""

import jax.numpy as jnp
from flax import struct

from jaxouter.plants import Plant
from jaxouter.tasks import Axis, Scenario, Sweep, Task


@struct.dataclass
class Params:
    tau: jnp.ndarray  # h
    outside: jnp.ndarray  # degC


def make(tau=3.0, outside=0.0):
    return ROOM, Params(tau=jnp.asarray(tau, float), outside=jnp.asarray(outside, float))


ROOM = Plant(
    name="Room",
    init=lambda key, params: jnp.asarray(18.0, float),
    step=lambda params, y, r_tilde, key: y + (0.8 * r_tilde + 0.2 * params.outside - y) / params.tau,
    output=lambda params, y: y,
    y_unit="degC", time_unit="h", control_step=1.0, episode_steps=40,
    r_tilde_bounds=(0.0, 50.0), setpoint_range=(15.0, 25.0), families=("steps",), affine=True,
)  # fmt: skip
Room = Task(
    make=make,
    presets={
        "quick": {
            "pretraining.gradient_steps": 20,
            "pretraining.episodes": 8,
            "agent.hidden": (8, 8),
            "pairs.rounds": 0,
        }
    },
    scenarios={
        "day": Scenario((20.0, 16.0)),
        "frost": Scenario((20.0,), set={"outside": -15.0}, change={"outside": -20.0}, noise=0.1, episodes=2),
    },
    reported=("day",),
    stability=("day", "frost"),
    sweeps={"tau": Sweep("day", (Axis("tau", "h", (2.0, 3.0, 6.0), 3.0),), lambda p, n, tau: p.replace(tau=tau))},
)
