"""A simulator that is no JAX as a plant: a Gymnasium environment, an FMU, or anything else that has `reset` and `step`.

Plants are pure functions, simulators are not: they move on. So the state of such a plant is the number of a moment, and
this process remembers from which moment, by which r~, each one came. Stepping the newest moment of an episode moves its
simulator on; stepping an older one lets a simulator go through its episode again. So a simulator must do the same again
from the same seed. Nothing here is differentiable.
"""

from __future__ import annotations

import threading
from array import array
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.plants.base import Plant

SIMULATORS = 256  # that are kept going
START = -1  # in place of an older moment


class Simulator(Protocol):
    """A closed loop elsewhere. The same from the same seed, and nan from where it can't go on."""

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


class Moments:
    """The simulators of one plant, by the moment at which each is."""

    def __init__(self, make: Callable[[], Simulator]) -> None:
        self._make = make
        self._before = array("i")  # the moment from which each came
        self._by = array("d")  # by which r~; at a start, from which seed
        self._at: OrderedDict[int, Simulator] = OrderedDict()
        self._lock = threading.Lock()

    def begin(self, seed: int) -> tuple[int, float]:
        """A new episode: its first moment, and y."""
        with self._lock:
            simulator = self._free()
            return self._new(START, seed, simulator), simulator.reset(seed)

    def step(self, moment: int, r_tilde: float) -> tuple[int, float]:
        """The moment after one control step, and y."""
        with self._lock:
            simulator = self._at.pop(moment, None) or self._again(moment)
            y = simulator.step(r_tilde)
            return self._new(moment, r_tilde, simulator), y

    def _new(self, before: int, by: float, simulator: Simulator) -> int:
        self._before.append(before)
        self._by.append(by)
        self._at[len(self._before) - 1] = simulator
        return len(self._before) - 1

    def _free(self) -> Simulator:
        """A simulator: a new one, or that of the moment that was left alone for longest."""
        return self._make() if len(self._at) < SIMULATORS else self._at.popitem(last=False)[1]

    def _again(self, moment: int) -> Simulator:
        inputs = []
        while (before := self._before[moment]) != START:
            inputs.append(self._by[moment])
            moment = before
        simulator = self._free()
        simulator.reset(int(self._by[moment]))
        for r_tilde in reversed(inputs):
            simulator.step(r_tilde)
        return simulator


def plant(make: Callable[[], Simulator], **declared: Any) -> tuple[Plant, tuple[()]]:
    """A plant around simulators, and its parameters: none.

    Args:
        make: a new simulator; called as often as episodes go on side by side.
        **declared: of `Plant`, but for its functions.
    """
    moments = Moments(make)
    float_ = jnp.result_type(float)
    result = jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((), float_)

    def begin(seeds: Any) -> tuple[np.ndarray, np.ndarray]:
        return _arrays([moments.begin(seed) for seed in np.ravel(seeds).tolist()], np.shape(seeds))

    def advance(at: Any, r_tilde: Any) -> tuple[np.ndarray, np.ndarray]:
        lanes = zip(np.ravel(at).tolist(), np.ravel(r_tilde).tolist(), strict=True)
        return _arrays([moments.step(*lane) for lane in lanes], np.shape(at))

    def _arrays(lanes: list[tuple[int, float]], shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        moment, y = zip(*lanes, strict=True)
        return np.asarray(moment, np.int32).reshape(shape), np.asarray(y, float_).reshape(shape)

    def init(key: chex.PRNGKey, params: Any) -> HostState:
        del params
        return HostState(
            *jax.pure_callback(begin, result, jax.random.bits(key, (), jnp.uint32), vmap_method="broadcast_all")
        )

    def step(params: Any, state: HostState, r_tilde: jax.Array, key: chex.PRNGKey) -> HostState:
        del params, key
        return HostState(*jax.pure_callback(advance, result, state.moment, r_tilde, vmap_method="broadcast_all"))

    def output(params: Any, state: HostState) -> jax.Array:
        del params
        return state.y

    return Plant(init=init, step=step, output=output, differentiable=False, **declared), ()
