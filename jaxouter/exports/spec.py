"""The learned controller as plain numbers, common to all exports, and its evaluation in NumPy. Imports no JAX."""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxouter.plants import Plant
    from jaxouter.training.policy import LearnedParams, LearnedPolicy

FORMAT = 3
LAWS = ("base_offset", "base_r", "base_y", "base_y_past", "base_r_tilde_past", "model_y", "model_r_tilde")
ARRAYS = (*LAWS, "weights", "biases")


class Evidence(NamedTuple):
    """What a controller with several laws has seen of them; see `jaxouter.loop.bank`."""

    mean_error: np.ndarray  # (L,), float32
    performance: np.ndarray  # (L,), float32
    active: np.int32  # -1: none yet


class State(NamedTuple):
    """State of the controller between two control steps; float32."""

    y_past: np.ndarray  # (M,), y_(k-1), y_(k-2), ...
    r_tilde_past: np.ndarray  # (M,), r~_(k-1), r~_(k-2), ...
    integral: np.float32  # leaky integral of r - y
    evidence: Evidence | tuple[()] = ()  # (): there is one law

    @classmethod
    def of(cls, y_past: Any, r_tilde_past: Any, integral: Any, *evidence: Any) -> State:
        """The state from its numbers, as `numbers` returns them."""
        return cls(y_past, r_tilde_past, integral, Evidence(*evidence) if evidence else ())

    @property
    def numbers(self) -> dict[str, Any]:
        """Its numbers by name."""
        own = self._asdict()
        evidence = own.pop("evidence")
        return own | (evidence._asdict() if evidence else {})


