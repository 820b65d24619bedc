"""First-order lag with a dead time, T y' = K r~(t - d) - y: a third plant in one file.

Units: y and r~ are in multiples of `unit`, as which all sizes are declared; time in s.
"""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxouter.plants import delay
from jaxouter.plants.base import Plant, array

CONTROL_STEP = 0.1  # s


@struct.dataclass
class LagParams:
    """Parameters of the lag; every array is traced."""

    K: jax.Array  # DC gain
    T: jax.Array  # time constant, s
    d: jax.Array  # dead time, s
    max_delay: float = struct.field(pytree_node=False)  # s; static: sets the length of the delay line
    unit: float = struct.field(pytree_node=False, default=1.0)  # size of what is otherwise 1


class LagState(NamedTuple):
    """State of the lag; all zero at rest."""

    y: jax.Array
    line: jax.Array  # (L,), delay line of r~, a sample a control step
    k: jax.Array  # int32, control steps since the start


def make(
    *,
    K: float = 0.5,
    T: float = 0.3,
    d: float = 0.25,
    max_delay: float | None = None,
    randomise: bool = False,
    unit: float = 1.0,
) -> tuple[Plant, LagParams]:
    """The lag and its parameters; `randomise` draws K within 10 % at each reset, `unit` is the size of y.

    Raises:
        ValueError: d is negative or above max_delay (None: the smallest that serves).
    """
    if max_delay is None:
        max_delay = math.ceil(round(d / CONTROL_STEP, 6)) * CONTROL_STEP
    if not 0.0 <= d <= max_delay:
        raise ValueError(f"d is {d} s; a dead time must lie in [0, max_delay] = [0, {max_delay:g}] s")
    params = LagParams(array("K", K, ()), array("T", T, ()), array("d", d, ()), max_delay, unit)
    return (RANDOMISED if randomise else LAG) if unit == 1.0 else _in_unit(unit), params


@cache
def _in_unit(unit: float) -> Plant:
    """The lag with every size that it declares so many times as large."""
    sizes = ("r_tilde_bounds", "setpoint_range", "evaluation_range", "divergence_bounds")
    scaled = {name: (unit * getattr(LAG, name)[0], unit * getattr(LAG, name)[1]) for name in sizes}
    return dataclasses.replace(LAG, error_scale=0.0, **scaled)


def init(key: chex.PRNGKey, params: LagParams) -> LagState:
    """Rest: everything zero."""
    del key
    line = jnp.zeros(delay.length(params.max_delay, CONTROL_STEP))
    return LagState(jnp.zeros(()), line, jnp.zeros((), jnp.int32))


def start(key: chex.PRNGKey, params: LagParams) -> LagState:
    """A training start: y uniform in plus or minus half a unit."""
    return init(key, params)._replace(y=params.unit * jax.random.uniform(key, (), float, -0.5, 0.5))


def draw(key: chex.PRNGKey, params: LagParams) -> LagParams:
    """K uniform within 10 %."""
    return dataclasses.replace(params, K=params.K * jax.random.uniform(key, (), float, 0.9, 1.1))


def output(params: LagParams, state: LagState) -> jax.Array:
    """Y, scalar."""
    del params
    return state.y


def step(params: LagParams, state: LagState, r_tilde: jax.Array, key: chex.PRNGKey) -> LagState:
    """One control step, exact: the delayed r~ jumps once inside it, where the dead time is no multiple of it."""
    del key
    line = delay.write(state.line, state.k, r_tilde)
    lag = params.d / CONTROL_STEP
    whole = jnp.floor(lag)
    y = _relax(params, state.y, delay.read(line, state.k, whole + 1.0), lag - whole)
    y = _relax(params, y, delay.read(line, state.k, whole), 1.0 - (lag - whole))
    return LagState(y, line, state.k + 1)


def _relax(p: LagParams, y: jax.Array, held: jax.Array, share: jax.Array) -> jax.Array:
    """Y after `share` of a control step with the input held."""
    return p.K * held + (y - p.K * held) * jnp.exp(-share * CONTROL_STEP / p.T)


def variables(params: LagParams, state: LagState) -> LagState:
    """The state without clock, its line from the oldest to the newest sample."""
    del params
    return state._replace(line=jnp.roll(state.line, -state.k), k=None)


def settled(params: LagParams, state: LagState, variables: LagState) -> LagState:
    """These variables at a clock at which the next sample belongs in row 0, late enough to fill the line."""
    del params
    return variables._replace(k=jnp.full_like(state.k, state.line.shape[0]))


LAG = Plant(
    name="lag",
    init=init,
    step=step,
    output=output,
    start=start,
    variables=variables,
    settled=settled,
    affine=True,
    y_unit="1",
    time_unit="s",
    control_step=CONTROL_STEP,
    episode_steps=50,
    r_tilde_bounds=(-4.0, 4.0),
    setpoint_range=(-1.0, 1.0),
    move_threshold=math.inf,
    evaluation_range=(-1.0, 1.0),
    divergence_bounds=(-20.0, 20.0),
    history=5,
    family_steps=100,
)
RANDOMISED = dataclasses.replace(LAG, draw=draw)
