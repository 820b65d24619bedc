"""Local stability of the whole closed loop: plant with its delay lines, and whatever the policy remembers.

At a held set-point the loop is a map z -> F(z) from one control step to the next. Its equilibrium is found by a
semi-smooth Newton method, and the spectral radius of its Jacobian there decides: below 1 the loop returns to the
equilibrium after every small upset, above 1 it does not. Noise of plant and sensor is off; all is in double precision.
Where a policy switches between laws, the one that acts at the equilibrium goes on to act.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from jax.flatten_util import ravel_pytree
from msgspec import Struct
from scipy.sparse.linalg import ArpackNoConvergence, eigs, splu

from jaxouter.loop import closed_loop, rewards
from jaxouter.loop.policy import Policy
from jaxouter.loop.rewards import RewardParams
from jaxouter.plants import Plant
from jaxouter.plants.base import float_leaves, with_float_leaves

EPISODES = 10  # length of the simulation from whose end the equilibrium is sought
TOLERANCE = 1e-11  # residual of an equilibrium, as share of the range of r~ or of the largest variable
NEAR = 1e-7  # what is this near a bound or a kink counts as at it; share of the range of r~
JUMP = 1e-3  # a Jacobian that changes by more within NEAR has a kink; share of the largest entry of the row
NEWTON_STEPS = 25
HALVINGS = 8
DENSE = 400  # variables up to which linear algebra is dense


class LocalStability(Struct, frozen=True):
    """Local stability at one set-point; None where there is nothing to say."""

    set_point: float  # in the unit of y
    y: float | None  # at the equilibrium
    r_tilde: float | None  # at the equilibrium
    spectral_radius: float | None  # of one control step; below 1 the equilibrium is locally stable
    note: str  # what is special, '' where nothing is


class _Given(NamedTuple):
    """What is traced, double precision throughout."""

    policy: Any
    plant: Any
    r: jax.Array
    carry: Any = ()  # of the policy, for what is no variable in it


class _State(NamedTuple):
    """State of the closed loop at t_k."""

    plant: Any
    carry: Any


@dataclass(frozen=True)
class _Loop:
    """Plant and policy as one map. Static and hashable."""

    plant: Plant
    policy: Policy

    def begin(self, given: _Given) -> _State:
        """State at the start of an episode."""
        state = self.plant.init(jax.random.key(0), given.plant)
        return _State(state, self.policy.init(given.policy, given.r, self.plant.output(given.plant, state)))

    def begun(self, given: _Given) -> Any:
        """The carry of the policy after the first control step."""
        return self.step(given, self.begin(given))[0].carry

    def step(self, given: _Given, state: _State, seed: int | jax.Array = 0) -> tuple[_State, jax.Array]:
        """One control step as in a roll-out: the state at t_(k+1), and r~_k."""
        loop, key = closed_loop.begin(self.plant, given.plant, state.plant), jax.random.key(seed)
        loop, carry, _, _ = closed_loop.step(
            self.plant, given.plant, self.price, self.policy, given.policy, loop, state.carry, given.r, key
        )
        return _State(loop.plant, carry), loop.r_tilde

    @property
    def price(self) -> RewardParams:
        """Of rewards that nobody asks for here."""
        return rewards.params(self.plant)

    def flatten(self, given: _Given, state: _State) -> jax.Array:
        """All that evolves, z (n,)."""
        return ravel_pytree(self._evolving(given, state))[0]

    def unflatten(self, given: _Given, z: jax.Array) -> _State:
        """The state long after the start with the variables z (n,)."""
        template = self.begin(given)
        variables, remembered = ravel_pytree(self._evolving(given, template))[1](z)
        plant_state = self.plant.settled(given.plant, template.plant, variables)
        return _State(plant_state, with_float_leaves(None, given.carry, remembered))

    def _evolving(self, given: _Given, state: _State) -> tuple[Any, list[jax.Array]]:
        return self.plant.variables(given.plant, state.plant), float_leaves(None, state.carry)


class _Begin(NamedTuple):
    """Where an equilibrium is sought from."""

    z: Any  # (n,)
    carry: Any  # of the policy


class _Point(NamedTuple):
    """One control step from z, z -> F(z), linearised."""

    z: Any  # (n,)
    residual: Any  # (n,), F(z) - z
    jacobian: Any  # (n, n), of F
    y: Any  # scalar
    r_tilde: Any  # scalar


@partial(jax.jit, static_argnums=0)
def _linearise(loop: _Loop, given: _Given, z: jax.Array) -> _Point:
    def move(z: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        state = loop.unflatten(given, z)
        after, r_tilde = loop.step(given, state)
        after = loop.flatten(given, after)
        return after, (z, after - z, loop.plant.output(given.plant, state.plant), r_tilde)

    jacobian, (z, residual, y, r_tilde) = jax.jacfwd(move, has_aux=True)(z)
    return _Point(z, residual, jacobian, y, r_tilde)


@partial(jax.jit, static_argnums=0)
def _simulate(loop: _Loop, given: _Given) -> tuple[_Begin, _Begin, jax.Array]:
    """The start, the end after `EPISODES`, and whether y stayed within the bounds of divergence."""
    low, high = loop.plant.divergence_bounds

    def step(at: tuple[_State, jax.Array], _: Any) -> tuple[tuple[_State, jax.Array], None]:
        state = loop.step(given, at[0])[0]
        y = loop.plant.output(given.plant, state.plant)
        return (state, at[1] & (y >= low) & (y <= high)), None

    begin = loop.begin(given)
    (end, bounded), _ = jax.lax.scan(step, (begin, jnp.array(True)), length=EPISODES * loop.plant.episode_steps)
    first = _Begin(loop.flatten(given, begin), loop.begun(given))
    return first, _Begin(loop.flatten(given, end), end.carry), bounded


@partial(jax.jit, static_argnums=0)
def _two_steps(loop: _Loop, given: _Given, z: jax.Array) -> jax.Array:
    """What z becomes in two control steps, by the loop itself with its clocks and noise."""

    def step(state: _State, seed: jax.Array) -> tuple[_State, None]:
        return loop.step(given, state, seed)[0], None

    return loop.flatten(given, jax.lax.scan(step, loop.unflatten(given, z), jnp.array([1, 2]))[0])


def analyse(
    policy: Policy, policy_params: Any, plant: Plant, params: Any, set_points: Sequence[float]
) -> list[LocalStability]:
    """Local stability of a policy on a plant at each of the set-points.

    The equilibrium is the one that the loop reaches from its start; where it reaches none, the one that Newton's method
    finds from there or from rest.

    Args:
        policy, policy_params: the outer loop.
        plant, params: the plant, unbatched.
        set_points: in the unit of y.

    Returns:
        One each. Where r~ is at a bound, the outer loop acts on one side at most: the radius is then that of
        the saturated side. At a kink it is the largest found on the sides of it.
    """
    if policy.host:
        return [_nothing(r, "policy is not a JAX function") for r in set_points]
    loop = _Loop(plant, policy)
    with jax.enable_x64(True):
        policy_params, params = jax.tree.map(_double, (policy_params, params))
        params = plant.noise_free(plant.smallest(params))
        loop_at = [_Given(policy_params, params, jnp.asarray(r, float)) for r in set_points]
        if loop_at and not _time_invariant(loop, _held(loop, loop_at[0], loop.begun(loop_at[0]))):
            return [_nothing(r, "depends on a clock or on noise that is not declared") for r in set_points]
        return [_analyse(loop, each) for each in loop_at]


def _held(loop: _Loop, given: _Given, carry: Any) -> _Given:
    """The same without switching, by the law that acts in this carry of the policy."""
    without = getattr(loop.policy, "without_switching", lambda params: params)
    return given._replace(policy=without(given.policy), carry=carry)


def _nothing(set_point: Any, note: str) -> LocalStability:
    return LocalStability(float(set_point), None, None, None, note)


def _double(leaf: Any) -> jax.Array:
    leaf = jnp.asarray(leaf)
    return leaf.astype(jnp.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def _range(loop: _Loop) -> float:
    low, high = loop.plant.r_tilde_bounds
    return high - low


def _signs(n: int) -> np.ndarray:
    """(2, n): plus or minus one at random, the same at each call."""
    return np.random.default_rng(0).choice([-1.0, 1.0], (2, n))


def _time_invariant(loop: _Loop, given: _Given) -> bool:
    """Whether the map, applied twice, does what the loop does: else a clock, a cursor or noise has been left out."""
    z = np.asarray(loop.flatten(given, loop.begin(given)))
    z = z + 1e-3 * _range(loop) * _signs(len(z))[0]
    once = _linearise(loop, given, z)
    twice = _linearise(loop, given, once.z + once.residual)
    tolerance = 1e-9 * _range(loop)
    return np.allclose(twice.z + twice.residual, _two_steps(loop, given, z), 1e-9, tolerance, equal_nan=True)


def _analyse(loop: _Loop, given: _Given) -> LocalStability:
    def linearise(given: _Given, z: np.ndarray) -> _Point:
        return jax.device_get(_linearise(loop, given, z))  # type: ignore[arg-type]

    low, high = loop.plant.r_tilde_bounds
    rest, end, bounded = jax.device_get(_simulate(loop, given))
    for begin in [end, rest] if bounded else [rest]:
        linearised = partial(linearise, _held(loop, given, begin.carry))
        point = _equilibrium(linearised, begin.z, _range(loop))
        if point is not None:
            break
    else:
        return _nothing(given.r, "no equilibrium found")
    radius, notes = spectral_radius(point.jacobian), []
    if min(point.r_tilde - low, high - point.r_tilde) <= NEAR * _range(loop):
        notes.append("r~ at its bound")
    moves = NEAR * _range(loop) * _signs(len(point.z))
    sides = [linearised(point.z + move).jacobian for move in (*moves, *-moves)]
    if any(_jumps(point.jacobian, side) for side in sides):
        radii = [spectral_radius(side) for side in sides]
        radius = max(radii)
        notes.append(f"at a kink: spectral radius {min(radii):.6g} to {radius:.6g} on its sides")
    return LocalStability(float(given.r), float(point.y), float(point.r_tilde), radius, "; ".join(notes))


def _jumps(a: np.ndarray, b: np.ndarray) -> bool:
    size = np.maximum(np.abs(a), np.abs(b)).max(1, keepdims=True)
    return bool(np.any(np.abs(a - b) > JUMP * size))


def _equilibrium(linearise: Callable[[np.ndarray], _Point], z: np.ndarray, unit: float) -> _Point | None:
    """Newton's method on F(z) = z from z (n,), damped so that the residual falls; `unit` is the size of a signal."""
    point = linearise(z)
    for _ in range(NEWTON_STEPS):
        if np.abs(point.residual).max() <= TOLERANCE * max(unit, np.abs(point.z).max()):
            return point
        if not (np.isfinite(point.residual).all() and np.isfinite(point.jacobian).all()):
            return None
        move = _least_squares(np.eye(len(z)) - point.jacobian, point.residual)
        trials = (linearise(point.z + move / 2**halvings) for halvings in range(HALVINGS))
        falls = (trial for trial in trials if np.linalg.norm(trial.residual) < np.linalg.norm(point.residual))
        point = next(falls, None)
        if point is None:
            return None
    return None


