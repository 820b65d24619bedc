"""The learned controller as plain numbers, common to all exports, and its evaluation in NumPy. Imports no JAX."""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxouter.plants import Plant
    from jaxouter.training.policy import LearnedParams, LearnedPolicy

FORMAT = 2
BASE = ("base_y_past", "base_r_tilde_past")
ARRAYS = (*BASE, "weights", "biases")


class State(NamedTuple):
    """State of the controller between two control steps; float32."""

    y_past: np.ndarray  # (M,), y_(k-1), y_(k-2), ...
    r_tilde_past: np.ndarray  # (M,), r~_(k-1), r~_(k-2), ...
    integral: np.float32  # leaky integral of r - y


@dataclass(frozen=True, eq=False)
class ControllerSpec:
    """r~ = clip(base law + scale tanh(network(observation))).

    The base law is that of `jaxouter.loop.policy.LinearLaw`: base_offset + base_r r + base_y y + base_y_past (past y -
    y) + base_r_tilde_past (past r~), over the last n samples. The observation, (3 + 2H,), is that of
    `jaxouter.loop.observation.Observer`: [r - y_middle, r - y, integral, past y - y] / y_scale, and past r~ scaled to
    [-1, 1].
    """

    plant: str
    y_unit: str
    time_unit: str
    control_step: float
    """In `time_unit`."""
    r_tilde_bounds: tuple[float, float]
    setpoint_range: tuple[float, float]
    """Set-points in training."""
    y_range: tuple[float, float]
    """Range of y in training; episodes that left it were ended."""
    history: int
    """H, past samples of y and of r~ in the observation."""
    integral_steps: float
    """Time constant of the leaky integral, in control steps."""
    y_middle: float
    y_scale: float
    scale: float
    """Largest correction of the base law."""
    base_offset: float
    base_r: float
    base_y: float
    base_y_past: np.ndarray = field(repr=False)
    """(n,), float32."""
    base_r_tilde_past: np.ndarray = field(repr=False)
    """(n,), float32."""
    weights: tuple[np.ndarray, ...] = field(repr=False)
    """Of each layer, (n, m), float32."""
    biases: tuple[np.ndarray, ...] = field(repr=False)
    """Of each layer, (m,), float32."""

    def __post_init__(self) -> None:
        """Raises ValueError if the layers don't fit together."""
        widths = [3 + 2 * self.history, *(len(bias) for bias in self.biases)]
        wanted = list(pairwise(widths))
        shapes = [weight.shape for weight in self.weights]
        if shapes != wanted or widths[-1] != 1:
            raise ValueError(f"the layers have shapes {shapes}; with their biases they must be {wanted}, ending in 1")
        if self.base_y_past.shape != (self.lags,) or self.base_r_tilde_past.shape != (self.lags,):
            shapes = f"{self.base_y_past.shape} and {self.base_r_tilde_past.shape}"
            raise ValueError(f"the base law has shapes {shapes}; they must be equal, and of one dimension")

    @property
    def lags(self) -> int:
        """n, past samples in the base law."""
        return len(self.base_y_past)

    @property
    def remembered(self) -> int:
        """M, past samples in the state: those of the observation or of the base law, whichever are more."""
        return max(self.history, self.lags)

    @classmethod
    def of(cls, policy: LearnedPolicy, params: LearnedParams, plant: Plant) -> ControllerSpec:
        """The spec of a learned policy on a plant."""
        layers = params.actor["params"]
        names = sorted(layers, key=lambda name: int(name.rpartition("_")[2]))
        observer, base = policy.observer, params.base
        return cls(
            plant=plant.name,
            y_unit=plant.y_unit,
            time_unit=plant.time_unit,
            control_step=plant.control_step,
            r_tilde_bounds=observer.r_tilde_bounds,
            setpoint_range=plant.setpoint_range,
            y_range=plant.divergence_bounds,
            history=observer.history,
            integral_steps=observer.integral_steps,
            y_middle=observer.y_middle,
            y_scale=observer.y_scale,
            scale=policy.scale,
            base_offset=float(base.offset),
            base_r=float(base.r),
            base_y=float(base.y),
            base_y_past=np.asarray(base.y_past, np.float32),
            base_r_tilde_past=np.asarray(base.r_tilde_past, np.float32),
            weights=tuple(np.asarray(layers[name]["kernel"], np.float32) for name in names),
            biases=tuple(np.asarray(layers[name]["bias"], np.float32) for name in names),
        )

    def init(self, y0: float, r_tilde: float | None = None) -> State:
        """State before the first step: histories filled with y_0 and with r~ (None: y_0) clipped to its bounds."""
        before = self._clip(y0 if r_tilde is None else r_tilde)
        y_past, r_tilde_past = (np.full(self.remembered, value, np.float32) for value in (y0, before))
        return State(y_past, r_tilde_past, np.float32(0.0))

    def act(self, state: State, r: float, y: float) -> tuple[State, np.float32]:
        """At t_k: the next state, and r~_k."""
        state = self.observe(state, r, y)
        r_tilde = self.r_tilde(state, r, y)
        return self.record(state, y, r_tilde), r_tilde

    def observe(self, state: State, r: float, y: float) -> State:
        """At t_k: the state with r_k - y_k integrated."""
        error = np.float32(r) - np.float32(y)
        integral = state.integral + (error - state.integral) / np.float32(self.integral_steps)
        return State(state.y_past, state.r_tilde_past, integral)

    def r_tilde(self, state: State, r: float, y: float) -> np.float32:
        """r~_k, from a state in which r_k - y_k is already integrated."""
        action = self._action(self._observation(state, np.float32(r), np.float32(y)))
        return np.float32(self._clip(self._base(state, np.float32(r), np.float32(y)) + self.scale * action))

    def record(self, state: State, y: float, r_tilde: float | np.float32) -> State:
        """After r~_k is chosen: y_k and r~_k enter the past."""
        return State(_pushed(state.y_past, y), _pushed(state.r_tilde_past, r_tilde), state.integral)

    def _base(self, state: State, r: np.float32, y: np.float32) -> float:
        r_tilde = self.base_offset + self.base_r * float(r)
        if not self.lags:
            return r_tilde
        past = self.base_y_past.dot(state.y_past[: self.lags] - y)
        past += self.base_r_tilde_past.dot(state.r_tilde_past[: self.lags])
        return r_tilde + self.base_y * float(y) + float(past)

    def _observation(self, state: State, r: np.float32, y: np.float32) -> np.ndarray:
        low, high = self.r_tilde_bounds
        x = np.empty(3 + 2 * self.history, np.float32)
        of_y, of_r_tilde = x[: 3 + self.history], x[3 + self.history :]
        of_y[:3] = r - self.y_middle, r - y, state.integral
        np.subtract(state.y_past[: self.history], y, out=of_y[3:])
        of_y /= self.y_scale
        np.subtract(state.r_tilde_past[: self.history], (low + high) / 2, out=of_r_tilde)
        of_r_tilde /= (high - low) / 2
        return x

    def _action(self, x: np.ndarray) -> float:
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = x.dot(weight)  # less overhead than @, which matters at these sizes
            x += bias
            np.maximum(x, 0.0, out=x)
        return math.tanh(x.dot(self.weights[-1])[0] + self.biases[-1][0])

    def _clip(self, r_tilde: float) -> float:
        low, high = self.r_tilde_bounds
        return min(max(r_tilde, low), high)

    def save(self, path: Path) -> None:
        """Write an npz file: `header`, JSON of all but the arrays, `base_*`, and `weight_i`, `bias_i` of each layer."""
        header = {name: value for name, value in asdict(self).items() if name not in ARRAYS}
        arrays: dict[str, Any] = {name: getattr(self, name) for name in BASE}
        arrays |= {f"weight_{i}": weight for i, weight in enumerate(self.weights)}
        arrays |= {f"bias_{i}": bias for i, bias in enumerate(self.biases)}
        with path.open("wb") as file:
            np.savez(file, allow_pickle=False, header=np.asarray(json.dumps({"format": FORMAT} | header)), **arrays)

    @classmethod
    def load(cls, path: Path) -> ControllerSpec:
        """Read a file that `save` wrote.

        Raises:
            ValueError: it is not such a file, or is damaged.
        """
        try:
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                header: dict[str, Any] = json.loads(str(file["header"]))
                layers = range(sum(name.startswith("weight_") for name in file.files))
                weights, biases = (tuple(file[f"{name}_{i}"] for i in layers) for name in ("weight", "bias"))
                base = {name: file[name] for name in BASE if name in file.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is not a controller exported as npz: {error}") from None
        if header.pop("format", None) != FORMAT:
            raise ValueError(f"{path} is not of format {FORMAT}, the one that this version reads")
        names = {f.name for f in fields(cls)} - {"weights", "biases"}
        if set(header | base) != names:
            raise ValueError(f"{path} is damaged: it has missing or extra fields {sorted(set(header | base) ^ names)}")
        header = {name: tuple(value) if isinstance(value, list) else value for name, value in header.items()}
        return cls(**header, **base, weights=weights, biases=biases)


def _pushed(past: np.ndarray, value: float | np.float32) -> np.ndarray:
    out = np.empty_like(past)
    out[0] = value
    out[1:] = past[:-1]
    return out
