"""A plant from a record of r~ and y: an ensemble of identified models, whose spread is the domain randomisation."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter, lfiltic

from jaxouter.identification import columns
from jaxouter.identification.dynamics import history_for
from jaxouter.identification.linear_models import as_model, fit_arx, gain, kind_of, offset, radius, settling
from jaxouter.identification.records import Record
from jaxouter.plants import Plant, arx
from jaxouter.plants.arx import Model
from jaxouter.plants.simulators import PlantOptions

COLUMNS = ("time", "r_tilde", "y")
LEAST_ROWS = 200
JITTER = 1e-3  # by which a step may differ from the others, as share of it
ORDERS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
EACH = 8  # rows that a coefficient takes at least
COARSE = 4  # order with which the dead time is searched at first
NEAR = 20  # control steps on both sides of what it finds, where the other orders are tried
STRIDE = 4  # with which dead times are searched at first, or half of the order
EPISODE = (100, 400)  # control steps of an episode of four settling times, unless y does not settle in half of them
LONGEST_EPISODE = 2_000  # control steps
FINE = 8  # order up to which a dead time is told to a step; beyond, b covers what lies between
LONGEST = 2_000  # rows of each third by which order and dead time are chosen
PARSIMONY = 3e-3  # error of the free run, as share of the standard deviation of y, that a smaller order may cost
LITTLE = 0.1  # of the moves of y in a step, that a model may leave untold
ROUNDING = 1e-9  # of a pole, which may be that of an integrator
LEAST_HISTORY = 5  # past samples in the observation
AGREE = 0.9  # of the members must be able to hold a set-point


class RecordedData(NamedTuple):
    """One continuous record; r~_k is applied from time_k on, y_k is the sample at time_k."""

    time: np.ndarray  # (N,)
    r_tilde: np.ndarray  # (N,)
    y: np.ndarray  # (N,)

    @property
    def step(self) -> float:
        """The control step, without the last digits of the times."""
        return float(f"{(self.time[-1] - self.time[0]) / (len(self.time) - 1):.9g}")

    def rows(self, first: int, end: int) -> RecordedData:
        """Rows `first` to `end` - 1."""
        return RecordedData(*(column[first:end] for column in self))


class Ensemble(NamedTuple):
    """Models of one record."""

    order: int
    dead: int  # dead time in control steps beyond the one of sampling; a member may have one more or less
    nominal: Model  # fitted to all rows
    members: tuple[Model, ...]  # fitted to blocks of rows drawn with replacement
    redrawn: int  # members that were unstable, and drawn again


def read(path: str | Path) -> RecordedData:
    """The record in a CSV or Parquet file with the columns time, r_tilde and y; others are left alone.

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
    """Raises ValueError, naming row and what is allowed."""
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
            f"the step must be constant within {JITTER:.1%}, here {typical:g}: cut the record, sample it anew, or "
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
    """Y in so many rows from `first` on by the model alone, which knows y before them and r~ throughout; (rows,).

    Args:
        model: stable.
        data: at least as many rows before `first` as the model looks back.
        first, rows: which.
    """
    level, delayed, past = offset(model), np.append(0.0, model.b), np.append(1.0, -model.a)
    known = lfiltic(delayed, past, data.y[:first][::-1] - level, data.r_tilde[:first][::-1])
    return np.asarray(lfilter(delayed, past, data.r_tilde[first : first + rows], zi=known)[0]) + level


def fit(data: RecordedData, n: int, dead: int, rows: np.ndarray) -> Model:
    """The model by least squares of e.

    Args:
        data: the record.
        n, dead: order; dead time in control steps beyond the one of sampling.
        rows: (episodes, T + 1), consecutive rows that count.
    """
    return as_model(fit_arx(Record(data.r_tilde[rows[:, :-1]], data.y[rows]), n, dead))


