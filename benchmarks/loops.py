"""Loops in which a linear law is wrong, each in its own way: a drive's speed under a PI controller that is too fast.

    python -m jaxouter.train benchmarks/loops.py:RateLimited

The speed follows the actuator with a lag of two seconds. The actuator sticks, saturates, or moves slowly.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxouter.plants import Plant

SUBSTEPS = 5
SUBSTEP = 0.04  # s
LAG = 2.0  # s


@struct.dataclass
class Params:
    """Parameters."""

    kp: jax.Array  # of the PI controller
    ki: jax.Array  # 1/s
    dead_band: jax.Array  # smallest move that the actuator makes
    limit: jax.Array  # greatest output of the actuator
    rate: jax.Array  # its fastest move, 1/s


class State(NamedTuple):
    """Speed, integral of the error (s), output of the actuator."""

    speed: jax.Array
    integral: jax.Array
    actuator: jax.Array


def init(key: jax.Array, params: Params) -> State:
    del key
    nothing = jnp.zeros_like(params.kp)
    return State(nothing, nothing, nothing)


def start(key: jax.Array, params: Params) -> State:
    """At rest at a random speed."""
    speed = jax.random.uniform(key, (), float, -1.0, 1.0)
    return State(speed, speed / params.ki, speed)


def step(params: Params, state: State, r_tilde: jax.Array, key: jax.Array) -> State:
    del key

    def substep(state: State, _: None) -> tuple[State, None]:
        error = r_tilde - state.speed
        integral = state.integral + SUBSTEP * error
        wanted = jnp.clip(params.kp * error + params.ki * integral, -params.limit, params.limit)
        move = jnp.clip(wanted - state.actuator, -params.rate * SUBSTEP, params.rate * SUBSTEP)
        actuator = state.actuator + jnp.where(jnp.abs(wanted - state.actuator) > params.dead_band, move, 0.0)
        return State(state.speed + SUBSTEP / LAG * (actuator - state.speed), integral, actuator), None

    return jax.lax.scan(substep, state, length=SUBSTEPS)[0]


def output(params: Params, state: State) -> jax.Array:
    del params
    return state.speed


def _made(name: str, **numbers: float) -> tuple[Plant, Params]:
    plant = Plant(
        name=name,
        init=init,
        start=start,
        step=step,
        output=output,
        y_unit="1",
        time_unit="s",
        control_step=SUBSTEP * SUBSTEPS,
        episode_steps=200,
        r_tilde_bounds=(-2.0, 2.0),
        setpoint_range=(-1.0, 1.0),
    )
    return plant, Params(**{name: jnp.asarray(value, float) for name, value in numbers.items()})


def DeadBand(*, kp: float = 1.0, ki: float = 2.0, dead_band: float = 0.1) -> Any:  # noqa: N802
    """The actuator sticks."""
    return _made("DeadBand", kp=kp, ki=ki, dead_band=dead_band, limit=10.0, rate=100.0)


def Saturating(*, kp: float = 1.0, ki: float = 2.0, limit: float = 1.2) -> Any:  # noqa: N802
    """The actuator has little more than the largest speed takes, and the controller's integral winds up."""
    return _made("Saturating", kp=kp, ki=ki, dead_band=0.0, limit=limit, rate=100.0)


def RateLimited(*, kp: float = 1.0, ki: float = 1.0, rate: float = 0.5) -> Any:  # noqa: N802
    """The actuator moves slowly."""
    return _made("RateLimited", kp=kp, ki=ki, dead_band=0.0, limit=10.0, rate=rate)
