"""Plants around simulators outside JAX: a Gymnasium environment, an FMU, or anything else with `reset` and `step`.

A plant's step is a pure function, but a simulator has a state of its own. So each state a simulator has been in gets a
number, its moment, which is the plant's state. A table holds the previous moment and the r~ that led from it. To step
the newest moment of an episode, its simulator takes one more step. To step an older one, a simulator replays the
episode up to there. This requires a simulator to do the same again from the same seed. Nothing here is differentiable.
"""

from __future__ import annotations

import math
import threading
import time
from array import array
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.plants.base import Plant
from jaxouter.plants.errors import PlantError, Raised, said

SIMULATORS = 256  # most simulators kept alive
TRIED = 20  # control steps for measuring the speed if none were made yet
START = -1  # the moment before the first one of an episode


class Simulator(Protocol):
    """A closed loop outside JAX. Reproducible from its seed; y is nan once it can't go on.

    It may have an attribute `ended`: None, or the reason why it can't go on.
    """

    def reset(self, seed: int) -> float:
        """Begin an episode: y_0."""
        ...

    def step(self, r_tilde: float) -> float:
        """One control step with r~ held: y after it."""
        ...


class HostState(NamedTuple):
    """State of a plant outside JAX."""

    moment: jax.Array  # int32
    y: jax.Array


class Speed(NamedTuple):
    """Time spent in a plant outside JAX so far."""

    steps: int  # control steps
    seconds: float  # spent in its code

    @property
    def step_seconds(self) -> float:
        """Seconds a control step."""
        return self.seconds / self.steps if self.steps else math.nan


class Moments:
    """The simulators of one plant, by their current moment."""

    def __init__(self, name: str, make: Callable[[], Simulator], side_by_side: int) -> None:
        """Args: name: of the plant; make: makes a simulator; side_by_side: episodes that may run at the same time."""
        self.name, self.side_by_side = name, side_by_side
        self.ended: str | None = None
        """Where and why an episode could not go on: the first one since this was reset to None."""
        self._make, self._kept = make, side_by_side
        self._before = array("i")  # previous moment of each
        self._by = array("d")  # the r~ that led from it; at a start, the seed
        self._at: OrderedDict[int, Simulator] = OrderedDict()
        self._lock = threading.Lock()
        self._steps, self._seconds = 0, 0.0

    @property
    def speed(self) -> Speed:
        """Control steps so far, including replayed ones, and their time."""
        return Speed(self._steps, self._seconds)

    def begin(self, seeds: list[int]) -> list[tuple[int, float]]:
        """Start one episode per seed: the first moment of each, and y."""
        self._kept = max(self._kept, 2 * len(seeds))  # new episodes may begin while others still run
        return [self._begin(seed) for seed in seeds]

    def _begin(self, seed: int) -> tuple[int, float]:
        with self._lock:
            simulator = self._free(seed)
            y = self._reset(simulator, seed)
            return self._new(START, seed, simulator), y

    def step(self, moment: int, r_tilde: float) -> tuple[int, float]:
        """The moment after one control step, and y."""
        with self._lock:
            simulator = self._at.pop(moment, None) or self._again(moment)
            y = self._step(simulator, moment, r_tilde)
            return self._new(moment, r_tilde, simulator), y

    def _new(self, before: int, by: float, simulator: Simulator) -> int:
        self._before.append(before)
        self._by.append(by)
        self._at[len(self._before) - 1] = simulator
        return len(self._before) - 1

    def _free(self, seed: int) -> Simulator:
        """A new simulator, or else the one that has been idle longest."""
        if len(self._at) >= self._kept:
            return self._at.popitem(last=False)[1]
        with self._guarded(lambda: f"at the start of the episode with seed {seed}"):
            return self._make()

    def _reset(self, simulator: Simulator, seed: int) -> float:
        with self._guarded(lambda: f"at the start of the episode with seed {seed}"):
            return float(simulator.reset(seed))

    def _step(self, simulator: Simulator, moment: int, r_tilde: float) -> float:
        begun = time.perf_counter()
        with self._guarded(lambda: f"{self._place(moment)}, r~ = {r_tilde:g}"):
            y = float(simulator.step(r_tilde))
        self._seconds += time.perf_counter() - begun
        self._steps += 1
        if self.ended is None and math.isnan(y):
            self.ended = getattr(simulator, "ended", None)
        return y

    @contextmanager
    def _guarded(self, where: Callable[[], str]) -> Iterator[None]:
        try:
            yield
        except PlantError:
            raise
        except Raised as error:
            raise PlantError(self.name, where(), said(error)) from error

    def _history(self, moment: int) -> tuple[int, list[float]]:
        """The seed of a moment's episode, and all r~ up to it."""
        inputs = []
        while (before := self._before[moment]) != START:
            inputs.append(self._by[moment])
            moment = before
        return int(self._by[moment]), inputs[::-1]

    def _place(self, moment: int) -> str:
        """The control step after a moment, in words."""
        seed, inputs = self._history(moment)
        return f"control step {len(inputs) + 1} of the episode with seed {seed}"

    def _again(self, moment: int) -> Simulator:
        """A simulator that has replayed the episode up to a moment."""
        seed, inputs = self._history(moment)
        simulator = self._free(seed)
        self._reset(simulator, seed)
        at = []
        while (before := self._before[moment]) != START:
            moment = before
            at.append(moment)
        for before, r_tilde in zip(reversed(at), inputs, strict=True):
            self._step(simulator, before, r_tilde)
        return simulator


