"""An example of your own plant: two cascaded tanks with a badly tuned PI level controller and a dead band in the valve.

Name it by this file and the function at its end. Check it, train on it, and compare the result with baselines:

    python -m jaxouter.check scripts/examples/tanks.py:Tanks
    python -m jaxouter.train scripts/examples/tanks.py:Tanks
    python -m jaxouter.compare scripts/examples/tanks.py:Tanks --run runs/Tanks-default-0
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxouter.plants import Plant

SUBSTEP = 1.0  # s
SUBSTEPS = 10  # per control step


@struct.dataclass
class Params:
    """Parameters that can be swept, or drawn for each episode with --randomise."""

    area: jax.Array  # of each tank, cm2
    outlet: jax.Array  # outflow is outlet * sqrt(level), cm2.5/s
    kp: jax.Array  # of the PI controller, which you cannot modify, cm2/s
    ki: jax.Array  # cm2/s2
    dead_band: jax.Array  # of the valve, cm3/s
    load: jax.Array  # flow drawn from the upper tank, cm3/s


class State(NamedTuple):
    """Levels of the upper and the lower tank (cm), integral of the error (cm s), flow through the valve (cm3/s)."""

    upper: jax.Array
    lower: jax.Array
    integral: jax.Array
    flow: jax.Array


def at_rest(params, level):
    """The steady state with both tanks at this level."""
    flow = params.outlet * jnp.sqrt(level) + params.load
    return State(level, level, flow / params.ki, flow)


def init(key, params):
    """Rest in the middle of the set-points."""
    return at_rest(params, jnp.asarray(14.0))


def start(key, params):
    """Start of a training episode: at rest at a random level."""
    return at_rest(params, jax.random.uniform(key, (), float, 8.0, 20.0))


def step(params, state, r_tilde, key):
    """One control step, ten seconds, with the set-point r~ held."""

    def substep(state, _):
        error = r_tilde - state.lower
        integral = state.integral + SUBSTEP * error
        wanted = jnp.clip(params.kp * error + params.ki * integral, 0.0, 100.0)
        flow = jnp.where(jnp.abs(wanted - state.flow) > params.dead_band, wanted, state.flow)
        upper_out = params.outlet * jnp.sqrt(jnp.maximum(state.upper, 1e-3))
        lower_out = params.outlet * jnp.sqrt(jnp.maximum(state.lower, 1e-3))
        upper = state.upper + SUBSTEP / params.area * (flow - params.load - upper_out)
        lower = state.lower + SUBSTEP / params.area * (upper_out - lower_out)
        return State(jnp.clip(upper, 0.0, 40.0), jnp.clip(lower, 0.0, 40.0), integral, flow), None

    return jax.lax.scan(substep, state, length=SUBSTEPS)[0]


def output(params, state):
    """y: the level of the lower tank, cm."""
    return state.lower


PLANT = Plant(
    name="Tanks",
    init=init,
    start=start,
    step=step,
    output=output,
    y_unit="cm",
    time_unit="s",
    control_step=SUBSTEP * SUBSTEPS,
    episode_steps=200,
    r_tilde_bounds=(2.0, 30.0),
    setpoint_range=(8.0, 20.0),
)


def Tanks(*, area=80.0, outlet=8.0, kp=1.0, ki=0.02, dead_band=3.0, load=0.0):  # noqa: N802 - the plant's name
    """The plant and its parameters."""
    numbers = dict(area=area, outlet=outlet, kp=kp, ki=ki, dead_band=dead_band, load=load)
    return PLANT, Params(**{name: jnp.asarray(value, float) for name, value in numbers.items()})
