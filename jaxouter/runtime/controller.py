"""The learned controller in a real control loop. NumPy alone; imports no JAX."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeGuard, get_args

import numpy as np

from jaxouter.exports.spec import ControllerSpec

Reason = Literal["disengaged", "missing", "not finite", "late", "out of range", "returning"]
REASONS: tuple[Reason, ...] = get_args(Reason)


class Event(NamedTuple):
    """A change of what the controller does."""

    step: int
    time: float | None
    what: Literal["control", "pass through"]
    why: Reason | None  # None: nothing stands against control


class Row(NamedTuple):
    """A control step, as it came and as it was answered."""

    step: int
    time: float | None
    r: float | None
    y: float | None
    r_tilde: float
    reason: Reason | None


@dataclass
class Watch:
    """Looks at the samples: what speaks against control, and what stands in for those that are no numbers."""

    r: float
    """Last one that is a number; at first what was given."""
    y: float
    """The same."""
    y_range: tuple[float, float]
    control_step: float
    late_after: float
    return_after: int
    time: float | None = None
    elapsed: float | None = None
    """Control steps since the sample before; None: unknown."""

    def __post_init__(self) -> None:
        """Raises ValueError, naming setting, value and what is allowed."""
        _check_range("y_range", self.y_range)
        if not self.late_after > 1:
            raise ValueError(f"late_after is {self.late_after}; it must be more than 1 control step")
        _check_at_least_1("return_after", self.return_after)
        self._good = self.return_after  # samples in a row

    def judge(self, r: float | None, y: float | None, time: float | None) -> Reason | None:
        """What speaks against control at this sample; None: nothing."""
        self.elapsed = None
        if _is_number(time) and self.time is not None:
            self.elapsed = (time - self.time) / self.control_step
        self.time = time if _is_number(time) else None
        fault = self._fault(r, y, time)
        self.r = float(r) if _is_number(r) else self.r
        self.y = float(y) if _is_number(y) else self.y
        self._good = 0 if fault else min(self._good + 1, self.return_after)
        return fault or ("returning" if self._good < self.return_after else None)

    def _fault(self, r: float | None, y: float | None, time: float | None) -> Reason | None:
        low, high = self.y_range
        if r is None or y is None:
            return "missing"
        if not (math.isfinite(r) and math.isfinite(y) and (time is None or math.isfinite(time))):
            return "not finite"
        if self.elapsed is not None and self.elapsed > self.late_after:
            return "late"
        if not (low <= r <= high and low <= y <= high):
            return "out of range"
        return None

    def within(self) -> tuple[float, float]:
        """R and y for the spec: the last that are numbers, clipped to where it knows y."""
        return _clip(self.r, self.y_range), _clip(self.y, self.y_range)


@dataclass
class Transfer:
    """From the r~ that is wanted to the one that is applied: within bounds, of limited rate, without bumps."""

    r_tilde: float | None
    """Last applied; None: unknown."""
    bounds: tuple[float, float]
    rate_limit: float
    steps: int
    controls: bool | None = None
    """What was wanted last: the spec's r~, or r; None: nothing yet."""

    def __post_init__(self) -> None:
        """Raises ValueError, naming setting, value and what is allowed."""
        low, high = self.bounds
        _check_range("bounds", self.bounds)
        if self.r_tilde is not None and not low <= self.r_tilde <= high:
            raise ValueError(f"r_tilde is {self.r_tilde}; it must lie within the bounds, {low:g} to {high:g}")
        if not self.rate_limit > 0:
            raise ValueError(f"rate_limit is {self.rate_limit}; it must be positive")
        _check_at_least_1("transfer_steps", self.steps)
        self._difference, self._left = 0.0, 0

    def apply(self, wanted: float, controls: bool) -> float:
        """The next r~."""
        before, wanted = self.r_tilde, _clip(wanted, self.bounds)
        if controls is not self.controls and before is not None:
            self._difference, self._left = before - wanted, self.steps
        if self._left:
            self._left -= 1
            wanted = _clip(wanted + self._difference * self._left / self.steps, self.bounds)
        if before is not None:
            wanted = _clip(wanted, (before - self.rate_limit, before + self.rate_limit))
        self.r_tilde, self.controls = wanted, controls
        return wanted


