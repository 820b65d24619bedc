"""Model validation: how well models of recorded data predict unseen rows, and what the record does not excite."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxouter.identification.linear_models import gain, settling, step_response
from jaxouter.identification.recorded_data import Ensemble, RecordedData, free_run, without_last_quarter
from jaxouter.plants.arx import Model
from jaxouter.plants.base import in_words

Intervals = tuple[tuple[float, float], ...]

LONGEST_RUN = 1_000  # rows of a free run
BINS = 20  # levels of r~
COHERENT = 0.5  # coherence above which y shows r~ rather than noise
PATHS = 10  # noise realisations per member
SPREAD = (0.05, 0.95)  # quantiles of the ensemble that are reported
QUANTILES = 8  # levels of y over which the error is compared


class Curves(NamedTuple):
    """Data of the validation figure."""

    time: np.ndarray  # (T,), of the held-out free run
    y: np.ndarray  # (T,)
    free_run: np.ndarray  # (T,)
    band: np.ndarray  # (2, T), 90 % of the ensemble with its noise
    responses: np.ndarray  # (members + 1, S), to a unit step of r~ at 0; the nominal model first
    levels: np.ndarray  # (BINS,), share of time that r~ spent in each bin
    edges: np.ndarray  # (BINS + 1,)
    frequency: np.ndarray  # (F,), in cycles per unit of time
    coherence: np.ndarray  # (F,)
    power: np.ndarray  # (F,), of r~


class Validation(NamedTuple):
    """Results of the validation; times in the record's unit of time, frequencies in cycles per unit of time."""

    rows: int
    control_step: float
    order: int
    dead_time: float
    gain: float  # DC gain
    gain_range: tuple[float, float]  # 90 % of the ensemble
    rise_time: float  # 10 to 90 % of a step
    settling_time: float  # to 5 % of a step
    length: float  # of the record, in settling times
    moves: int  # of r~
    moves_held_out: int  # moves of r~ in the last quarter
    error_one_step: float  # RMSE on the last quarter, of a model of the rest
    error_free_run: float
    fit_one_step: float  # share of the variance of y that is explained
    fit_free_run: float
    coverage: float  # share of that quarter's y within the ensemble's 90 % band
    bias: float  # mean error of that free run, in standard deviations of y
    nonlinearity: float  # part of a free run's error that depends on the level of y, in standard deviations of y
    levels_seen: float  # share of the range of r~ that it visited
    levels_unseen: Intervals
    needed: float  # highest frequency that matters: one over the rise time
    excited: Intervals  # frequencies at which y shows r~
    excited_share: float  # excited share of the frequencies up to `needed`
    redrawn: int  # unstable members that were drawn again
    warnings: tuple[str, ...]
    curves: Curves


def validate(data: RecordedData, models: Ensemble, seed: int = 0) -> Validation:
    """Validate the models of recorded data.

    Errors are on the last quarter of the record, by models of the first three. The last quarter had no part in the
    choice of order and dead time either.

    Args:
        data: as returned by `read`.
        models: of the whole record.
        seed: for blocks and noise.
    """
    cut = 3 * len(data.time) // 4
    tried = without_last_quarter(data, models, seed)
    rows = min(len(data.time) - cut, LONGEST_RUN)
    y, predicted = data.y[cut : cut + rows], free_run(tried.nominal, data, cut, rows)
    one_step = _one_step(tried.nominal, data, cut)
    band = _band(tried, data, cut, rows, np.random.default_rng(seed))
    spread, of_these = float(np.std(data.y)), max(float(np.std(data.y[cut:])), 1e-9 * float(np.std(data.y)))
    settled = max(settling(models.nominal), 1)
    rise = _rise(models.nominal, settled)
    gains = np.quantile([gain(model) for model in models.members], SPREAD)
    levels, edges = np.histogram(data.r_tilde, BINS)
    frequency, coherence, power = _excitation(data, settled)
    needed = 1.0 / (rise * data.step)
    matter = frequency <= max(needed, frequency[0])
    unweighed = Validation(
        rows=len(data.time),
        control_step=data.step,
        order=models.order,
        dead_time=models.dead * data.step,
        gain=gain(models.nominal),
        gain_range=(float(gains[0]), float(gains[1])),
        rise_time=rise * data.step,
        settling_time=settled * data.step,
        length=len(data.time) / settled,
        moves=int(np.count_nonzero(np.diff(data.r_tilde))),
        moves_held_out=int(np.count_nonzero(np.diff(data.r_tilde[cut:]))),
        error_one_step=_root_mean_square(one_step),
        error_free_run=_root_mean_square(y - predicted),
        fit_one_step=1.0 - (_root_mean_square(one_step) / of_these) ** 2,
        fit_free_run=1.0 - (_root_mean_square(y - predicted) / of_these) ** 2,
        coverage=float(np.mean((y >= band[0]) & (y <= band[1]))),
        bias=float(np.mean(y - predicted)) / spread,
        nonlinearity=_nonlinearity(models.nominal, data, settled) / spread,
        levels_seen=float(np.mean(levels > 0)),
        levels_unseen=_runs(levels == 0, edges),
        needed=needed,
        excited=_runs(coherence > COHERENT, _edges(frequency)),
        excited_share=float(np.mean(coherence[matter] > COHERENT)),
        redrawn=models.redrawn,
        warnings=(),
        curves=Curves(
            time=data.time[cut : cut + rows],
            y=y,
            free_run=predicted,
            band=band,
            responses=np.stack([step_response(model, 2 * settled + 2) for model in (models.nominal, *models.members)]),
            levels=levels / len(data.r_tilde),
            edges=edges,
            frequency=frequency,
            coherence=coherence,
            power=power,
        ),
    )
    return unweighed._replace(warnings=tuple(_warnings(unweighed)))


