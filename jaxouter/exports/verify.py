"""Verify an exported controller: run the written file next to the policy, and compare their r~."""

from __future__ import annotations

import ctypes
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from jaxouter.exports import c
from jaxouter.exports.spec import ControllerSpec, State
from jaxouter.training.policy import LearnedParams, LearnedPolicy

STEPS = 1_000
AT_A_STEP = 1e-5  # tolerance as share of the range of r~, if both start each step in the policy's state
IN_CLOSED_LOOP = 1e-4  # likewise, if each carries its own state for a while
HELD = 20  # control steps for which a set-point is held
ALONE = 50  # control steps for which a controller carries its own state; y does not answer, so deviations may grow


class Controller(Protocol):
    """An opened file. It takes its own states and those of `ControllerSpec`."""

    def init(self, y0: float) -> Any:
        """State before the first step."""
        ...

    def act(self, state: Any, r: float, y: float) -> tuple[Any, Any]:
        """One control step: the next state and r~."""
        ...


class Signals(NamedTuple):
    """Inputs, states and outputs of the policy; the leading axis is T steps."""

    r: np.ndarray
    y: np.ndarray
    state: State  # before the step
    r_tilde: np.ndarray


class Deviation(NamedTuple):
    """The largest deviation over all steps, as share of the range of r~."""

    at_a_step: float
    in_closed_loop: float

    @property
    def small(self) -> bool:
        """Whether both are within tolerance; NaN is not."""
        return self.at_a_step <= AT_A_STEP and self.in_closed_loop <= IN_CLOSED_LOOP


def verify(kind: str, path: Path, spec: ControllerSpec, policy: LearnedPolicy, params: LearnedParams) -> Deviation:
    """Deviation of an exported file's r~ from the policy's.

    Raises:
        ImportError: the package that runs this kind of file is not installed.
        FileNotFoundError: the export is C, and there is no C compiler to run it.
    """
    with opened(kind, path, spec) as controller:
        return deviation(controller, spec, signals(spec, policy, params))


