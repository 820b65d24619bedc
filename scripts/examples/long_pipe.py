"""An example of a plant that is unstable alone: a level controller that was tuned for a shorter pipe.

The inflow reaches the tank late, so the level swings ever more. What an outer loop shows the controller as set-point
can hold it, which training finds out by itself:

    python -m jaxouter.check scripts/examples/long_pipe.py:LongPipe
    python -m jaxouter.train scripts/examples/long_pipe.py:LongPipe
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxouter.plants import Plant

PIPE = 4  # control steps until the inflow arrives
CONTROL_STEP = 5.0  # s


@struct.dataclass
class Params:
    """Parameters that can be swept, or drawn for each episode with --randomise."""

    area: jax.Array  # of the tank, cm2
    kp: jax.Array  # of the PI controller, which you cannot modify, cm2/s
    ki: jax.Array  # cm2/s2


class State(NamedTuple):
    """Level (cm), integral of the error (cm s), and flows in the pipe beyond the outflow (cm3/s), the newest first."""

    level: jax.Array
    integral: jax.Array
    pipe: jax.Array  # (PIPE,)


def at(level):
    """An even flow, and this level."""
    return State(level, jnp.zeros(()), jnp.zeros(PIPE))


def init(key, params):
    """The middle of the set-points."""
    return at(jnp.asarray(20.0))


def start(key, params):
    """Start of a training episode: a random level."""
    return at(jax.random.uniform(key, (), float, 14.0, 26.0))


def step(params, state, r_tilde, key):
    """One control step with the set-point r~ held."""
    error = r_tilde - state.level
    integral = state.integral + CONTROL_STEP * error
    flow = params.kp * error + params.ki * integral
    level = state.level + CONTROL_STEP / params.area * state.pipe[-1]
    return State(level, integral, jnp.concatenate([flow[None], state.pipe[:-1]]))


def output(params, state):
    """y: the level, cm."""
    return state.level


PLANT = Plant(
    name="LongPipe",
    init=init,
    start=start,
    step=step,
    output=output,
    y_unit="cm",
    time_unit="s",
    control_step=CONTROL_STEP,
    episode_steps=200,
    r_tilde_bounds=(5.0, 35.0),
    setpoint_range=(14.0, 26.0),
)


def LongPipe(*, area=100.0, kp=8.0, ki=0.05):  # noqa: N802 - the plant's name
    """The plant and its parameters."""
    return PLANT, Params(**{name: jnp.asarray(value, float) for name, value in dict(area=area, kp=kp, ki=ki).items()})
