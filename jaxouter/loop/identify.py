"""Identification of a plant through its own input and output; no parameter of the plant is read."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.loop.policy import Affine, AffineParams
from jaxouter.loop.references import telegraph
from jaxouter.plants import Plant, host, simulate

LEVELS = 8
SIGNIFICANT = 3.0  # standard errors, by which y must have moved with r~
TINY = 1e-3  # of the span of the set-points, by which all of r~ must move y
LONGER = 5  # episodes, in which y is seen to move at last
ROUNDING = 1e-6  # of y
RUN_ONCE = {"xla_backend_optimization_level": 0}  # compiler options of what takes longer to compile than to run


class DcGain(NamedTuple):
    """y = offset + gain * r~ in steady state."""

    gain: jax.Array
    offset: jax.Array


def dc_gain(plant: Plant, params: Any, key: chex.PRNGKey) -> DcGain:
    """The affine DC gain from constant-r~ episodes, one at each of 8 levels of r~ (8 episodes of environment steps).

    Each starts like a training episode; a line is fitted through the last tenth of each.

    Raises:
        ValueError: y does not tell how it answers to r~; says why.
    """
    if (simulators := host.of(plant)) is not None:
        simulators.ended = None
    levels, y, course = map(np.asarray, _steady(plant, params, key))  # the rest on the host, where nothing is compiled
    centred = levels - np.mean(levels)
    gain = np.sum(centred * y) / np.sum(centred**2)
    why = unanswered(plant, params, key, levels, y, course, float(gain))
    if why is not None:
        raise ValueError(f"the DC gain of {plant.name} can't be found: {why}")
    return DcGain(jnp.asarray(gain), jnp.asarray(np.mean(y) - gain * np.mean(levels)))


@partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
def _steady(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Levels of r~ (8,), where y comes to under each (8,), and its course (8, T + 1)."""
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
    """Why y does not tell how it answers to r~; None: it does.

    Args:
        plant, params: stepped again only where it seems not to.
        key: of the starts.
        levels: of r~ (8,), one an episode.
        y: (8,), where it comes to under each.
        course: (8, T + 1), y_0 to y_T.
        gain: of the line through y.
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
    # Where y began counts too: what is left of it at the end is no answer to r~.
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
                f"{same} for {int((longer > 0).argmax())} control steps, its dead time, and an episode has {steps}: "
                "make it several times as long as the dead time (episode_steps)"
            )
        return f"no r~ in {plant.r_tilde_bounds} moves its output: {same} for {len(longer)} control steps"
    most = float(moved.max())
    if most < TINY * setpoints:
        return (
            f"all of r~, {low:g} to {high:g} {plant.y_unit}, moves y by {most:.3g} {plant.y_unit}, and its set-points "
            f"span {setpoints:.3g} {plant.y_unit}: a gain so small holds none of them"
        )
    if abs(gain) * (high - low) > TINY * setpoints:
        return None  # in spite of the noise
    return f"y does not move one way as r~ rises: it comes to {_numbers(y)} at r~ of {_numbers(levels)}"


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _moved(plant: Plant, params: Any, key: chex.PRNGKey, levels: np.ndarray, steps: int) -> np.ndarray:
    """By how much the levels of r~ move y apart, (T,), less rounding; as far as the plant goes on, at most `steps`.

    All have the same start and noise.
    """
    try:
        y = np.asarray(_together(plant, steps, params, key, levels))
    except (ValueError, jax.errors.JaxRuntimeError):  # a simulator that does not go on
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


def static(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[Affine, AffineParams]:
    """The static prefilter: the inverse of the identified affine DC gain, r~ = (r - offset) / gain."""
    identified = dc_gain(plant, params, key)
    return Affine(plant.r_tilde_bounds), AffineParams(1.0 / identified.gain, -identified.offset / identified.gain)


class Record(NamedTuple):
    """Signals of exciting episodes, oldest first."""

    r_tilde: np.ndarray  # (episodes, T), held over each control step
    y: np.ndarray  # (episodes, T + 1), y_0 to y_T


def record(plant: Plant, params: Any, key: chex.PRNGKey, episodes: int) -> Record:
    """Input and output under random r~: levels over its whole range, held long in some episodes, briefly in others.

    Each episode starts like a training episode. The probability that a level is redrawn at a step is drawn for each,
    log-uniform from four times an episode to every other step.
    """
    keys, n = jax.random.split(key, episodes), host.side_by_side(plant) or episodes
    parts = [_episodes(plant, params, keys[i : i + n]) for i in range(0, episodes, n)]
    return Record(*(np.concatenate(column).astype(np.float64) for column in zip(*parts, strict=True)))


@partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
def _episodes(plant: Plant, params: Any, keys: chex.PRNGKey) -> tuple[jax.Array, jax.Array]:
    """r~ (episodes, T) and y (episodes, T + 1)."""

    def episode(key: chex.PRNGKey) -> tuple[jax.Array, jax.Array]:
        key_start, key_rate, key_levels, key_run = jax.random.split(key, 4)
        steps = plant.episode_steps
        rate = jnp.exp(jax.random.uniform(key_rate, (), float, jnp.log(4.0 / steps), jnp.log(0.5)))
        r_tilde = telegraph(key_levels, steps, *plant.r_tilde_bounds, rate)
        state = plant.training_start(key_start, params)
        y0 = plant.output(params, state)
        y = simulate(plant, params, r_tilde, key_run, state)
        return r_tilde, jnp.concatenate([y0[None], y])

    return jax.vmap(episode)(keys)


class ARX(NamedTuple):
    """y_(k+1) = sum_i a_i y_(k-i) + sum_i b_i r~_(k-dead-i) + c + e, i from 0."""

    a: np.ndarray  # (n,)
    b: np.ndarray  # (n,)
    c: float
    dead: int  # dead time in control steps beyond the one of sampling
    sigma: float  # standard deviation of e


def fit_arx(data: Record, n: int, dead: int) -> ARX:
    """Least squares over all episodes."""
    first, steps = n + dead - 1, data.r_tilde.shape[1]
    k = np.arange(first, steps)
    lags = k[:, None] - np.arange(n)
    past = np.concatenate([data.y[:, lags], data.r_tilde[:, lags - dead], np.ones((len(data.y), len(k), 1))], -1)
    rows, targets = past.reshape(-1, 2 * n + 1), data.y[:, k + 1].ravel()
    theta = np.linalg.lstsq(rows, targets, rcond=None)[0]
    residual = targets - rows @ theta
    return ARX(theta[:n], theta[n : 2 * n], float(theta[-1]), dead, float(np.sqrt(np.mean(residual**2))))


def predict(model: ARX, data: Record, horizon: int) -> np.ndarray:
    """Predictions of y up to `horizon` steps ahead, with the r~ that came; (episodes, starts, horizon)."""
    n, dead, steps = len(model.a), model.dead, data.r_tilde.shape[1]
    starts = np.arange(n + dead - 1, steps - horizon + 1, max(1, horizon // 4))
    window = [data.y[:, starts - i] for i in range(n)]
    out = []
    for j in range(horizon):
        forced = sum(b * data.r_tilde[:, starts + j - dead - i] for i, b in enumerate(model.b))
        y = sum(a * past for a, past in zip(model.a, window, strict=True)) + forced + model.c
        window = [y, *window[:-1]]
        out.append(y)
    return np.stack(out, -1)


def prediction_error(model: ARX, data: Record, horizon: int) -> float:
    """Root mean square error of `predict`."""
    n, steps = len(model.a), data.r_tilde.shape[1]
    starts = np.arange(n + model.dead - 1, steps - horizon + 1, max(1, horizon // 4))
    truth = np.stack([data.y[:, starts + j + 1] for j in range(horizon)], -1)
    return float(np.sqrt(np.mean((predict(model, data, horizon) - truth) ** 2)))