def choose(data: RecordedData) -> tuple[int, int]:
    """Order and dead time whose free run is nearest to y on rows that the fit has not seen.

    Each third of the record is told by models of the two others. Of the orders that are about as good the smallest is
    taken, and of its dead times the longest. Noise of a sensor takes a high order: least squares are unbiased only
    where the order is enough for the noise too.

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
        longest = max(0, third - EACH * (2 * n + 1) // 2)  # that leaves rows enough
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
    """Raises ValueError where models that are not stable, which can't run freely, tell far more a step ahead."""
    if chosen.sigma > LITTLE * np.std(np.diff(data.y)):
        tried = (fit(data, COARSE, dead, rows) for dead in range(0, most + 1, STRIDE))
        best = min(tried, key=lambda model: model.sigma)
        if best.sigma < chosen.sigma / 2.0 and kind_of(best, len(data.time)) != "stable":
            raise ValueError(_unsettled(best, len(data.time)))


def _look_near(dead: int, data: RecordedData, rows: np.ndarray, n: int, errors: dict[int, float], most: int) -> None:
    """Adds the errors of the dead times that the stride has left out beside this one."""
    for each in range(max(0, dead - STRIDE + 1), min(most, dead + STRIDE - 1) + 1) if n <= FINE else ():
        if each not in errors:
            errors[each] = _error(data, rows, n, each)


def _error(data: RecordedData, rows: np.ndarray, n: int, dead: int) -> float:
    """Root mean square error of the free run in each third (3, T) of the model of the others; inf where unstable."""
    total = 0.0
    for i, held_out in enumerate(rows):
        model, first = fit(data, n, dead, np.delete(rows, i, 0)), held_out[0] + n + dead
        if radius(model) > 1.0 - ROUNDING:
            return math.inf
        y = data.y[first : held_out[-1] + 1]
        total += float(np.mean((y - free_run(model, data, first, len(y))) ** 2)) / len(rows)
    return math.sqrt(total)


def ensemble(data: RecordedData, members: int = 16, seed: int = 0, shape: tuple[int, int] | None = None) -> Ensemble:
    """Models of the record: the nominal one of all rows, and those of resampled rows (moving block bootstrap).

    The blocks are twice as long as the nominal model remembers, where there are eight of them. A member of a low order
    takes the dead time, the nominal one or a step beside it, that fits its rows best. Unstable ones are drawn again.

    Args:
        data: what is fitted.
        members: how many.
        seed: of the blocks.
        shape: order and dead time; None: `choose` of the first three quarters of the record, so that no choice
            has seen the last one.

    Raises:
        ValueError: the models are unstable, or there are too few members.
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
    """Why no plant is made of a record with this model."""
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
    """Models of the same order and dead time, of the first three quarters of the record alone."""
    return ensemble(data.rows(0, 3 * len(data.time) // 4), len(models.members), seed, (models.order, models.dead))


def _padded(model: Model, memory: int) -> Model:
    """With b of so many coefficients."""
    return model._replace(b=np.append(model.b, np.zeros(memory - len(model.b))))


def identified(path: str | Path, members: int = 16, seed: int = 0) -> tuple[RecordedData, Ensemble]:
    """The record in a file and its models, made once for each content of the file."""
    path = Path(path).absolute()
    stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else None
    return _identified(path, stamp, members, seed)


@lru_cache(16)
def _identified(path: Path, stamp: Any, members: int, seed: int) -> tuple[RecordedData, Ensemble]:
    del stamp
    data = read(path)
    try:
        models = ensemble(data, members, seed)
        without_last_quarter(data, models, seed)  # what can't be validated is refused here, for all commands alike
        return data, models
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def set_points(data: RecordedData, models: Ensemble, r_tilde_bounds: tuple[float, float]) -> tuple[float, float]:
    """What nine of ten members can hold within the bounds of r~, as far as it has been seen.

    Raises:
        ValueError: there is nothing of the kind.
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
    """The plant of a record, and its parameters: undrawn the model of all rows, drawn a member of the ensemble.

    r~ stays within what the record has seen, set-points within what nine of ten members hold by it; an episode is four
    settling times long, within 100 to 400 control steps; unless the options say otherwise.

    Args:
        name: of the plant.
        path: CSV or Parquet file, see `read`; time in s.
        options: what is known beside the record.

    Raises:
        ValueError: the record is not what it must be, or does not tell enough.
    """
    if (options.control_step, options.input, options.output) != (None, None, None):
        raise ValueError(
            "recorded data tell their control step, and have one r~ and one y: leave --control-step, --input and "
            "--output away"
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
