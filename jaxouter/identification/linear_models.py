"""Linear models of y from past y and r~ (ARX): least squares, prediction, choice of order and dead time."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy

from jaxouter.identification.records import Record
from jaxouter.plants.arx import Model

ORDERS = (1, 2, 3, 4, 6, 8, 12, 16)
PARSIMONY = 1e-3  # prediction error, as share of the standard deviation of y, that a smaller order may cost
COARSE = 4  # order and stride of the first search for long dead times
NEAR = 12  # control steps on both sides of its best, where the other orders are tried
FARTHEST = 0.75  # longest dead time searched, as share of an episode
HORIZON = 0.3  # prediction horizon for choosing models, as share of an episode
INTEGRATES = 0.05  # a pole closer to 1 than this divided by the episode length can't be told from an integrator
BAND = 0.05  # of the step, for the settling time


class ARX(NamedTuple):
    """y_(k+1) = sum_i a_i y_(k-i) + sum_i b_i r~_(k-dead-i) + c + e, i from 0."""

    a: np.ndarray  # (n,)
    b: np.ndarray  # (n,)
    c: float
    dead: int  # dead time in control steps, in addition to the one of sampling
    sigma: float  # standard deviation of e


def fit_arx(data: Record, n: int, dead: int) -> ARX:
    """Least squares over all episodes; samples that are not finite are left out."""
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
    """Predictions of y up to `horizon` steps ahead, given the recorded r~; (episodes, starts, horizon)."""
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
    """Root mean square error of `predict` where the truth is finite; inf if it diverges or nothing is left."""
    n, steps = len(model.a), data.r_tilde.shape[1]
    starts = np.arange(n + model.dead - 1, steps - horizon + 1, max(1, horizon // 4))
    truth = np.stack([data.y[:, starts + j + 1] for j in range(horizon)], -1)
    with np.errstate(over="ignore", invalid="ignore"):
        squares = (predict(model, data, horizon) - truth)[np.isfinite(truth)] ** 2
        error = float(np.sqrt(np.mean(squares))) if squares.size else math.inf
    return error if math.isfinite(error) else math.inf


def choose_arx(data: Record, horizon: int) -> ARX:
    """Order and dead time with the least prediction error over the horizon on the last quarter of the record.

    The smallest order that predicts about as well is taken, and fitted again to the whole record. Dead times beyond a
    twentieth of an episode are tried only if a coarse search finds one that predicts as well.

    Args:
        data: at least 4 episodes.
        horizon: control steps.
    """
    steps, kept = data.r_tilde.shape[1], 3 * len(data.y) // 4
    fitted, held_out = (Record(data.r_tilde[part], data.y[part]) for part in (slice(kept), slice(kept, None)))

    def errors_of(orders: Any, dead_times: range, horizon: int, stride: int = 0) -> dict[tuple[int, int], float]:
        """Errors by (order, dead time), for those that the record is long enough for."""
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


def kind_of(model: Model, steps: int) -> Literal["stable", "integrating", "unstable"]:
    """Kind of the model by its largest pole, as far as it shows within `steps` control steps."""
    poles = np.roots(np.append(1.0, -np.asarray(model.a)))
    largest = complex(poles[np.argmax(np.abs(poles))]) if poles.size else 0.0j
    if abs(largest) > 1.0 + 1.0 / steps:
        return "unstable"
    return "integrating" if abs(largest) >= 1.0 or abs(largest - 1.0) * steps < INTEGRATES else "stable"


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
    """Steady-state y under r~ = 0."""
    return float(model.c / (1.0 - np.sum(model.a)))


def step_response(model: Model, steps: int) -> np.ndarray:
    """Change of y_0 to y_(steps - 1) after a unit step of r~ at 0; (steps,)."""
    return np.asarray(scipy.signal.lfilter(np.append(0.0, model.b), np.append(1.0, -model.a), np.ones(steps)))


def impulse_response(model: Model, steps: int) -> np.ndarray:
    """Change of y_1 to y_steps after an r~ larger by 1 in control step 0 alone; (steps,)."""
    return np.asarray(scipy.signal.lfilter(model.b, np.append(1.0, -model.a), np.eye(1, steps)[0]))


def settling(model: Model) -> int:
    """Control steps until the step response stays within 5 % of its final value."""
    tail = math.log(1e-3) / math.log(max(radius(model), 1e-3))
    off = np.abs(step_response(model, len(model.b) + min(math.ceil(tail), 100_000)) / gain(model) - 1.0)
    return int(np.max(np.flatnonzero(~(off <= BAND)), initial=-1)) + 1
