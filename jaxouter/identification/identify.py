"""Identification of a plant through its own input and output; no parameter of the plant is read."""

from __future__ import annotations

import math
import warnings
from functools import partial
from typing import Any, Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from jaxouter.loop.observation import HISTORY
from jaxouter.loop.policy import Affine, AffineParams, none
from jaxouter.loop.references import telegraph
from jaxouter.plants import Plant, host, simulate
from jaxouter.plants.arx import Model

LEVELS = 8
EXPLORED = 8  # episodes from which order and dead time are identified
DRAWN = 4  # plants of which these are, each, where a plant is drawn for each episode
ORDERS = (1, 2, 3, 4, 6, 8, 12, 16)
PARSIMONY = 1e-3  # prediction error, as share of the standard deviation of y, that a smaller order may cost
COARSE = 4  # order and stride with which long dead times are searched at first
NEAR = 12  # control steps on both sides of the best of these, where the other orders are tried
FARTHEST = 0.75  # longest dead time that is searched, as share of an episode
HORIZON = 0.3  # of the predictions by which models are chosen, as share of an episode
SHOWN = 0.99  # of the prediction error without r~: with r~ it must be smaller, or y does not show it
DRIFT = 0.08  # of the gain, by which it may still change in a fifth of an episode where y has settled
NEGLIGIBLE = 0.01  # of the largest coefficient of r~; the first ones below are dead time
GROWTH = 1.5  # of the swings of y from a fifth of an episode to the next, from which it runs away
INTEGRATES = 0.05  # distance of a pole from 1, over one divided by the control steps in which nothing shows of it
STEADY = (0.97, 1.05)  # ratio of the changes in two such fifths, where y grows as that of an integrator does
ENOUGH = 20  # past samples in an observation, of a high order
BEYOND = 8  # of them beyond a long dead time
BAND = 0.05  # of the step, for the settling time
SIGNIFICANT = 3.0  # standard errors, by which y must have moved with r~
TINY = 1e-3  # of the span of the set-points, by which all of r~ must move y
LONGER = 5  # episodes, in which y is seen to move at last
ROUNDING = 1e-6  # of y
RUN_ONCE = {"xla_backend_optimization_level": 0}  # compiler options of what takes longer to compile than to run


class IdentificationWarning(UserWarning):
    """What was identified does not mean what it usually does."""


class DcGain(NamedTuple):
    """y = offset + gain * r~ in steady state; at the end of an episode where y does not settle."""

    gain: jax.Array
    offset: jax.Array
    unsettled: str | None = None
    """What y does instead of settling, in words."""
    rate: float = math.nan
    """Change of y in a control step for a unit of r~, late in an episode."""
    still: float = math.nan
    """r~ under which y then stays where it is."""


def dc_gain(plant: Plant, params: Any, key: chex.PRNGKey) -> DcGain:
    """The affine DC gain from constant-r~ episodes, one at each of 8 levels of r~ (8 episodes of environment steps).

    Each starts like a training episode; a line is fitted through the last tenth of each.

    Raises:
        ValueError: y does not tell how it answers to r~; says why.
    """
    if (simulators := host.of(plant)) is not None:
        simulators.ended = None
    levels, y, course = map(np.asarray, _steady(plant, params, key))  # the rest on the host, where nothing is compiled
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
    """Samples until the first of these outputs (n, T) runs away: is not finite after it has left the bounds; else T."""
    low, high = bounds
    bad = ~np.isfinite(y)
    left = np.any((np.nan_to_num(y, nan=low) < low) | (np.nan_to_num(y, nan=low) > high))
    return int(np.flatnonzero(bad.any(0))[0]) if bad.any() and left else y.shape[1]


def unsettled(levels: np.ndarray, y: np.ndarray) -> str | None:
    """What y does instead of coming to rest, in words; None: it has come to rest.

    The gain of y to r~ is followed through the last three fifths of an episode. It must have changed from the last but
    one to the last, by more than what a line through the levels leaves unexplained, and within the last one too.

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
        columns.append(y[:, 0] - y[:, 0].mean())  # where an episode starts may still show
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
        return None  # y swings about where it stays
    ratio = last / before if before else math.inf
    if ratio > STEADY[1]:
        return "y runs away under a constant r~"
    return "y keeps growing, as if it integrated r~," if ratio >= STEADY[0] else "y does not settle"


def _part(y: np.ndarray, length: int, before: int) -> np.ndarray:
    """Means (n,) of so many last samples of y (n, T), or of those before them."""
    end = y.shape[1] - before * length
    return y[:, end - length : end].mean(1)


def _rate(levels: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Change of y in a control step for a unit of r~, and the r~ under which there is none, in the second half."""
    half = y.shape[1] // 2
    centred, change = levels - levels.mean(), (y[:, -1] - y[:, half]) / max(1, y.shape[1] - 1 - half)
    rate = float(np.dot(centred, change) / np.sum(centred**2))
    return rate, float(levels.mean() - change.mean() / rate) if rate else math.nan


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
    """The static prefilter: the inverse of the identified affine DC gain, r~ = (r - offset) / gain.

    Where y does not settle it is r~ = r, with a warning.
    """
    identified = dc_gain(plant, params, key)
    warn_unsettled(identified.unsettled)
    return prefilter(plant, identified)


