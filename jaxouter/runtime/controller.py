"""The learned controller in a real control loop. NumPy only; imports no JAX."""

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
    """A switch between control and pass-through."""

    step: int
    time: float | None
    what: Literal["control", "pass through"]
    why: Reason | None  # None: it controls


class Row(NamedTuple):
    """One control step: r and y as measured, and the r~ applied."""

    step: int
    time: float | None
    r: float | None
    y: float | None
    r_tilde: float
    reason: Reason | None


@dataclass
class Watch:
    """Checks the samples: finds reasons against control, and substitutes the last valid ones for invalid ones."""

    r: float
    """Last finite r; at first the given one."""
    y: float
    """Last finite y; at first the given one."""
    y_range: tuple[float, float]
    control_step: float
    late_after: float
    return_after: int
    time: float | None = None
    elapsed: float | None = None
    """Control steps since the previous sample; None: unknown."""

    def __post_init__(self) -> None:
        """Raises ValueError if a setting is wrong; names the setting, its value and what is allowed."""
        _check_range("y_range", self.y_range)
        if not self.late_after > 1:
            raise ValueError(f"late_after is {self.late_after}; it must be more than 1 control step")
        _check_at_least_1("return_after", self.return_after)
        self._good = self.return_after  # good samples in a row

    def judge(self, r: float | None, y: float | None, time: float | None) -> Reason | None:
        """The reason against control at this sample; None: there is none."""
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
        """R and y for the spec: the last finite ones, clipped to `y_range`."""
        return _clip(self.r, self.y_range), _clip(self.y, self.y_range)


@dataclass
class Transfer:
    """From the wanted r~ to the applied one: bounds, rate limit, bumpless transfer."""

    r_tilde: float | None
    """Last applied r~; None: unknown."""
    bounds: tuple[float, float]
    rate_limit: float
    steps: int
    controls: bool | None = None
    """Whether the last wanted r~ was the spec's (True) or r (False); None: nothing yet."""

    def __post_init__(self) -> None:
        """Raises ValueError if a setting is wrong; names the setting, its value and what is allowed."""
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
    """Runs a spec in a control loop: call `step(r, y)` once per control step, and hold its r~ until the next call.

        controller = Controller.load("controller.npz", engaged=False)
        r_tilde = controller.step(r, y)

    It either controls or passes r through (r~ = r); `reason` then says why:

    - `disengaged`: by `disengage`, or not engaged yet.
    - `missing`: r or y is None.
    - `not finite`: r, y or the time is NaN or infinite.
    - `late`: more than `late_after` control steps since the previous sample. Needs a time.
    - `out of range`: r or y is outside `y_range`.
    - `returning`: the samples are good again, but fewer than `return_after` in a row so far.

    If several hold, the first in this list is reported. If r is not finite, the last finite one passes through.

    r~ stays within `bounds` and moves by at most `rate_limit` per control step. At a switch, in either direction, the
    difference between the last applied r~ and the wanted one fades out over `transfer_steps` equal steps.

    The spec's memory is always updated, with the r~ that was applied. Samples that are not finite or were skipped are
    replaced by the last ones; values outside `y_range` are clipped to it.

    Not thread-safe: use it from one thread.
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
        """A controller before its first step.

        Args:
            spec: the control law.
            engaged: whether it controls from the first step, or only after `engage`.
            r_tilde: the plant's current r~, also after a restart; the first step then transfers from it without a bump.
                None: unknown, the first r~ is applied at once.
            bounds: of r~, within the spec's; None: the spec's.
            rate_limit: largest move of r~ per control step, in the spec's `y_unit`.
            transfer_steps: control steps in which the difference at a switch fades out; 1: at once.
            y_range: valid range of r and y; None: the range of y in training.
            late_after: a sample is late if more control steps than this have passed since the previous one.
            return_after: good samples in a row after which control returns; 1: at the first.
            clock: gives the time if `step` gets none, in the spec's `time_unit`: `time.monotonic` if that is s.
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
        """Load a file that `python -m jaxouter.export --format npz` wrote.

        Args:
            path: the file.
            **settings: of the controller.

        Raises:
            ValueError: it is not such a file, or a setting is wrong.
        """
        return cls(ControllerSpec.load(Path(path)), **settings)

    def engage(self) -> None:
        """Control from the next step on, unless there is a reason against it."""
        self._engaged = True

    def disengage(self) -> None:
        """Pass through from the next step on."""
        self._engaged = False

    @property
    def engaged(self) -> bool:
        """Whether it is set to control."""
        return self._engaged

    @property
    def reason(self) -> Reason | None:
        """Why the last step passed r through; None: it controlled."""
        return self._reason

    @property
    def counts(self) -> dict[Reason, int]:
        """Number of steps that passed r through, by reason."""
        return dict(self._counts)

    @property
    def log(self) -> list[Event]:
        """The last switches, oldest first."""
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
        """Update the memory for skipped steps, with the sample before them."""
        elapsed = self._watch.elapsed
        if elapsed is None or elapsed < 1.5 or self._transfer.r_tilde is None:
            return
        for _ in range(round(min(elapsed, self.spec.remembered + 1)) - 1):
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
