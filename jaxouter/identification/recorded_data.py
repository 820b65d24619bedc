"""A plant from recorded r~ and y: an ensemble of identified models, whose spread is the domain randomisation."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from jaxouter.identification import columns
from jaxouter.identification.dynamics import history_for
from jaxouter.identification.linear_models import as_model, fit_arx, gain, kind_of, offset, radius, settling
from jaxouter.identification.records import Record
from jaxouter.plants import Plant, arx
from jaxouter.plants.arx import Model
from jaxouter.plants.simulators import PlantOptions

COLUMNS = ("time", "r_tilde", "y")
LEAST_ROWS = 200
JITTER = 1e-3  # allowed deviation of a time step from the median, as share of it
ORDERS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
EACH = 8  # least rows per coefficient
COARSE = 4  # order of the first search for the dead time
NEAR = 20  # control steps on both sides of its best, where the other orders are tried
STRIDE = 4  # of the first search over dead times; at least half the order
EPISODE = (100, 400)  # bounds on an episode of four settling times, in control steps; longer if y settles too slowly
LONGEST_EPISODE = 2_000  # control steps
FINE = 8  # up to this order every dead time is tried; for higher ones b covers those between
LONGEST = 2_000  # rows of each third used to choose order and dead time
PARSIMONY = 3e-3  # increase of the free-run error, in standard deviations of y, accepted for a smaller order
LITTLE = 0.1  # one-step error of a good model, as share of the standard deviation of y's changes
ROUNDING = 1e-9  # a pole within this of 1 may be an integrator
LEAST_HISTORY = 5  # past samples in the observation
AGREE = 0.9  # share of the members that must be able to hold a set-point


class RecordedData(NamedTuple):
    """One continuous record; r~_k is applied from time_k on, y_k is the sample at time_k."""

    time: np.ndarray  # (N,)
    r_tilde: np.ndarray  # (N,)
    y: np.ndarray  # (N,)

    @property
    def step(self) -> float:
        """The control step, rounded to nine digits."""
        return float(f"{(self.time[-1] - self.time[0]) / (len(self.time) - 1):.9g}")

    def rows(self, first: int, end: int) -> RecordedData:
        """Rows `first` to `end` - 1."""
        return RecordedData(*(column[first:end] for column in self))


class Ensemble(NamedTuple):
    """Models of one record: the nominal one, and an ensemble that shows how uncertain it is."""

    order: int
    dead: int  # dead time in control steps, in addition to the one of sampling; a member may have one more or less
    nominal: Model  # fitted to all rows
    members: tuple[Model, ...]  # fitted to blocks of rows drawn with replacement
    redrawn: int  # unstable members that were drawn again


def read(path: str | Path) -> RecordedData:
    """Read a record from a CSV or Parquet file with the columns time, r_tilde and y; others are ignored.

    Raises:
        ValueError: names the file, the row (of the data, from 1 on), and what is allowed.
    """
    path = Path(path)
    if path.suffix.lower() not in (".csv", ".parquet"):
        raise ValueError(f"the record {path} is neither .csv nor .parquet; export it as CSV with {','.join(COLUMNS)}")
    if not path.is_file():
        raise ValueError(f"there is no recorded data {path}")
    data = RecordedData(*columns.read(path, COLUMNS))
    try:
        _check(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return data


def _check(data: RecordedData) -> None:
    """Raises ValueError; names the row and what is allowed."""
    for name, column in data._asdict().items():
        bad = np.flatnonzero(~np.isfinite(column))
        if len(bad):
            raise ValueError(f"{name} in row {bad[0] + 1} is {column[bad[0]]}; it must be finite")
    if len(data.time) < LEAST_ROWS:
        raise ValueError(f"there are {len(data.time)} rows; there must be at least {LEAST_ROWS}")
    steps = np.diff(data.time)
    typical = float(np.median(steps))
    for bad, rule in (
        (steps <= 0.0, "it must increase from row to row"),
        (
            np.abs(steps - typical) > JITTER * typical,
            f"the step must be constant within {JITTER:.1%}, here {typical:g}: cut the record, resample it, or "
            "write time with more digits",
        ),
    ):
        if bad.any():
            row = int(np.argmax(bad))
            before, after = data.time[row : row + 2]
            raise ValueError(f"time goes from {before:.10g} in row {row + 1} to {after:.10g} in row {row + 2}; {rule}")
    for name in ("r_tilde", "y"):
        column = getattr(data, name)
        if np.ptp(column) == 0.0:
            raise ValueError(f"{name} is {column[0]:g} in every row; how y answers to r~ shows only where r~ moves")


def free_run(model: Model, data: RecordedData, first: int, rows: int) -> np.ndarray:
    """Simulated y of `rows` rows from `first` on, given the measured y before them and r~ throughout; (rows,).

    Args:
        model: stable.
        data: with at least as many rows before `first` as the model looks back.
        first, rows: start and length.
    """
    level, delayed, past = offset(model), np.append(0.0, model.b), np.append(1.0, -model.a)
    known = scipy.signal.lfiltic(delayed, past, data.y[:first][::-1] - level, data.r_tilde[:first][::-1])
    return np.asarray(scipy.signal.lfilter(delayed, past, data.r_tilde[first : first + rows], zi=known)[0]) + level


def fit(data: RecordedData, n: int, dead: int, rows: np.ndarray) -> Model:
    """Fit a model by least squares.

    Args:
        data: the record.
        n, dead: order; dead time in control steps, in addition to the one of sampling.
        rows: (episodes, T + 1), blocks of consecutive rows to fit.
    """
    return as_model(fit_arx(Record(data.r_tilde[rows[:, :-1]], data.y[rows]), n, dead))


def choose(data: RecordedData) -> tuple[int, int]:
    """Order and dead time with the least free-run error in three-fold cross-validation.

    Each third of the record is predicted by models of the two others. The smallest order that is about as good is
    taken, with its longest dead time that is. Sensor noise needs a high order: least squares are unbiased only if the
    order suffices for the noise too.

    Raises:
        ValueError: every model is unstable.
    """
    third = min(len(data.time) // 3, LONGEST)
    rows = len(data.time) // 3 * np.arange(3)[:, None] + np.arange(third)
    most = max(third // 4, min(third - EACH * (2 * COARSE + 1) // 2, 3 * third // 4))
    slack = PARSIMONY * float(np.std(data.y))
    coarse = {dead: _error(data, rows, COARSE, dead) for dead in range(0, most + 1, STRIDE)}
    near = min(coarse, key=lambda dead: coarse[dead])
    errors: dict[int, dict[int, float]] = {}  # by order, then dead time
    for n in (n for n in ORDERS if n == 1 or EACH * (2 * n + 1) <= 2 * third):
        longest = max(0, third - EACH * (2 * n + 1) // 2)  # leaves enough rows
        first = max(0, min(near - NEAR, longest))
        tried = range(first, max(first, min(near + NEAR, most, longest)) + 1, max(STRIDE, n // 2))
        of_n = errors[n] = {dead: _error(data, rows, n, dead) for dead in tried}
        _look_near(min(of_n, key=lambda dead: of_n[dead]), data, rows, n, of_n, most)
    best = min(min(of_n.values()) for of_n in errors.values())
    enough = 1.01 * best + slack
    if not math.isfinite(enough):
        raise ValueError(_unsettled(fit(data, COARSE, near, rows), len(data.time)))
    n = next(n for n, of_n in errors.items() if min(of_n.values()) <= enough)
    late = max(dead for dead, error in errors[n].items() if error <= enough)
    _look_near(late, data, rows, n, errors[n], most)
    late = max(dead for dead, error in errors[n].items() if error <= enough)
    _must_be_best(fit(data, n, late, rows), data, rows, most)
    return n, late


def _must_be_best(chosen: Model, data: RecordedData, rows: np.ndarray, most: int) -> None:
    """Raises ValueError if an unstable or integrating model predicts one step ahead far better."""
    if chosen.sigma > LITTLE * np.std(np.diff(data.y)):
        tried = (fit(data, COARSE, dead, rows) for dead in range(0, most + 1, STRIDE))
        best = min(tried, key=lambda model: model.sigma)
        if best.sigma < chosen.sigma / 2.0 and kind_of(best, len(data.time)) != "stable":
            raise ValueError(_unsettled(best, len(data.time)))


def _look_near(dead: int, data: RecordedData, rows: np.ndarray, n: int, errors: dict[int, float], most: int) -> None:
    """Add the errors of the dead times next to this one that the stride left out."""
    for each in range(max(0, dead - STRIDE + 1), min(most, dead + STRIDE - 1) + 1) if n <= FINE else ():
        if each not in errors:
            errors[each] = _error(data, rows, n, each)


def _error(data: RecordedData, rows: np.ndarray, n: int, dead: int) -> float:
    """Free-run RMSE on each third (3, T) of the model fitted to the others; inf if one is unstable."""
    total = 0.0
    for i, held_out in enumerate(rows):
        model, first = fit(data, n, dead, np.delete(rows, i, 0)), held_out[0] + n + dead
        if radius(model) > 1.0 - ROUNDING:
            return math.inf
        y = data.y[first : held_out[-1] + 1]
        total += float(np.mean((y - free_run(model, data, first, len(y))) ** 2)) / len(rows)
    return math.sqrt(total)


def ensemble(data: RecordedData, members: int = 16, seed: int = 0, shape: tuple[int, int] | None = None) -> Ensemble:
    """Models of the record: the nominal one of all rows, and members of resampled rows (moving block bootstrap).

    The blocks are twice as long as the nominal settling time, or an eighth of the record if that is shorter. Members of
    a low order choose the dead time within a step of the nominal one. Unstable members are drawn again.

    Args:
        data: record.
        members: number of members.
        seed: for drawing blocks.
        shape: order and dead time; None: chosen on the first three quarters of the record, so that the last one stays
            unseen for validation.

    Raises:
        ValueError: the models are unstable, or `members` is too small.
    """
    if members < 2:
        raise ValueError(f"members is {members}; it must be at least 2")
    n, dead = choose(data.rows(0, 3 * len(data.time) // 4)) if shape is None else shape
    rows, rng = np.arange(len(data.time)), np.random.default_rng(seed)
    nominal = fit(data, n, dead, rows[None])
    if kind_of(nominal, len(rows)) != "stable" or (shape is None and settling(nominal) > len(rows)):
        raise ValueError(_unsettled(nominal, len(rows)))
    lead = n + dead
    block = min(max(2 * settling(nominal), 2 * lead), (len(rows) - lead) // 8)
    late = range(max(0, dead - 1), dead + 2) if n <= FINE else (dead,)
    found, redrawn = [], 0
    while len(found) < members:
        first = rng.integers(0, len(rows) - lead - block, (math.ceil((len(rows) - lead) / block), 1))
        drawn = first + np.arange(lead + block + 1)
        model = min((fit(data, n, each, drawn) for each in late), key=lambda model: model.sigma)
        if radius(model) < 1.0:
            found.append(model)
        else:
            redrawn += 1
        if redrawn > 4 * members:
            tried = redrawn + len(found)
            raise ValueError(f"{redrawn} of {tried} models of resampled rows are unstable; record for longer")
    memory = lead + 1
    nominal, *each = (_padded(model, memory) for model in (nominal, *found))
    return Ensemble(n, dead, nominal, tuple(each), redrawn)


def _unsettled(model: Model, rows: int) -> str:
    """Why this model is no basis for a plant."""
    found = {
        "unstable": "the models of this record are unstable",
        "integrating": "y integrates r~ in this record",
        "stable": f"y does not settle within the {rows} rows of this record",
    }[kind_of(model, rows)]
    return (
        f"{found}; y must come to rest by itself under a constant r~, and the record must show it many times. If it "
        "does, the record is too short or drifts; if not, write the plant as FILE.py:NAME"
    )


def without_last_quarter(data: RecordedData, models: Ensemble, seed: int = 0) -> Ensemble:
    """Models of the same order and dead time, fitted to the first three quarters of the record."""
    return ensemble(data.rows(0, 3 * len(data.time) // 4), len(models.members), seed, (models.order, models.dead))


def _padded(model: Model, memory: int) -> Model:
    """The model with b padded to `memory` coefficients."""
    return model._replace(b=np.append(model.b, np.zeros(memory - len(model.b))))


def identified(path: str | Path, members: int = 16, seed: int = 0) -> tuple[RecordedData, Ensemble]:
    """The record in a file and its models; cached until the file changes."""
    path = Path(path).absolute()
    stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else None
    return _identified(path, stamp, members, seed)


@lru_cache(16)
def _identified(path: Path, stamp: Any, members: int, seed: int) -> tuple[RecordedData, Ensemble]:
    del stamp
    data = read(path)
    try:
        models = ensemble(data, members, seed)
        without_last_quarter(data, models, seed)  # refuse here, for all commands, what can't be validated
        return data, models
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def set_points(data: RecordedData, models: Ensemble, r_tilde_bounds: tuple[float, float]) -> tuple[float, float]:
    """Range of y that nine of ten members can hold within the bounds of r~ and that the record has reached.

    Raises:
        ValueError: there is no such range.
    """
    ends = np.sort([[gain(model) * r_tilde + offset(model) for r_tilde in r_tilde_bounds] for model in models.members])
    low = max(float(np.quantile(ends[:, 0], AGREE)), float(data.y.min()))
    high = min(float(np.quantile(ends[:, 1], 1.0 - AGREE)), float(data.y.max()))
    if not low < high:
        raise ValueError(
            f"the models of this record do not agree on any y that r~ in {r_tilde_bounds} holds; r~ must move further, "
            "and stay until y has settled"
        )
    return low, high


def make(name: str, path: str, options: PlantOptions = PlantOptions()) -> tuple[Plant, arx.ARXParams]:  # noqa: B008
    """The plant of a record, and its parameters: the nominal model; each training episode draws a member.

    Unless the options say otherwise, r~ stays in its recorded range, set-points in the range that nine of ten members
    can hold, and an episode is four settling times long, within 100 to 400 control steps.

    Args:
        name: of the plant.
        path: CSV or Parquet file, see `read`; time in s.
        options: what is known in addition to the record.

    Raises:
        ValueError: the record is malformed, or not informative enough.
    """
    if (options.control_step, options.input, options.output) != (None, None, None):
        raise ValueError(
            "recorded data define the control step and have one r~ and one y; leave out --control-step, --input and "
            "--output"
        )
    data, models = identified(path)
    bounds = options.r_tilde_bounds or (float(data.r_tilde.min()), float(data.r_tilde.max()))
    settled = settling(models.nominal)
    declared = options.declared(
        r_tilde_bounds=bounds,
        setpoint_range=options.setpoint_range or set_points(data, models, bounds),
        control_step=data.step,
        episode_steps=max(min(max(4 * settled, EPISODE[0]), EPISODE[1]), min(2 * settled, LONGEST_EPISODE)),
        y_unit="1",
    )
    span = float(np.ptp(data.y))
    return arx.make(
        models.nominal,
        models.members,
        name=name,
        time_unit="s",
        divergence_bounds=(float(data.y.min()) - 2.0 * span, float(data.y.max()) + 2.0 * span),
        history=history_for(models.order, models.dead, LEAST_HISTORY),
        family_steps=3 * declared["episode_steps"],
        **declared,
    )
