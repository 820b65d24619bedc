"""Linear plants of one's own that are hard in one way each: y_(k+1) = sum_i a_i y_(k-i) + sum_i b_i r~_(k-dead-i)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxouter.plants import Plant

EPISODE = 100  # control steps
POLE = math.exp(-1 / 6)  # of a lag that settles in 18 control steps


@struct.dataclass
class Params:
    """Coefficients."""

    a: jax.Array  # (n,)
    b: jax.Array  # (m,), the dead time as zeros at its beginning


class State(NamedTuple):
    """What came last, the newest first."""

    y: jax.Array  # (n,)
    r_tilde: jax.Array  # (m,)


def key(seed):
    """A random key."""
    return jax.random.key(seed)


def init(key, params):
    """Everything zero."""
    return State(jnp.zeros_like(params.a), jnp.zeros_like(params.b))


def start(key, params):
    """At some y."""
    y = jax.random.uniform(key, (), float, -0.5, 0.5)
    return State(jnp.full_like(params.a, y), jnp.zeros_like(params.b))


def step(params, state, r_tilde, key):
    """One control step."""
    r_tilde = jnp.concatenate([r_tilde[None], state.r_tilde[:-1]])
    y = jnp.dot(params.a, state.y) + jnp.dot(params.b, r_tilde)
    return State(jnp.concatenate([y[None], state.y[:-1]]), r_tilde)


def output(params, state):
    """y, without a unit."""
    return state.y[0]


Maker = Callable[[], tuple[Plant, Params]]


def kind(a: Sequence[float], b: Sequence[float], dead: int = 0, **declared: Any) -> Maker:
    """A maker of such a plant."""
    fields: dict[str, Any] = dict(
        name="kind",
        init=init,
        start=start,
        step=step,
        output=output,
        y_unit="1",
        time_unit="s",
        control_step=0.1,
        episode_steps=EPISODE,
        r_tilde_bounds=(-4.0, 4.0),
        setpoint_range=(-1.0, 1.0),
        families=("steps",),
        family_steps=EPISODE,
    )
    plant = Plant(**fields | declared)

    def make():
        """The plant and its parameters."""
        numbers = ([*a], [0.0] * dead + [*b])
        return plant, Params(*(jnp.asarray(each, float) for each in numbers))

    return make


def late(dead: int, **declared: Any) -> Maker:
    """A lag of DC gain 0.5 with this dead time."""
    return kind([POLE], [0.5 * (1 - POLE)], dead, **declared)


Negative = kind([POLE], [-0.8 * (1 - POLE)])  # DC gain -0.8
Slow = kind([math.exp(-1 / 500)], [2.0 * (1 - math.exp(-1 / 500))])  # a time constant of five episodes
Nonminimum = kind([1.6, -0.63], [-0.03, 0.045])  # poles 0.9 and 0.7, zero at 1.5, DC gain 0.5
Late = late(30)  # nearly a third of an episode
Integrating = kind([1.0], [0.04])
Unstable = kind([1.04], [0.04])
AtOnce = kind([0.0], [1.0])  # y is r~ at the next step
