"""Steady state of y under a constant r~: the DC gain, and its inverse, the static prefilter.

Identified from r~ and y alone; no parameter of the plant is read.
"""

from __future__ import annotations

import math
import warnings
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.loop.policy import Linear, LinearLaw, affine, none
from jaxouter.plants import Plant, host, simulate
from jaxouter.plants.base import RUN_ONCE, in_words

LEVELS = 8
DRIFT = 0.08  # share of the gain by which it may change in a fifth of an episode if y has settled
GROWTH = 1.5  # y runs away if its swings grow by this from a fifth of an episode to the next
STEADY = (0.97, 1.05)  # y integrates if the ratio of its changes in two such fifths lies in this range
SIGNIFICANT = 3.0  # standard errors by which y must move with r~
TINY = 1e-3  # share of the set-point range by which the whole range of r~ must move y
LONGER = 5  # episodes to wait for a long dead time
ROUNDING = 1e-6  # relative to y


class IdentificationWarning(UserWarning):
    """An identified quantity does not have its usual meaning."""


class DcGain(NamedTuple):
    """y = offset + gain * r~ in steady state, or at the end of an episode if y does not settle."""

    gain: jax.Array
    offset: jax.Array
    unsettled: str | None = None
    """What y does instead of settling, in words."""
    rate: float = math.nan
    """Change of y per control step and unit of r~, late in an episode."""
    still: float = math.nan
    """r~ under which y then stays constant."""