def _least_squares(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The shortest x (n,) that minimises |A x - b|; where A (n, n) is large and regular the sparse solution."""
    if len(A) > DENSE:
        try:
            x = splu(scipy.sparse.csc_matrix(A)).solve(b)
            if np.linalg.norm(A @ x - b) <= 1e-6 * np.linalg.norm(b):
                return x
        except RuntimeError:  # exactly singular
            pass
    return np.linalg.lstsq(A, b, rcond=None)[0]


def spectral_radius(J: np.ndarray) -> float:
    """Largest |eigenvalue| of J (n, n).

    Taken block by block of what depends on each other in a circle. Delay lines beyond the last sample that is read, and
    all else that only follows, thus count with exactly the zero that they add, which would not survive rounding.
    """
    graph = scipy.sparse.csr_matrix(J)
    _, block = scipy.sparse.csgraph.connected_components(graph, connection="strong")
    sizes = np.bincount(block)
    single = np.abs(np.diag(J)[sizes[block] == 1])
    members = (np.flatnonzero(block == i) for i in np.flatnonzero(sizes > 1))
    return max([float(single.max(initial=0.0)), *(_of_block(J[np.ix_(rows, rows)]) for rows in members)])


def _of_block(J: np.ndarray) -> float:
    if len(J) > DENSE:
        try:
            start = np.random.default_rng(0).normal(size=len(J))
            found = eigs(scipy.sparse.csr_matrix(J), k=4, ncv=80, v0=start, which="LM", return_eigenvectors=False)
            return float(np.abs(found).max())
        except ArpackNoConvergence:
            pass
    return float(np.abs(np.linalg.eigvals(J)).max())
