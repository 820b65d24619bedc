"""`clairvoyant`: the least MAE that any outer loop could reach, by linear programming; a bound, not a controller.

It knows the plant, its state, the noise to come and the whole reference. The plants are affine in r~ with additive
noise, so that y = y_base + G (r~ - base) along an episode, and the least sum of |r_k - y_(k+1)| is a linear program.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.plants import Plant
from jaxouter.plants.base import in_words, outputs

NEGLIGIBLE = 1e-9  # of the largest response: one that has died out so far is left out of the program
MISMATCH = 1e-4  # between simulated and predicted response, of the largest so far
PRICE = 1e3  # of leaving the limits by 1 at one step, in units of error at one step


class Plan(NamedTuple):
    """The best that could have been done, episode by episode."""

    r_tilde: np.ndarray  # (episodes, T), float32
    mae: np.ndarray  # (episodes,), the program's optimum; nan where the plant's y is not finite without control
    violation: np.ndarray  # (episodes,), largest excess over the limits; 0 where they can be kept


@dataclass(frozen=True)
class Replay:
    """Plays a given sequence of r~, whatever it sees. Its params are the r~ (T,) of one episode; its carry is k."""

    host: bool = False

    def init(self, params: jax.Array, r0: jax.Array, y0: jax.Array) -> jax.Array:
        """Step 0."""
        del params, r0, y0
        return jnp.zeros((), jnp.int32)

    def act(
        self, params: jax.Array, carry: jax.Array, r: jax.Array, y: jax.Array, key: chex.PRNGKey | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """The next r~ of the sequence; its last one is held."""
        del r, y, key
        return carry + 1, params[jnp.minimum(carry, params.shape[0] - 1)]


def plan(scenario: Scenario) -> Plan:
    """The r~ of least MAE on each episode, within the bounds of r~ and the limits on y.

    The limits (the plant's `output_limit` and `rate_limit`) hold at every control step. Where no r~ keeps them, they
    are left by as little as possible: leaving them costs a thousand times as much as the same error, and the plan
    says by how much it does.

    Args:
        scenario: the episodes; start, noise and changes of the plant are those of `rollout`.

    Returns:
        Plan. `rollout(Replay(), plan.r_tilde, scenario, per_episode=True)` has its MAE, to the rounding of single
        precision: about 1e-5 of the plant's error scale.

    Raises:
        ValueError: the plant is not affine in r~ with additive noise.
        RuntimeError: the linear program could not be solved.
    """
    episodes, steps = scenario.r.shape
    low, high = scenario.plant.r_tilde_bounds
    base = (low + high) / 2
    r_tilde = np.full((episodes, steps), base, scenario.r.dtype)
    mae, violation = np.full((2, episodes), np.nan)

    free = rollout(Replay(), r_tilde, scenario, per_episode=True)
    probe = np.random.default_rng(0).uniform(low, high, steps).astype(scenario.r.dtype)
    moved = rollout(Replay(), np.tile(probe, (episodes, 1)), scenario, per_episode=True).y.astype(float) - free.y
    finite = np.isfinite(moved).all(1)
    responses, which = _responses(scenario, probe - base, moved, np.abs(free.y).max(1), finite)

    # Episodes of the same response, start, noise and reference have the same plan.
    given = np.column_stack([which, free.y0, free.y, free.r]).astype(float)[finite]
    distinct, index = np.unique(given, axis=0, return_inverse=True)
    solved = []
    for row in distinct:
        y_base, r = row[2:].reshape(2, steps)
        solved.append(_solve(scenario.plant, responses[int(row[0])], float(row[1]), y_base, r))
    for i, j in zip(np.flatnonzero(finite), index, strict=True):
        r_tilde[i], mae[i], violation[i] = solved[j]
    return Plan(r_tilde, mae, violation)


def _responses(
    scenario: Scenario, probe: np.ndarray, moved: np.ndarray, size: np.ndarray, finite: np.ndarray
) -> tuple[list[scipy.sparse.csr_array], np.ndarray]:
    """G (T, T) of each kind of episode, and the number of its kind for each episode.

    Episodes whose simulated response to the probe agrees with the same G are of one kind.

    Args:
        scenario: the episodes.
        probe: r~ (T,) of a random simulation, less the base value.
        moved: y (episodes, T) of that simulation, less y with the base value.
        size: of y (episodes,), which its rounding goes with.
        finite: (episodes,), those that matter.
    """
    responses, which = [], np.where(finite, -1, 0)
    tolerance = MISMATCH * np.maximum.accumulate(np.abs(moved), axis=1) + 1e-5 * size[:, None]
    while (which < 0).any():
        i = int(np.argmax(which < 0))
        G = _response(scenario, i)
        alike = (which < 0) & (np.abs(moved - G @ probe) <= tolerance).all(1)
        if not alike[i]:
            error = np.abs(moved[i] - G @ probe).max()
            raise ValueError(
                f"plant {scenario.plant.name!r} is not affine in r~ with additive noise (its output misses the affine "
                f"prediction by {error:.3g}{in_words(scenario.plant.y_unit)}); the clairvoyant bound exists for such "
                "plants only"
            )
        which[alike] = len(responses)
        responses.append(scipy.sparse.csr_array(np.where(np.abs(G) > NEGLIGIBLE * np.abs(G).max(), G, 0.0)))
    return responses, which


def _response(scenario: Scenario, episode: int) -> np.ndarray:
    """dy_(k+1) / dr~_j (T, T) of one episode, in double precision; noise is additive and has no part in it."""

    def double(leaf: jax.Array) -> jax.Array:
        value = np.asarray(leaf)[episode]
        return jnp.asarray(value, float if np.issubdtype(value.dtype, np.floating) else value.dtype)

    with jax.enable_x64(True):
        change = scenario.change
        change = None if change is None else (jnp.asarray(change[0]), jax.tree.map(double, change[1]))
        base = jnp.full(scenario.r.shape[1], sum(scenario.plant.r_tilde_bounds) / 2)
        return np.asarray(_jacobian(scenario.plant, jax.tree.map(double, scenario.params), change, base))


@partial(jax.jit, static_argnums=0)
def _jacobian(plant: Plant, params: Any, change: Any, base: jax.Array) -> jax.Array:
    key = jax.random.key(0)

    keys = jnp.broadcast_to(key, base.shape)
    return jax.jacfwd(lambda r_tilde: outputs(plant, params, plant.init(key, params), r_tilde, keys, change))(base)


def _solve(
    plant: Plant, G: scipy.sparse.csr_array, y0: float, y_base: np.ndarray, r: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """r~ (T,), MAE and largest excess of one episode.

    Variables, each (T,): u = r~ - base; p, n >= 0 with y = r - p + n, of which at the optimum one is |r - y| and the
    other 0; s >= 0 by which the limits are left.
    """
    steps, unit = len(r), plant.error_scale  # the solver's tolerances are absolute
    y0, y_base, r = y0 / unit, y_base / unit, r / unit
    eye, none = scipy.sparse.eye_array(steps), scipy.sparse.csr_array((steps, steps))
    rows, bounds = [], []
    for limit, change, start in _limits(plant, steps, y0):
        rows += [[none, -change, change, -eye], [none, change, -change, -eye]]  # change @ y - start within the limit
        bounds += [limit - change @ r + start, limit + change @ r - start]
    u_bound = (plant.r_tilde_bounds[1] - plant.r_tilde_bounds[0]) / 2 / unit
    program = dict(
        c=np.repeat([0.0, 1.0, 1.0, PRICE], steps),
        A_eq=scipy.sparse.block_array([[G, eye, -eye, none]], format="csr"),
        b_eq=r - y_base,
        A_ub=scipy.sparse.block_array(rows, format="csr") if rows else None,
        b_ub=np.concatenate(bounds) if bounds else None,
        bounds=np.repeat([[-u_bound, u_bound], [0.0, np.inf], [0.0, np.inf], [0.0, np.inf]], steps, axis=0),
    )
    result = scipy.optimize.linprog(**program, method="highs-ds")  # the interior-point method fails on some of these
    if result.x is None:
        raise RuntimeError(f"the linear program of the clairvoyant plan was not solved: {result.message}")
    u, p, n, s = unit * result.x.reshape(4, steps)
    return u + sum(plant.r_tilde_bounds) / 2, float(np.mean(p + n)), float(s.max())


def _limits(plant: Plant, steps: int, y0: float) -> list[tuple[float, scipy.sparse.csr_array, np.ndarray]]:
    """Each limit as (limit, M, start): |M y - start| <= limit, y (steps,); all in error scales."""
    limits = []
    if plant.output_limit is not None:
        limits.append(
            (plant.output_limit / plant.error_scale, scipy.sparse.eye_array(steps, format="csr"), np.zeros(steps))
        )
    if plant.rate_limit is not None:
        difference = (scipy.sparse.eye_array(steps) - scipy.sparse.eye_array(steps, k=-1)).tocsr()
        limits.append((plant.rate_limit / plant.error_scale, difference, np.eye(steps)[0] * y0))
    return limits
