"""References: families of whole trajectories, and generators that give an environment one reference per step.

A family is a pure function `family(key, steps, low, high) -> r`, r of shape (steps,) within [low, high]. A generator
(`Goal`) has `init(key, y0) -> (state, r0)` and `step(state, y) -> (state, r)`: the next reference may depend on the
output (paper section II: 'a human operator that interacts with the observed state').
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp

RATE = 1  # folded into the key of the first set-point
SEGMENTS = 5  # set-points of a staircase, slopes of a ramp


def _time(steps: int) -> jax.Array:
    return jnp.arange(steps, dtype=float) / steps  # 0 to 1


def constant(key: chex.PRNGKey, steps: int, low: float, high: float) -> jax.Array:
    """One set-point throughout."""
    return jnp.full(steps, jax.random.uniform(key, (), float, low, high))


def telegraph(key: chex.PRNGKey, steps: int, low: float, high: float, redraw: jax.Array | float) -> jax.Array:
    """A level uniform in [low, high], redrawn at each step with probability `redraw`; (steps,)."""
    key_when, key_level = jax.random.split(key)
    when = jax.random.uniform(key_when, (steps,), float) < redraw
    levels = jax.random.uniform(key_level, (steps,), float, low, high)
    return levels[jax.lax.cummax(jnp.where(when, jnp.arange(steps), 0))]


def wander(key: chex.PRNGKey, steps: int, low: float, high: float, inertia: jax.Array | float) -> jax.Array:
    """A smooth random trajectory, (steps,), whose value at each time is uniform in [low, high].

    Gaussian noise through two lags of time constant `inertia` (control steps), made from its spectrum and then squashed
    to the range.
    """
    k = jnp.arange(steps // 2 + 1, dtype=float)
    pole = jnp.exp(-1.0 / inertia)
    gain = 1.0 / (1.0 - 2.0 * pole * jnp.cos(2.0 * jnp.pi * k / steps) + pole**2)  # of two equal lags
    real, imaginary = gain[None] * jax.random.normal(key, (2, k.size), float)
    course = jnp.fft.irfft(jax.lax.complex(real, imaginary), steps) * steps
    variance = jnp.sum(gain**2 * jnp.where((k == 0.0) | (2.0 * k == steps), 1.0, 4.0))
    return low + (high - low) * jax.scipy.special.ndtr(course / jnp.sqrt(variance))


def redrawn(key: chex.PRNGKey, steps: int, low: float, high: float) -> jax.Array:
    """Reference of a training episode, (steps,): set-points in [low, high], redrawn at random times.

    - A fifth of the episodes keep one set-point.
    - A fifth redraw it one to twenty times per episode on average, log-uniform.
    - A fifth are random walks, reflected at the ends of the range; the standard deviation of a step is log-uniform from
      0.25 to 5 % of the range.
    - The rest wander smoothly over a part of the range, with a time constant log-uniform from a fiftieth to a fifth of
      an episode.
    """
    key_kind, key_share, key_part, key_run = jax.random.split(key, 4)
    share, width, place = jax.random.uniform(key_share, (3,), float)
    rate = 20.0**share / steps
    first = telegraph(key_run, steps, low, high, 0.0)
    moves = 0.0025 * 20.0**share * jax.random.normal(key_run, (steps,), float)
    walk = (first[0] - low) / (high - low) + jnp.cumsum(moves)
    reflected = low + (high - low) * jnp.abs((walk + 1.0) % 2.0 - 1.0)
    part = (0.1 + 0.9 * width) * wander(key_part, steps, 0.0, 1.0, 0.02 * 10.0**share * steps)
    wandering = low + (high - low) * (part + 0.9 * (1.0 - width) * place)
    kind = jnp.minimum(jax.random.randint(key_kind, (), 0, 5), 3)
    return jnp.stack([first, telegraph(key_run, steps, low, high, rate), reflected, wandering])[kind]


def held(r: jax.Array) -> jax.Array:
    """Control steps since r (T,) last changed, at each step; int (T,)."""
    k = jnp.arange(len(r))
    return k - jax.lax.cummax(jnp.where(r != jnp.roll(r, 1), k, 0))


def staircase(key: chex.PRNGKey, steps: int, low: float, high: float) -> jax.Array:
    """Five set-points, each held equally long."""
    levels = jax.random.uniform(key, (SEGMENTS,), float, low, high)
    return levels[jnp.arange(steps) * SEGMENTS // steps]


def ramps(key: chex.PRNGKey, steps: int, low: float, high: float) -> jax.Array:
    """Five straight lines through random knots, without jumps."""
    knots = jax.random.uniform(key, (SEGMENTS + 1,), float, low, high)
    return jnp.interp(_time(steps) * SEGMENTS, jnp.arange(SEGMENTS + 1.0), knots)


def sines(key: chex.PRNGKey, steps: int, low: float, high: float) -> jax.Array:
    """A sine about the middle of the range: a quarter to all of the range, 3 to 12 periods."""
    amplitude, cycles = jax.random.uniform(key, (2,), float, jnp.array([0.25, 3.0]), jnp.array([1.0, 12.0]))
    wave = jnp.sin(2 * jnp.pi * cycles * _time(steps))
    return (low + high) / 2 + amplitude * (high - low) / 2 * wave


def doublets(key: chex.PRNGKey, steps: int, low: float, high: float) -> jax.Array:
    """Middle, up, down, middle: a quarter to all of the range, each pulse an eighth to a quarter of the time."""
    amplitude, width = jax.random.uniform(key, (2,), float, jnp.array([0.25, 0.125]), jnp.array([1.0, 0.25]))
    sign = jax.random.rademacher(jax.random.fold_in(key, 1), (), float)
    since = jnp.arange(steps, dtype=float) - steps / 8  # not rounded: the same first step on every processor
    phase = since / (width * steps)  # pulses on [0, 1) and [1, 2)
    pulse = jnp.where((phase >= 0) & (phase < 1), 1.0, 0.0) - jnp.where((phase >= 1) & (phase < 2), 1.0, 0.0)
    return (low + high) / 2 + sign * amplitude * (high - low) / 2 * pulse


def days(key: chex.PRNGKey, steps: int, low: float, high: float) -> jax.Array:
    """Night set-back: 16 warm and 8 cool steps per day of 24, starting at a random hour."""
    key_levels, key_hour = jax.random.split(key)
    share = jax.random.uniform(key_levels, (2,), float)
    warm, cool = (low + high) / 2 + (high - low) / 2 * share * jnp.array([1.0, -1.0])
    hour = (jnp.arange(steps) + jax.random.randint(key_hour, (), 0, 24)) % 24
    return jnp.where((hour >= 6) & (hour < 22), warm, cool)


FAMILIES: dict[str, Callable[[chex.PRNGKey, int, float, float], jax.Array]] = {
    "steps": constant,
    "staircase": staircase,
    "ramps": ramps,
    "sines": sines,
    "doublets": doublets,
    "days": days,
}


class Goal(Protocol):
    """A reference generator."""

    def init(self, key: chex.PRNGKey, y0: jax.Array) -> tuple[Any, jax.Array]:
        """State and the first reference."""
        ...

    def step(self, state: Any, y: jax.Array) -> tuple[Any, jax.Array]:
        """State and the next reference, given the plant's new output y."""
        ...