@dataclass(frozen=True, eq=False)
class ControllerSpec:
    """r~ = clip(base law + scale tanh(network(observation))).

    The base law is that of `jaxouter.loop.policy.LinearLaw`: base_offset + base_r r + base_y y + base_y_past (past y -
    y) + base_r_tilde_past (past r~), over the last n samples. The observation is that of
    `jaxouter.loop.observation.Observer`: [r - y_middle, r - y, integral, past y - y] / y_scale, past r~ scaled to
    [-1, 1], and, of several laws, 1 for the one that acts and 0 for the others.

    Which of L laws acts is decided as in `jaxouter.loop.bank`, by models y_k = model_y (past y) + model_r_tilde (past
    r~). With one law there are no models.
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
    forgetting: float
    """Factor per control step on squared errors of the models in the past."""
    mean_rate: float
    """Rate of the running mean of their errors."""
    hysteresis: float
    """Factor by which the performance index of another law must be lower than that of the active one."""
    floor: float
    """Added to each performance index before they are compared."""
    base_offset: np.ndarray = field(repr=False)
    """(L,), float32."""
    base_r: np.ndarray = field(repr=False)
    """(L,), float32."""
    base_y: np.ndarray = field(repr=False)
    """(L,), float32."""
    base_y_past: np.ndarray = field(repr=False)
    """(L, n), float32."""
    base_r_tilde_past: np.ndarray = field(repr=False)
    """(L, n), float32."""
    model_y: np.ndarray = field(repr=False)
    """(L, m), float32; m is 0 with one law."""
    model_r_tilde: np.ndarray = field(repr=False)
    """(L, m), float32."""
    weights: tuple[np.ndarray, ...] = field(repr=False)
    """Of each layer, (n, m), float32."""
    biases: tuple[np.ndarray, ...] = field(repr=False)
    """Of each layer, (m,), float32."""

    def __post_init__(self) -> None:
        """Raises ValueError if the layers don't fit together."""
        wanted = list(pairwise(self.widths))
        shapes = [weight.shape for weight in self.weights]
        if shapes != wanted or self.widths[-1] != 1:
            raise ValueError(f"the layers have shapes {shapes}; with their biases they must be {wanted}, ending in 1")
        each, past, model = ((self.laws, *rest) for rest in ((), (self.lags,), (self.model_lags,)))
        of_laws = dict(zip(LAWS, (each, each, each, past, past, model, model), strict=True))
        for name, shape in of_laws.items():
            if (found := getattr(self, name).shape) != shape:
                raise ValueError(f"{name} has shape {found}; beside the rest of the base law it must be {shape}")

    @property
    def laws(self) -> int:
        """L, base laws."""
        return len(self.base_y_past)

    @property
    def lags(self) -> int:
        """n, past samples in a base law."""
        return self.base_y_past.shape[1]

    @property
    def model_lags(self) -> int:
        """m, past samples in a model."""
        return self.model_y.shape[1]

    @property
    def widths(self) -> list[int]:
        """Widths of the network's layers; the first is that of the observation."""
        which = self.laws if self.laws > 1 else 0
        return [3 + 2 * self.history + which, *(len(bias) for bias in self.biases)]

    @property
    def remembered(self) -> int:
        """M, past samples in the state: those of the observation, of a base law or of a model, whichever are most."""
        return max(self.history, self.lags, self.model_lags)

    @cached_property
    def error_weight(self) -> np.ndarray:
        """Factor on the squared error of each model, (L,): a model of large coefficients passes on more noise."""
        return 1.0 / (1.0 + np.sum(self.model_y**2, 1))

    @classmethod
    def of(cls, policy: LearnedPolicy, params: LearnedParams, plant: Plant) -> ControllerSpec:
        """The spec of a learned policy on a plant."""
        from jaxouter.loop import bank  # which imports JAX

        layers = params.actor["params"]
        names = sorted(layers, key=lambda name: int(name.rpartition("_")[2]))
        observer = policy.observer
        if isinstance(params.base, bank.Bank):
            laws, *models, floor = params.base
        else:
            laws, models, floor = [np.asarray(each)[None] for each in params.base], np.zeros((2, 1, 0)), 0.0
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
            forgetting=bank.FORGETTING,
            mean_rate=bank.RATE,
            hysteresis=bank.HYSTERESIS,
            floor=float(floor),
            **{name: np.asarray(each, np.float32) for name, each in zip(LAWS, (*laws, *models), strict=True)},
            weights=tuple(np.asarray(layers[name]["kernel"], np.float32) for name in names),
            biases=tuple(np.asarray(layers[name]["bias"], np.float32) for name in names),
        )

    def init(self, y0: float, r_tilde: float | None = None) -> State:
        """State before the first step: histories filled with y_0 and with r~ (None: y_0) clipped to its bounds."""
        before = self._clip(y0 if r_tilde is None else r_tilde)
        y_past, r_tilde_past = (np.full(self.remembered, value, np.float32) for value in (y0, before))
        nothing = np.zeros(self.laws, np.float32)
        return State(
            y_past, r_tilde_past, np.float32(0.0), Evidence(nothing, nothing, np.int32(-1)) if self.laws > 1 else ()
        )

    def act(self, state: State, r: float, y: float) -> tuple[State, np.float32]:
        """At t_k: the next state, and r~_k."""
        state = self.observe(state, r, y)
        r_tilde = self.r_tilde(state, r, y)
        return self.record(state, y, r_tilde), r_tilde

    def observe(self, state: State, r: float, y: float) -> State:
        """At t_k: the state with r_k - y_k integrated, and the law chosen by what y_k says."""
        error = np.float32(r) - np.float32(y)
        integral = state.integral + (error - state.integral) / np.float32(self.integral_steps)
        return state._replace(integral=integral, evidence=self._judge(state, np.float32(y)))

    def r_tilde(self, state: State, r: float, y: float) -> np.float32:
        """r~_k, from a state in which r_k - y_k is already integrated."""
        action = self._action(self._observation(state, np.float32(r), np.float32(y)))
        return np.float32(self._clip(self._base(state, np.float32(r), np.float32(y)) + self.scale * action))

    def record(self, state: State, y: float, r_tilde: float | np.float32) -> State:
        """After r~_k is chosen: y_k and r~_k enter the past."""
        return state._replace(y_past=_pushed(state.y_past, y), r_tilde_past=_pushed(state.r_tilde_past, r_tilde))

    def _judge(self, state: State, y: np.float32) -> Evidence | tuple[()]:
        if not state.evidence:
            return ()
        mean, performance, active = state.evidence
        error = y - self.model_y.dot(state.y_past[: self.model_lags])
        error -= self.model_r_tilde.dot(state.r_tilde_past[: self.model_lags])
        mean, active = (error, np.int32(0)) if active < 0 else (mean, active)
        error = error - mean
        performance = np.float32(self.forgetting) * performance + self.error_weight * error**2
        best = np.int32(performance.argmin())
        if self.hysteresis * (performance[best] + self.floor) < performance[active] + self.floor:
            active = best
        return Evidence(mean + np.float32(self.mean_rate) * error, performance, active)

    def _base(self, state: State, r: np.float32, y: np.float32) -> float:
        law = state.evidence.active if state.evidence else 0
        r_tilde = float(self.base_offset[law]) + float(self.base_r[law]) * float(r)
        if not self.lags:
            return r_tilde
        past = self.base_y_past[law].dot(state.y_past[: self.lags] - y)
        past += self.base_r_tilde_past[law].dot(state.r_tilde_past[: self.lags])
        return r_tilde + float(self.base_y[law]) * float(y) + float(past)

    def _observation(self, state: State, r: np.float32, y: np.float32) -> np.ndarray:
        low, high = self.r_tilde_bounds
        x = np.zeros(self.widths[0], np.float32)
        of_y, of_r_tilde = x[: 3 + self.history], x[3 + self.history : 3 + 2 * self.history]
        of_y[:3] = r - self.y_middle, r - y, state.integral
        np.subtract(state.y_past[: self.history], y, out=of_y[3:])
        of_y /= self.y_scale
        np.subtract(state.r_tilde_past[: self.history], (low + high) / 2, out=of_r_tilde)
        of_r_tilde /= (high - low) / 2
        if state.evidence:
            x[3 + 2 * self.history + state.evidence.active] = 1.0
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
        """Write an npz file.

        It holds `header`, JSON of all but the arrays; `base_*` and `model_*`; `weight_i` and `bias_i` of each layer.
        """
        header = {name: value for name, value in asdict(self).items() if name not in ARRAYS}
        arrays: dict[str, Any] = {name: getattr(self, name) for name in LAWS}
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
                base = {name: file[name] for name in LAWS if name in file.files}
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