def _root_mean_square(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _one_step(model: Model, data: RecordedData, first: int) -> np.ndarray:
    """One-step prediction errors of the rows from `first` on."""
    of_y = scipy.signal.lfilter(np.append(1.0, -model.a), [1.0], data.y)
    of_r_tilde = scipy.signal.lfilter(np.append(0.0, model.b), [1.0], data.r_tilde)
    return (np.asarray(of_y) - np.asarray(of_r_tilde))[first:] - model.c


def _band(models: Ensemble, data: RecordedData, first: int, rows: int, rng: np.random.Generator) -> np.ndarray:
    """Quantiles of the members' simulated y, with noise, in the rows from `first` on; (2, rows)."""
    paths = [
        free_run(model, data, first, rows)
        + scipy.signal.lfilter([1.0], np.append(1.0, -model.a), model.sigma * rng.standard_normal((PATHS, rows)))
        for model in models.members
    ]
    return np.quantile(np.concatenate(paths), SPREAD, axis=0)


def _rise(model: Model, settled: int) -> int:
    """Control steps from 10 to 90 % of a step, at least one."""
    share = step_response(model, settled + len(model.b) + 2) / gain(model)
    return max(1, int(np.argmax(share >= 0.9) - np.argmax(share >= 0.1)))


def _excitation(data: RecordedData, settled: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies above zero, coherence of r~ and y, and power of r~, from segments of four settling times or less."""
    segment = min(max(4 * settled, 32), len(data.time) // 8)
    rate = 1.0 / data.step
    with np.errstate(invalid="ignore", divide="ignore"):
        frequency, coherence = scipy.signal.coherence(data.r_tilde, data.y, rate, nperseg=segment)
    power = scipy.signal.welch(data.r_tilde, rate, nperseg=segment)[1]
    return frequency[1:], np.nan_to_num(coherence[1:]), power[1:]


def _nonlinearity(model: Model, data: RecordedData, settled: int) -> float:
    """RMS over the levels of y of a free run's mean error at each, less what chance would give."""
    first = min(len(model.b) + settled, len(data.time) // 2)
    predicted = free_run(model, data, first, len(data.time) - first)
    error = data.y[first:] - predicted
    error = error - error.mean()
    of_level = np.searchsorted(np.unique(np.quantile(predicted, np.linspace(0.0, 1.0, QUANTILES + 1)[1:-1])), predicted)
    rows = np.bincount(of_level)
    means = np.bincount(of_level, error) / np.maximum(rows, 1)
    chance = np.var(error) * QUANTILES * settled / len(error)
    return float(np.sqrt(max(np.dot(rows, means**2) / len(error) - chance, 0.0)))


def _edges(centres: np.ndarray) -> np.ndarray:
    half = np.diff(centres[:2]).sum() / 2.0
    return np.append(centres - half, centres[-1] + half)


def _runs(true: np.ndarray, edges: np.ndarray) -> Intervals:
    """Bins in which a condition holds, as intervals between their edges."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(int)))
    return tuple((float(edges[a]), float(edges[b])) for a, b in zip(change[::2], change[1::2], strict=True))


def _listed(intervals: Sequence[tuple[float, float]]) -> str:
    return ", ".join(f"{low:.3g} to {high:.3g}" for low, high in intervals)


def _gaps(found: Validation) -> Intervals:
    """Frequencies that matter but at which y does not show r~."""
    frequency, coherence = found.curves.frequency, found.curves.coherence
    matter = frequency <= max(found.needed, frequency[0])
    return _runs(coherence[matter] <= COHERENT, _edges(frequency)[: np.count_nonzero(matter) + 1])


def _warnings(it: Validation) -> list[str]:
    """What is weak about the record or the models, and what to do about it."""
    low, high = it.gain_range
    weak = {
        f"the record is only {it.length:.3g} settling times long; 20 or more show how much the models may differ": (
            it.length < 20
        ),
        f"r~ moves only {it.moves} times; each move shows once how y responds, so move it 20 times or more": (
            it.moves < 20
        ),
        f"the DC gain is only known to be {low:.3g} to {high:.3g}; hold r~ at several levels until y has settled": (
            high - low > 0.2 * abs(it.gain)
        ),
        f"r~ moves only {it.moves_held_out} times in the last quarter; what is predicted there says little": (
            it.moves_held_out < 3
        ),
        f"r~ was never at {_listed(it.levels_unseen)}; whether y is as linear there is a guess": it.levels_seen < 0.7,
        f"y does not show r~ at the frequencies {_listed(_gaps(it))} (coherence below {COHERENT:g}), but an outer loop "
        f"needs those up to {it.needed:.3g}; move r~ at such rates, or by more": it.excited_share < 0.8,
        f"a model of the rest explains only {max(it.fit_free_run, 0.0):.0%} of the variance of y in the last quarter "
        "(free run); a controller based on it is a guess": it.fit_free_run < 0.8,
        f"only {it.coverage:.0%} of the last quarter lies in the 90 % band of the ensemble; the plant differs from the "
        "nominal model by more than the ensemble does": it.coverage < 0.75 and it.fit_free_run < 0.999,
        f"in the last quarter y is off by {abs(it.bias):.2g} standard deviations on average: a load or a drift that "
        "the ensemble does not know": abs(it.bias) > 0.2,
        f"the error depends on the level of y, by {it.nonlinearity:.2g} of its standard deviation: the plant is not "
        "linear; keep set-points to a narrower range": it.nonlinearity > 0.05,
        f"{it.redrawn} members were unstable and drawn again": it.redrawn > 0,
        "y rises within two control steps; a shorter step would show how": it.rise_time < 2.5 * it.control_step,
        f"y takes {it.rise_time / it.control_step:.0f} control steps to rise; keep every n-th row only, so that it "
        "takes 5 to 20, and the outer loop sees further back": it.rise_time > 150 * it.control_step,
    }
    return [text for text, is_weak in weak.items() if is_weak]


def table(found: Validation, y_unit: str = "1", time_unit: str = "s") -> list[tuple[str, str]]:
    """The validation as rows of a table: quantity, value."""
    y, t = in_words(y_unit), time_unit
    low, high = found.gain_range
    return [
        ("rows", f"{found.rows} of {found.control_step:.3g} {t}, {found.length:.3g} settling times"),
        ("model", f"order {found.order}, dead time {found.dead_time:.3g} {t}"),
        ("DC gain", f"{found.gain:.3g} ({low:.3g} to {high:.3g})"),
        ("rise, settling", f"{found.rise_time:.3g} {t}, {found.settling_time:.3g} {t}"),
        (
            "held out, one step",
            f"RMSE {found.error_one_step:.3g}{y}, {max(found.fit_one_step, 0.0):.1%} of the variance",
        ),
        (
            "held out, free run",
            f"RMSE {found.error_free_run:.3g}{y}, {max(found.fit_free_run, 0.0):.1%} of the variance",
        ),
        ("held out, in the band of 90 %", f"{found.coverage:.0%}"),
        ("levels of r~ seen", f"{found.levels_seen:.0%}, {found.moves} moves"),
        ("frequencies shown", f"{found.excited_share:.0%} of those up to {found.needed:.3g} /{t}"),
        ("error by the level of y", f"{found.nonlinearity:.2g} of its standard deviation"),
    ]