def dc_gain(plant: Plant, params: Any, key: chex.PRNGKey) -> DcGain:
    """Identify the affine DC gain from 8 episodes, each with r~ constant at another level.

    Episodes start like training episodes; a line is fitted through the means of their last tenths.

    Raises:
        ValueError: the gain can't be found; says why.
    """
    if (simulators := host.of(plant)) is not None:
        simulators.ended = None
    levels, y, course = map(np.asarray, _steady(plant, params, key))  # the rest in NumPy, which compiles nothing
    end = finite_steps(course, plant.divergence_bounds)
    if end < course.shape[1]:  # it ran away
        course = course[:, :end]
        y = course[:, -max(1, end // 10) :].mean(1)
    centred = levels - np.mean(levels)
    gain = np.sum(centred * y) / np.sum(centred**2)
    why = unanswered(plant, params, key, levels, y, course, float(gain))
    if why is not None:
        raise ValueError(f"the DC gain of {plant.name} can't be found: {why}")
    rate, still = _rate(levels, course)
    found = unsettled(levels, course)
    return DcGain(
        jnp.asarray(gain),
        jnp.asarray(np.mean(y) - gain * np.mean(levels)),
        None if found is None else f"{plant.name}: {found} within an episode of {plant.episode_steps} control steps",
        rate,
        float(np.clip(still, *plant.r_tilde_bounds)),
    )


def finite_steps(y: np.ndarray, bounds: tuple[float, float]) -> int:
    """Samples until one of the outputs (n, T) is not finite, if one has left the bounds by then; else T."""
    low, high = bounds
    bad = ~np.isfinite(y)
    left = np.any((np.nan_to_num(y, nan=low) < low) | (np.nan_to_num(y, nan=low) > high))
    return int(np.flatnonzero(bad.any(0))[0]) if bad.any() and left else y.shape[1]


def unsettled(levels: np.ndarray, y: np.ndarray) -> str | None:
    """What y does instead of settling, in words; None: it has settled.

    Follows the gain from r~ to y through the last three fifths of an episode. y has not settled if the gain changes
    from the last fifth but one to the last, by more than the scatter about a line through the levels, and also within
    the last fifth.

    Args:
        levels: of r~ (n,), one an episode.
        y: (n, T + 1), y_0 to y_T.
    """
    steps = y.shape[1] - 1
    if steps < 10:
        return None
    parts = np.stack([_part(y, steps // 5, i) for i in (2, 1, 0)] + [_part(y, steps // 10, 1)], 1)
    columns = [levels - levels.mean(), np.ones(len(levels))]
    if np.ptp(y[:, 0]) > 1e-3 * np.ptp(y):
        columns.append(y[:, 0] - y[:, 0].mean())  # the start of an episode may still matter
    design = np.stack(columns, 1)
    (gains, *_), *_ = np.linalg.lstsq(design, parts, rcond=None)
    before, last = np.diff(gains[:3])
    changes, lately = parts[:, 2] - parts[:, 1], 2.0 * (gains[2] - gains[3])  # of the last fifth, between its halves
    rest = changes - design @ np.linalg.lstsq(design, changes, rcond=None)[0]
    chance = math.sqrt(np.sum(rest**2) / (len(levels) - len(columns))) / float(np.linalg.norm(columns[0]))
    swings = [float(y[:, y.shape[1] - (i + 1) * (steps // 5) :][:, : steps // 5].std(1).mean()) for i in (2, 1, 0)]
    if swings[2] > GROWTH * swings[1] > GROWTH**2 * swings[0] and swings[2] > DRIFT * abs(gains[2]) * levels.std():
        return "y runs away under a constant r~"
    if abs(last) <= max(DRIFT * abs(gains[2]), 3.0 * chance) or abs(lately) <= DRIFT / 4.0 * abs(gains[2]):
        return None
    if before * last < 0.0:
        return None  # y oscillates about its final value
    ratio = last / before if before else math.inf
    if ratio > STEADY[1]:
        return "y runs away under a constant r~"
    return "y keeps growing, as if it integrated r~," if ratio >= STEADY[0] else "y does not settle"


def _part(y: np.ndarray, length: int, before: int) -> np.ndarray:
    """Means (n,) over `length` samples of y (n, T), `before` such blocks from its end."""
    end = y.shape[1] - before * length
    return y[:, end - length : end].mean(1)


def _rate(levels: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Change of y per control step and unit of r~ in the second half, and the r~ under which y is constant there."""
    half = y.shape[1] // 2
    centred, change = levels - levels.mean(), (y[:, -1] - y[:, half]) / max(1, y.shape[1] - 1 - half)
    rate = float(np.dot(centred, change) / np.sum(centred**2))
    return rate, float(levels.mean() - change.mean() / rate) if rate else math.nan


@partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
def _steady(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Levels of r~ (8,), the final y under each (8,), and the trajectories of y (8, T + 1)."""
    low, high = plant.r_tilde_bounds
    levels = low + (high - low) * (jnp.arange(LEVELS, dtype=float) + 0.5) / LEVELS

    def episode(level: jax.Array, key: chex.PRNGKey) -> tuple[jax.Array, jax.Array]:
        key_start, key_run = jax.random.split(key)
        state = plant.training_start(key_start, params)
        y = simulate(plant, params, jnp.full(plant.episode_steps, level), key_run, state)
        course = jnp.concatenate([plant.output(params, state)[None], y])
        return jnp.mean(y[-max(1, plant.episode_steps // 10) :]), course

    return levels, *jax.vmap(episode)(levels, jax.random.split(key, LEVELS))


def unanswered(
    plant: Plant,
    params: Any,
    key: chex.PRNGKey,
    levels: np.ndarray,
    y: np.ndarray,
    course: np.ndarray,
    gain: float,
) -> str | None:
    """Why the DC gain can't be found; None: it can.

    Args:
        plant, params: simulated again only if y seems not to respond.
        key: for the starts.
        levels: of r~ (8,), one per episode.
        y: (8,), its final value under each.
        course: (8, T + 1), y_0 to y_T.
        gain: slope of the line through y.
    """
    steps = course.shape[1] - 1
    broken = ~np.isfinite(course)
    if broken.any():
        k = int(broken.any(0).argmax())
        level, value = levels[broken[:, k].argmax()], course[broken[:, k].argmax(), k]
        ended = getattr(host.of(plant), "ended", None)
        why = "" if ended is None else f": {ended}; choose --episode-steps so that an episode is over by then"
        return f"y is {value} from control step {k} of {steps} on under r~ = {level:g}{why}"
    (low, high), setpoints = plant.r_tilde_bounds, np.ptp(plant.setpoint_range)
    # The initial y is a regressor too: what remains of it at the end is no response to r~.
    causes = np.stack([np.ones(LEVELS), levels / (high - low), course[:, 0] / setpoints], 1)
    effect, *_ = np.linalg.lstsq(causes, y / setpoints, rcond=None)
    spread = np.std(y / setpoints - causes @ effect) / np.std(causes[:, 1]) / np.sqrt(LEVELS - 3)
    if abs(effect[1]) > max(SIGNIFICANT * spread, TINY):
        return None
    moved = _moved(plant, params, key, levels, steps)
    if not moved.any():
        longer = _moved(plant, params, key, levels, LONGER * steps)
        same = f"y is the same under {LEVELS} levels of r~ from {levels[0]:g} to {levels[-1]:g}"
        if longer.any():
            return (
                f"{same} for {int((longer > 0).argmax())} control steps (the dead time), and an episode has {steps}; "
                "make episodes several times as long as the dead time (episode_steps)"
            )
        return f"no r~ in {plant.r_tilde_bounds} moves its output: {same} for {len(longer)} control steps"
    most, unit = float(moved.max()), in_words(plant.y_unit)
    if most < TINY * setpoints:
        return (
            f"r~ from {low:g} to {high:g}{unit} moves y by only {most:.3g}{unit}, but the set-points span "
            f"{setpoints:.3g}{unit}: the gain is too small to hold them"
        )
    if abs(gain) * (high - low) > TINY * setpoints:
        return None  # significant in spite of the noise
    return f"y neither rises nor falls steadily with r~: it settles at {_numbers(y)} for r~ of {_numbers(levels)}"


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _moved(plant: Plant, params: Any, key: chex.PRNGKey, levels: np.ndarray, steps: int) -> np.ndarray:
    """Spread of y over the levels of r~, (T,), 0 if it is only rounding; T is `steps` or where the plant ends.

    All levels have the same start and noise.
    """
    try:
        y = np.asarray(_together(plant, steps, params, key, levels))
    except (ValueError, jax.errors.JaxRuntimeError):  # a simulator that ends
        return np.zeros(plant.episode_steps)
    y = y[:, : int(np.append(~np.isfinite(y).all(0), True).argmax())]
    return np.where(np.ptp(y, 0) > ROUNDING * np.abs(y).max(initial=0.0), np.ptp(y, 0), 0.0)


@partial(jax.jit, static_argnums=(0, 1), compiler_options=RUN_ONCE)
def _together(plant: Plant, steps: int, params: Any, key: chex.PRNGKey, levels: jax.Array) -> jax.Array:
    """Y (8, T) under constant levels of r~ (8,), with the same start and noise."""
    key_start, key_run = jax.random.split(key)

    def episode(level: jax.Array) -> jax.Array:
        state = plant.training_start(key_start, params)
        return simulate(plant, params, jnp.full(steps, level), key_run, state)

    return jax.vmap(episode)(jnp.asarray(levels))


def static(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[Linear, LinearLaw]:
    """The static prefilter: the inverse of the identified affine DC gain, r~ = (r - offset) / gain.

    If y does not settle it is r~ = r, with a warning.
    """
    identified = dc_gain(plant, params, key)
    warn_unsettled(identified.unsettled)
    return prefilter(plant, identified)


def prefilter(plant: Plant, identified: DcGain) -> tuple[Linear, LinearLaw]:
    """The inverse of the DC gain; r~ = r if there is none."""
    if identified.unsettled is not None:
        return none(plant)
    return Linear(plant.r_tilde_bounds), affine(1.0 / identified.gain, -identified.offset / identified.gain)


def warn_unsettled(unsettled: str | None) -> None:
    """Warn that there is no static prefilter if y does not settle."""
    if unsettled is not None:
        text = f"{unsettled}; there is no DC gain to invert, so the static prefilter is r~ = r"
        warnings.warn(text, IdentificationWarning, stacklevel=3)