class Controller:
    """The spec in a control loop: `step(r, y)` once a control step gives the r~ to apply until the next one.

        controller = Controller.load("controller.npz", engaged=False)
        r_tilde = controller.step(r, y)

    It controls, or it passes through, which is r~ = r; then `reason` says why:

    - `disengaged`: by `disengage`, or not yet engaged.
    - `missing`: r or y is None.
    - `not finite`: r, y or the time is NaN or infinite.
    - `late`: more than `late_after` control steps since the sample before. Needs a time.
    - `out of range`: r or y lies outside `y_range`.
    - `returning`: the samples are good again, but not yet `return_after` of them in a row.

    Where several hold, the first of these stands. In place of an r that is no number the last one passes.

    r~ stays within `bounds`, and moves by at most `rate_limit` a control step. At a switch, either way, the difference
    between the r~ last applied and the one now wanted fades out in `transfer_steps` equal parts, so that of the moves
    of r~ no more than one part is due to the switch.

    What the spec remembers goes on all the time, with the r~ that was applied. For samples that are no numbers, or were
    skipped, the last ones stand in; what lies outside `y_range` is clipped to it.

    Not thread-safe: call it from one thread.
    """

    def __init__(
        self,
        spec: ControllerSpec,
        *,
        engaged: bool = True,
        r_tilde: float | None = None,
        bounds: tuple[float, float] | None = None,
        rate_limit: float = math.inf,
        transfer_steps: int = 10,
        y_range: tuple[float, float] | None = None,
        late_after: float = 1.5,
        return_after: int = 3,
        clock: Callable[[], float] | None = None,
        record: Callable[[Row], Any] | None = None,
        log_length: int = 1000,
    ) -> None:
        """Before the first step.

        Args:
            spec: what to do.
            engaged: whether it controls from the first step, or only after `engage`.
            r_tilde: the r~ that the plant has now, also after a restart, from which the first step moves on without a
                bump; None: unknown, and the first r~ is the one wanted.
            bounds: of r~, within those of the spec; None: those.
            rate_limit: largest move of r~ a control step, in the spec's `y_unit`.
            transfer_steps: control steps in which a difference fades out; 1: at once.
            y_range: where r and y may be; None: where y was in training.
            late_after: control steps from sample to sample after which one is late.
            return_after: good samples in a row with which control returns; 1: with the first.
            clock: gives the time where `step` is given none, in the spec's `time_unit`: `time.monotonic` if that is s.
            record: called with the `Row` of each step, such as `csv.writer(file).writerow`.
            log_length: events that `log` keeps.

        Raises:
            ValueError: names the setting, its value and what is allowed.
        """
        if not all(np.isfinite(array).all() for array in (*spec.weights, *spec.biases)):
            raise ValueError("the layers of the spec hold numbers that are not finite; export it again")
        least, greatest = spec.r_tilde_bounds
        if bounds is not None and not least <= min(bounds) <= max(bounds) <= greatest:
            raise ValueError(f"bounds is {bounds}; they must lie within those of the spec, {least:g} to {greatest:g}")
        if log_length < 0:
            raise ValueError(f"log_length is {log_length}; it must not be negative")
        bounds = spec.r_tilde_bounds if bounds is None else bounds
        y_range = spec.y_range if y_range is None else y_range
        before = sum(spec.setpoint_range) / 2 if r_tilde is None else r_tilde
        self.spec, self._engaged = spec, engaged
        self._watch = Watch(before, before, y_range, spec.control_step, late_after, return_after)
        self._transfer = Transfer(r_tilde, bounds, rate_limit, transfer_steps)
        self._clock, self._record = clock, record
        self._memory, self._met = spec.init(before, r_tilde), False
        self._steps = 0
        self._reason: Reason | None = None
        self._counts = dict.fromkeys(REASONS, 0)
        self._log: deque[Event] = deque(maxlen=log_length)

    @classmethod
    def load(cls, path: Path | str, **settings: Any) -> Controller:
        """The controller in a file that `python -m jaxouter.export --format npz` wrote.

        Args:
            path: the file.
            **settings: of the controller.

        Raises:
            ValueError: it is no such file, or a setting does not fit.
        """
        return cls(ControllerSpec.load(Path(path)), **settings)

    def engage(self) -> None:
        """Control from the next step on, where nothing speaks against it."""
        self._engaged = True

    def disengage(self) -> None:
        """Pass through from the next step on."""
        self._engaged = False

    @property
    def engaged(self) -> bool:
        """Whether it is to control where nothing speaks against it."""
        return self._engaged

    @property
    def reason(self) -> Reason | None:
        """Why the last step passed through; None: it controlled."""
        return self._reason

    @property
    def counts(self) -> dict[Reason, int]:
        """How many steps passed through, by reason."""
        return dict(self._counts)

    @property
    def log(self) -> list[Event]:
        """The last changes, oldest first."""
        return list(self._log)

    def step(self, r: float | None, y: float | None, time: float | None = None) -> float:
        """One control step.

        Args:
            r, y: samples, in the spec's `y_unit`; None: missing.
            time: of the samples, in the spec's `time_unit`; None: that of the clock, if there is one.

        Returns:
            r~ to apply until the next step.
        """
        if time is None and self._clock is not None:
            time = self._clock()
        r_before, y_before = self._watch.within()
        fault = self._watch.judge(r, y, time)
        reason: Reason | None = fault if self._engaged else "disengaged"
        self._catch_up(r_before, y_before)
        r_k, y_k = self._watch.within()
        if not self._met and _is_number(y):
            self._memory, self._met = self.spec.init(y_k, self._transfer.r_tilde), True
        self._memory = self.spec.observe(self._memory, r_k, y_k)
        wanted = self._watch.r if reason else float(self.spec.r_tilde(self._memory, r_k, y_k))
        r_tilde = self._transfer.apply(wanted, reason is None)
        self._memory = self.spec.record(self._memory, y_k, r_tilde)
        self._note(Row(self._steps, time, r, y, r_tilde, reason))
        return r_tilde

    def _catch_up(self, r: float, y: float) -> None:
        """The steps that were skipped since the sample before, with that sample."""
        elapsed = self._watch.elapsed
        if elapsed is None or elapsed < 1.5 or self._transfer.r_tilde is None:
            return
        for _ in range(round(min(elapsed, self.spec.history + 1)) - 1):
            self._memory = self.spec.observe(self._memory, r, y)
            self._memory = self.spec.record(self._memory, y, self._transfer.r_tilde)

    def _note(self, row: Row) -> None:
        if row.reason is not None:
            self._counts[row.reason] += 1
        if row.step == 0 or row.reason != self._reason:
            what = "control" if row.reason is None else "pass through"
            self._log.append(Event(row.step, row.time, what, row.reason))
        self._steps, self._reason = row.step + 1, row.reason
        if self._record is not None:
            self._record(row)


def _is_number(value: float | None) -> TypeGuard[float]:
    return value is not None and math.isfinite(value)


def _clip(value: float, bounds: tuple[float, float]) -> float:
    return min(max(value, bounds[0]), bounds[1])


def _check_range(name: str, bounds: tuple[float, float]) -> None:
    low, high = bounds
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"{name} is {bounds}; it must be two numbers, the first below the second")


def _check_at_least_1(name: str, value: int) -> None:
    if value < 1 or value % 1 != 0:
        raise ValueError(f"{name} is {value}; it must be a whole number, at least 1")