def signals(spec: ControllerSpec, policy: LearnedPolicy, params: LearnedParams, steps: int = STEPS) -> Signals:
    """Run the policy on random set-points and on a y that follows them with a lag and noise."""
    rng = np.random.default_rng(0)
    low, high = spec.setpoint_range
    r = np.repeat(rng.uniform(low, high, -(-steps // HELD)), HELD)[:steps]
    y, now = np.empty(steps), rng.uniform(low, high)
    for k, noise in enumerate(rng.normal(0.0, (high - low) / 5, steps)):
        y[k] = now = np.clip(now + 0.2 * (r[k] + noise - now), *spec.y_range)
    r, y = r.astype(np.float32), y.astype(np.float32)
    with jax.default_matmul_precision("highest"):
        memory, r_tilde = jax.device_get(_record(policy, params, jnp.asarray(r, float), jnp.asarray(y, float)))
    *past, evidence = jax.tree.map(_single, tuple(memory))
    return Signals(r, y, State.of(*past, *evidence), r_tilde)


def _single(leaf: Any) -> Any:
    """The leaf in single precision; whole numbers as they are."""
    return np.asarray(leaf, np.float32 if np.issubdtype(np.asarray(leaf).dtype, np.floating) else np.int32)


@partial(jax.jit, static_argnums=0)
def _record(policy: LearnedPolicy, params: LearnedParams, r: jax.Array, y: jax.Array) -> tuple[Any, jax.Array]:
    def step(memory: Any, seen: tuple[jax.Array, jax.Array]) -> tuple[Any, Any]:
        after, r_tilde = policy.act(params, memory, *seen)
        return after, (memory, r_tilde)

    return jax.lax.scan(step, policy.init(params, r[0], y[0]), (r, y))[1]


def deviation(controller: Controller, spec: ControllerSpec, seen: Signals) -> Deviation:
    """Deviation of a controller from the policy: in the policy's state at each step, and with its own for 50 steps."""
    state, got = controller.init(seen.y[0]), []
    for k, (r, y) in enumerate(zip(seen.r, seen.y, strict=True)):
        of_policy = jax.tree.map(lambda leaf, k=k: leaf[k], seen.state)
        _, at_a_step = controller.act(of_policy, r, y)
        state = of_policy if k and k % ALONE == 0 else state
        state, in_closed_loop = controller.act(state, r, y)
        got.append((float(at_a_step), float(in_closed_loop)))
    low, high = spec.r_tilde_bounds
    away = np.abs(np.asarray(got) - np.asarray(seen.r_tilde, float)[:, None]).max(0) / (high - low)
    return Deviation(*map(float, away))


@contextmanager
def opened(kind: str, path: Path, spec: ControllerSpec) -> Iterator[Controller]:
    """The controller in a file of this kind.

    Raises:
        ImportError: the package that runs it is not installed.
        FileNotFoundError: the export is C, and there is no C compiler to run it.
    """
    with tempfile.TemporaryDirectory() as place:
        match kind:
            case "npz":
                yield ControllerSpec.load(path)
            case "onnx":
                yield OnnxController(path, spec)
            case "stablehlo":
                yield StablehloController(path, spec)
            case "c":
                library = Path(place) / "controller.so"
                c.shared_library([path], library)
                yield CController(library, spec)
            case "fmu":
                with FmuController(path, Path(place) / "fmu", spec) as controller:
                    yield controller
            case _:
                raise ValueError(f"there is no format {kind!r}")


class OnnxController:
    """Run by ONNX Runtime."""

    def __init__(self, path: Path, spec: ControllerSpec) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise ImportError("what runs it is not installed: pip install onnxruntime") from None

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.init = spec.init  # as the metadata says
        self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def act(self, state: State, r: float, y: float) -> tuple[State, float]:
        """One control step."""
        inputs = state.numbers | {"r": np.float32(r), "y": np.float32(y)}
        outputs: Any = self._session.run(None, {name: np.asarray(x) for name, x in inputs.items()})
        return State.of(*outputs[1:]), outputs[0]


class StablehloController:
    """Run by JAX."""

    def __init__(self, path: Path, spec: ControllerSpec) -> None:
        self.init = spec.init  # as the module says
        self._act = jax.jit(export.deserialize(bytearray(path.read_bytes())).call)

    def act(self, state: State, r: float, y: float) -> tuple[State, float]:
        """One control step."""
        r_tilde, *after = jax.device_get(self._act(np.float32(r), np.float32(y), *state.numbers.values()))
        return State.of(*after), r_tilde


def _struct(spec: ControllerSpec) -> type[ctypes.Structure]:
    """The state of the C code."""
    past, each = ctypes.c_float * spec.remembered, ctypes.c_float * spec.laws
    evidence = [("mean_error", each), ("performance", each), ("active", ctypes.c_int)] if spec.laws > 1 else []

    class Struct(ctypes.Structure):
        _fields_ = [("y_past", past), ("r_tilde_past", past), ("integral", ctypes.c_float), *evidence]

    return Struct


def _fill(struct: Any, state: State) -> None:
    for name, value in state.numbers.items():
        if np.ndim(value):
            getattr(struct, name)[:] = value.tolist()
        else:
            setattr(struct, name, value.item())


class CController:
    """The C code as a library, called through its C interface."""

    def __init__(self, library: Path, spec: ControllerSpec) -> None:
        loaded, name = ctypes.CDLL(str(library)), c.prefix(spec)
        self._struct = _struct(spec)
        pointer = ctypes.POINTER(self._struct)
        self._init, self._step = getattr(loaded, f"{name}_init"), getattr(loaded, f"{name}_step")
        self._init.argtypes, self._init.restype = [pointer, ctypes.c_float], None
        self._step.argtypes, self._step.restype = [pointer, ctypes.c_float, ctypes.c_float], ctypes.c_float

    def init(self, y0: float) -> Any:
        """State before the first step."""
        struct = self._struct()
        self._init(struct, y0)
        return struct

    def act(self, state: Any, r: float, y: float) -> tuple[Any, float]:
        """One control step; the given state is not changed."""
        struct = self._struct()
        if isinstance(state, State):
            _fill(struct, state)
        else:
            ctypes.pointer(struct)[0] = state
        return struct, self._step(struct, r, y)


class FmuController:
    """An FMU run by FMPy, stepped like by an importer; states are the FMU's serialised states."""

    def __init__(self, path: Path, place: Path, spec: ControllerSpec) -> None:
        try:
            import fmpy
            from fmpy.fmi2 import FMU2Slave
        except ImportError:
            raise ImportError('what runs it is not installed: pip install "jaxouter[fmu]"') from None

        description: Any = fmpy.read_model_description(str(path))
        self._references = {v.name: v.valueReference for v in description.modelVariables}
        self._step = float(description.defaultExperiment.stepSize)
        self._fmu = FMU2Slave(
            guid=description.guid,
            modelIdentifier=description.coSimulation.modelIdentifier,
            unzipDirectory=fmpy.extract(str(path), str(place)),
            instanceName="outer_loop",
        )
        struct, values = _struct(spec), ctypes.c_double * len(self._references)

        class Kept(ctypes.Structure):
            _fields_ = [("controller", struct), ("value", values), ("begun", ctypes.c_int), ("phase", ctypes.c_int)]

        self._kept = Kept

    def __enter__(self) -> FmuController:
        self._fmu.instantiate()
        return self

    def __exit__(self, *_: object) -> None:
        self._fmu.terminate()
        self._fmu.freeInstance()

    def init(self, y0: float) -> bytes:
        """State before the first step; y0 comes with that step's y."""
        del y0
        self._fmu.reset()
        self._fmu.setupExperiment()
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        return self._state()

    def act(self, state: State | bytes, r: float, y: float) -> tuple[bytes, float]:
        """One control step."""
        if isinstance(state, State):
            kept = self._kept.from_buffer_copy(self._state())
            _fill(kept.controller, state)
            kept.begun = 1
            state = bytes(kept)
        loaded = self._fmu.deSerializeFMUstate(state)
        self._fmu.setFMUstate(loaded)
        self._fmu.freeFMUstate(loaded)
        self._fmu.setReal([self._references["r"], self._references["y"]], [r, y])
        time = self._fmu.getReal([self._references["time"]])[0]
        self._fmu.doStep(time, self._step)
        return self._state(), self._fmu.getReal([self._references["r_tilde"]])[0]

    def _state(self) -> bytes:
        kept = self._fmu.getFMUstate()
        out = self._fmu.serializeFMUstate(kept)
        self._fmu.freeFMUstate(kept)
        return out