def prefilter(plant: Plant, identified: DcGain) -> tuple[Affine, AffineParams]:
    """The inverse of the DC gain; r~ = r where there is none."""
    if identified.unsettled is not None:
        return none(plant)
    return Affine(plant.r_tilde_bounds), AffineParams(1.0 / identified.gain, -identified.offset / identified.gain)


def warn_unsettled(unsettled: str | None) -> None:
    """Warns that there is no static prefilter, where y does not settle."""
    if unsettled is not None:
        text = f"{unsettled}; there is no DC gain to invert, so the static prefilter is r~ = r"
        warnings.warn(text, IdentificationWarning, stacklevel=3)


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
    """Least squares over all episodes; what is not finite is left out."""
    first, steps = n + dead - 1, data.r_tilde.shape[1]
    k = np.arange(first, steps)
    lags = k[:, None] - np.arange(n)
    past = np.concatenate([data.y[:, lags], data.r_tilde[:, lags - dead], np.ones((len(data.y), len(k), 1))], -1)
    rows, targets = past.reshape(-1, 2 * n + 1), data.y[:, k + 1].ravel()
    known = np.isfinite(targets) & np.isfinite(rows).all(1)
    rows, targets = rows[known], targets[known]
    theta = np.linalg.lstsq(rows, targets, rcond=None)[0]
    residual = targets - rows @ theta
    sigma = float(np.sqrt(np.mean(residual**2))) if residual.size else math.inf
    return ARX(theta[:n], theta[n : 2 * n], float(theta[-1]), dead, sigma)


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
    """Root mean square error of `predict`, where the truth is finite; inf where the model is of no use."""
    n, steps = len(model.a), data.r_tilde.shape[1]
    starts = np.arange(n + model.dead - 1, steps - horizon + 1, max(1, horizon // 4))
    truth = np.stack([data.y[:, starts + j + 1] for j in range(horizon)], -1)
    with np.errstate(over="ignore", invalid="ignore"):
        squares = (predict(model, data, horizon) - truth)[np.isfinite(truth)] ** 2
        error = float(np.sqrt(np.mean(squares))) if squares.size else math.inf
    return error if math.isfinite(error) else math.inf


def choose_arx(data: Record, horizon: int) -> ARX:
    """Order and dead time with the least error of prediction over the horizon on the last quarter of the record.

    Of the orders that predict about as well the smallest is taken, and fitted again to the whole record. Dead times
    beyond a twentieth of an episode are tried where a coarse search, with a stride, finds one that predicts as well.

    Args:
        data: at least 4 episodes.
        horizon: control steps.
    """
    steps, kept = data.r_tilde.shape[1], 3 * len(data.y) // 4
    fitted, held_out = (Record(data.r_tilde[part], data.y[part]) for part in (slice(kept), slice(kept, None)))

    def errors_of(orders: Any, dead_times: range, horizon: int, stride: int = 0) -> dict[tuple[int, int], float]:
        """By order and dead time, of those for which the record is long enough."""
        return {
            (n, dead): prediction_error(fit_arx(fitted, n, dead), held_out, horizon)
            for n in orders
            for dead in dead_times[:: max(1, stride * n // 4)]
            if n + dead + horizon <= steps and len(fitted.y) * (steps - n - dead) >= 2 * (2 * n + 1)
        }

    slack = PARSIMONY * float(np.nanstd(held_out.y))
    near = min(steps // 20, 2 * NEAR)
    errors = errors_of(ORDERS, range(near + 1), horizon)
    short = max(1, min(horizon, steps // 8))
    far = errors_of((COARSE,), range(near + 1, int(FARTHEST * steps) + 1, COARSE), short)
    if far:
        best = min(errors, key=lambda shape: errors[shape], default=(1, 0))
        at = min(far, key=lambda shape: far[shape])
        if far[at] <= 1.01 * prediction_error(fit_arx(fitted, *best), held_out, short) + slack:
            window = range(max(0, at[1] - NEAR), at[1] + NEAR + 1)
            within = max(1, min(horizon, (steps - at[1]) // 3))
            errors = errors_of(ORDERS, range(near + 1), within) | errors_of(ORDERS, window, within, stride=1)
    enough = 1.01 * min(errors.values(), default=math.inf) + slack
    return fit_arx(data, *min((shape for shape, error in errors.items() if error <= enough), default=(1, 0)))


class Dynamics(NamedTuple):
    """How y answers to r~, as a record tells; times in control steps."""

    order: int
    dead: int  # dead time beyond the one of sampling
    settling: float  # until a step response stays within 5 % of its end; inf: it never does
    kind: Literal["stable", "integrating", "unstable"]
    shown: bool  # whether y shows r~ at all


def dynamics(data: Record) -> Dynamics:
    """Order, dead time and kind of a plant from exciting episodes, `EXPLORED` or more."""
    steps = data.r_tilde.shape[1]
    arx = choose_arx(data, max(1, round(HORIZON * steps)))
    n, dead = len(arx.a), arx.dead
    model, horizon = as_model(arx), max(1, min(round(HORIZON * steps), (steps - n - dead) // 3))
    deaf = fit_arx(data._replace(r_tilde=np.zeros_like(data.r_tilde)), n, dead)
    shown = prediction_error(arx, data, horizon) < SHOWN * prediction_error(deaf, data, horizon)
    kind = kind_of(model, steps)
    dead += int(np.argmax(np.abs(arx.b) > NEGLIGIBLE * np.abs(arx.b).max()))
    return Dynamics(n, dead, settling(model) if kind == "stable" else math.inf, kind, shown)


def kind_of(model: Model, steps: int) -> Literal["stable", "integrating", "unstable"]:
    """Whether the model comes to rest, told by its largest pole: by what that makes of so many control steps."""
    poles = np.roots(np.append(1.0, -np.asarray(model.a)))
    largest = complex(poles[np.argmax(np.abs(poles))]) if poles.size else 0.0j
    if abs(largest) > 1.0 + 1.0 / steps:
        return "unstable"
    return "integrating" if abs(largest) >= 1.0 or abs(largest - 1.0) * steps < INTEGRATES else "stable"


def explore(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[list[Dynamics], int]:
    """Dynamics of a plant, or of some that are drawn where each episode draws one, and the control steps recorded."""
    found = []
    for one in jax.random.split(key, 1 if plant.draw is None else DRAWN):
        drawn = params if plant.draw is None else plant.draw(jax.random.fold_in(one, 1), params)
        found.append(dynamics(within(record(plant, drawn, one, EXPLORED), plant.divergence_bounds)))
    return found, len(found) * EXPLORED * plant.episode_steps


def history_for(order: int, dead: int, least: int) -> int:
    """Past samples that an observation must hold to tell what r~ is under way, and the state of such a plant."""
    return max(least, dead + min(order + 1, max(ENOUGH - dead, BEYOND)))


def suitable_history(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[int, int]:
    """Past samples that an observation of a plant holds, as it declares or told by a record; and steps recorded."""
    if plant.history is not None:
        return plant.history, 0
    found, steps = explore(plant, params, key)
    return max([HISTORY, *(history_for(one.order, one.dead, HISTORY) for one in found if one.shown)]), steps


def within(data: Record, bounds: tuple[float, float]) -> Record:
    """The record without what came after y had left the bounds, by far: there it is nan."""
    low, high = bounds
    far = 4.0 * (high - low)
    gone = np.maximum.accumulate(~((data.y >= low - far) & (data.y <= high + far)), axis=1)
    return data._replace(y=np.where(gone, np.nan, data.y))


def as_model(arx: ARX) -> Model:
    """The ARX model with its dead time as zeros at the beginning of b."""
    return Model(arx.a, np.append(np.zeros(arx.dead), arx.b), np.asarray(arx.c), np.asarray(arx.sigma))


def radius(model: Model) -> float:
    """Spectral radius; below 1 the model is stable."""
    return float(np.max(np.abs(np.roots(np.append(1.0, -model.a))), initial=0.0))


def gain(model: Model) -> float:
    """DC gain."""
    return float(np.sum(model.b) / (1.0 - np.sum(model.a)))


def offset(model: Model) -> float:
    """Y in steady state under r~ = 0."""
    return float(model.c / (1.0 - np.sum(model.a)))


def step_response(model: Model, steps: int) -> np.ndarray:
    """Change of x_0 to x_(steps - 1) from a unit step of r~_0 on; (steps,)."""
    return np.asarray(lfilter(np.append(0.0, model.b), np.append(1.0, -model.a), np.ones(steps)))


def settling(model: Model) -> int:
    """Control steps until the step response stays within 5 % of its end."""
    tail = math.log(1e-3) / math.log(max(radius(model), 1e-3))
    off = np.abs(step_response(model, len(model.b) + min(math.ceil(tail), 100_000)) / gain(model) - 1.0)
    return int(np.max(np.flatnonzero(~(off <= BAND)), initial=-1)) + 1