def plant(
    make: Callable[[], Simulator], *, side_by_side: int = SIMULATORS, name: str, **declared: Any
) -> tuple[Plant, tuple[()]]:
    """A plant around simulators, and its (empty) parameters.

    Args:
        make: makes a simulator; called once per episode that runs at the same time.
        side_by_side: most episodes to run at the same time.
        name, **declared: fields of `Plant`, except its functions.
    """
    loop = _Loop(Moments(name, make, side_by_side))
    return Plant(name, loop.init, loop.step, loop.output, differentiable=False, **declared), ()


class _Loop:
    """The functions of such a plant."""

    def __init__(self, moments: Moments) -> None:
        self.moments = moments

    def init(self, key: chex.PRNGKey, params: Any) -> HostState:
        del params
        seed = jax.random.bits(key, (), jnp.uint32)
        return HostState(*jax.pure_callback(self._begin, _result(), seed, vmap_method="broadcast_all"))

    def step(self, params: Any, state: HostState, r_tilde: jax.Array, key: chex.PRNGKey) -> HostState:
        del params, key
        inputs = state.moment, r_tilde
        return HostState(*jax.pure_callback(self._advance, _result(), *inputs, vmap_method="broadcast_all"))

    @staticmethod
    def output(params: Any, state: HostState) -> jax.Array:
        del params
        return state.y

    def _begin(self, seeds: Any) -> tuple[np.ndarray, np.ndarray]:
        return _arrays(self.moments.begin(np.ravel(seeds).tolist()), np.shape(seeds))

    def _advance(self, at: Any, r_tilde: Any) -> tuple[np.ndarray, np.ndarray]:
        lanes = zip(np.ravel(at).tolist(), np.ravel(r_tilde).tolist(), strict=True)
        return _arrays([self.moments.step(*lane) for lane in lanes], np.shape(at))


def _result() -> tuple[jax.ShapeDtypeStruct, jax.ShapeDtypeStruct]:
    return jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((), jnp.result_type(float))


def _arrays(lanes: list[tuple[int, float]], shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    moment, y = zip(*lanes, strict=True)
    return np.asarray(moment, np.int32).reshape(shape), np.asarray(y, jnp.result_type(float)).reshape(shape)


def of(plant: Plant) -> Moments | None:
    """The simulators of a plant outside JAX; None for a JAX plant."""
    loop = getattr(plant.step, "__self__", None)
    return loop.moments if isinstance(loop, _Loop) else None


def side_by_side(plant: Plant) -> int | None:
    """Most episodes of a plant to run at the same time; None: no limit."""
    moments = of(plant)
    return None if moments is None else moments.side_by_side


def step_seconds(plant: Plant) -> float | None:
    """Seconds per control step of a plant outside JAX, measured now if need be; None for a JAX plant.

    Raises:
        PlantError: the plant's own code failed.
    """
    moments = of(plant)
    if moments is None:
        return None
    if moments.speed.steps < TRIED:
        ((moment, _),) = moments.begin([0])
        for _ in range(TRIED):
            moment, _ = moments.step(moment, sum(plant.r_tilde_bounds) / 2)
    return moments.speed.step_seconds