class SetPointState(NamedTuple):
    """State of the set-point generators."""

    key: chex.PRNGKey
    r: jax.Array
    redraw: jax.Array | None = None  # probability per step


@dataclass(frozen=True)
class SetPoint:
    """A set-point uniform in [low, high], redrawn at random steps (the paper's: never)."""

    low: float
    high: float
    redraw: tuple[float, float] = (0.0, 0.0)
    """Least and greatest probability per step of a redraw, drawn for each episode, log-uniform; 0: never."""

    def init(self, key: chex.PRNGKey, y0: jax.Array) -> tuple[SetPointState, jax.Array]:
        """A first set-point, whatever y0."""
        del y0
        key, draw = jax.random.split(key)
        r = jax.random.uniform(draw, (), float, self.low, self.high)
        least, greatest = self.redraw
        if greatest == 0.0:
            return SetPointState(key, r), r
        share = jax.random.uniform(jax.random.fold_in(draw, RATE), (), float)
        return SetPointState(key, r, least * (greatest / least) ** share), r

    def step(self, state: SetPointState, y: jax.Array) -> tuple[SetPointState, jax.Array]:
        """The same set-point, or another one."""
        del y
        if state.redraw is None:
            return state, state.r
        key, when, draw = jax.random.split(state.key, 3)
        other = jax.random.uniform(draw, (), float, self.low, self.high)
        r = jnp.where(jax.random.uniform(when, (), float) < state.redraw, other, state.r)
        return state._replace(key=key, r=r), r


@dataclass(frozen=True)
class Reaimed:
    """A human who re-aims: a new set-point in [low, high] as soon as y is within `tolerance` of the current one."""

    low: float
    high: float
    tolerance: float

    def init(self, key: chex.PRNGKey, y0: jax.Array) -> tuple[SetPointState, jax.Array]:
        """A first set-point."""
        return SetPoint(self.low, self.high).init(key, y0)

    def step(self, state: SetPointState, y: jax.Array) -> tuple[SetPointState, jax.Array]:
        """The same set-point until y reaches it."""
        key, draw = jax.random.split(state.key)
        other = jax.random.uniform(draw, (), float, self.low, self.high)
        r = jnp.where(jnp.abs(state.r - y) < self.tolerance, other, state.r)
        return SetPointState(key, r), r


@dataclass(frozen=True)
class Still:
    """A reference that stays as it is; the state is r."""

    def init(self, key: chex.PRNGKey, y0: jax.Array) -> tuple[jax.Array, jax.Array]:
        """To stay at the first output."""
        del key
        return y0, y0

    def step(self, state: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The same."""
        del y
        return state, state


class FamilyState(NamedTuple):
    """State of `Family`."""

    r: jax.Array  # (steps,)
    k: jax.Array  # int32


@dataclass(frozen=True)
class Family:
    """A trajectory of one of `FAMILIES`, or `redrawn`, drawn at each reset; its last value is held."""

    kind: str
    steps: int
    low: float
    high: float

    def init(self, key: chex.PRNGKey, y0: jax.Array) -> tuple[FamilyState, jax.Array]:
        """A trajectory and its first value."""
        del y0
        family = redrawn if self.kind == redrawn.__name__ else FAMILIES[self.kind]
        r = family(key, self.steps, self.low, self.high)
        return FamilyState(r, jnp.zeros((), jnp.int32)), r[0]

    def step(self, state: FamilyState, y: jax.Array) -> tuple[FamilyState, jax.Array]:
        """The next value."""
        del y
        k = jnp.minimum(state.k + 1, self.steps - 1)
        return FamilyState(state.r, k), state.r[k]
