"""Identification of a plant that is unstable alone, from records that diverge.

Episodes of random r~ count until y leaves the plant's bounds. A model of them gives an LQ law; under this law and a
dither episodes last longer, and those that stay within the bounds are recorded too, in two rounds, the second under the
law of all before. The law is the one that follows best from rest: laws that bring back more starts follow slowly, and
starts far away are for the actor to learn. Each episode is then continued by the model, as it would have been under a
law without bounds, so that what came of its start under any other r~ can be computed (`counterfactual`). Starts that no
r~ within the bounds can bring back are left out: a linear programme on the model says which.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxouter.identification import lq
from jaxouter.identification.counterfactual import CounterfactualParams
from jaxouter.identification.dynamics import NEGLIGIBLE
from jaxouter.identification.linear_models import fit_arx, impulse_response, prediction_error, radius
from jaxouter.identification.records import Record, record, within
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.loop import closed_loop, rewards
from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.policy import Linear, LinearLaw, Past
from jaxouter.loop.references import redrawn, telegraph
from jaxouter.plants import Plant
from jaxouter.plants.arx import Model
from jaxouter.plants.base import RUN_ONCE, in_words

EPISODES = 64  # under random r~, of which the lags are chosen
LAGS = (0.15, 0.2, 0.3, 0.4)  # shares of an episode
HORIZON = 0.2  # of the prediction, likewise
ENOUGH = 1e-3  # prediction error, as share of the standard deviation of y, that fewer lags may cost
NOISE = 6e-3  # standard deviation in the fit; 1 is half the set-point range
PRICES = (*lq.PRICES, 10**2.5, 10.0**3)  # of moves: a law that moves r~ less is at its bounds less often
INSIDE = 0.8  # share of the set-point range in closed loop
DITHER, RATE = 1 / 12, 0.2  # of half the range of r~; redraws per control step
DISTURBANCES = Disturbances(noise=0.0075)  # under which laws are compared
CLOSED = 128  # episodes in closed loop
ROUNDS = 2  # of episodes in closed loop, each under the law of all before
LATE = 0.15  # share of an episode, at its end, in which y must be within bounds


class Identified(NamedTuple):
    """What the records gave."""

    chosen: lq.Choice
    params: CounterfactualParams  # of the model, on which each episode replays a recorded start


def lags(plant: Plant, params: Any, key: chex.PRNGKey) -> int:
    """Lags that a model needs: the least of `LAGS` whose predictions are about as good as the best."""
    data = within(record(plant, params, key, EPISODES), plant.divergence_bounds, 0.0)
    fitted, held_out = (Record(*(each[part] for each in data)) for part in (slice(0, -16), slice(-16, None)))
    tried = sorted({max(1, round(share * plant.episode_steps)) for share in LAGS})
    horizon = max(1, round(HORIZON * plant.episode_steps))
    errors = [prediction_error(fit_arx(fitted, n, 0), held_out, horizon) for n in tried]
    enough = 1.01 * min(errors) + ENOUGH * float(np.nanstd(held_out.y))
    return next(n for n, error in zip(tried, errors, strict=True) if error <= enough)


def identify(
    plant: Plant,
    params: Any,
    data: Record,
    key: chex.PRNGKey,
    history: int,
    disturbances: Disturbances,
    static: LinearLaw,
    episodes: int,
) -> Identified:
    """Base law and model of a plant that is unstable alone.

    Args:
        plant: with episodes as long as those recorded.
        params: its parameters, for the records in closed loop.
        data: episodes under random r~.
        key: of those in closed loop, and of the choice of the law.
        history: lags of the model.
        disturbances: under which laws are compared.
        static: the law with which they are compared.
        episodes: to record in closed loop.

    Raises:
        ValueError: no recorded start can be brought back; says why.
    """
    key_law, *keys = jax.random.split(key, 1 + ROUNDS)
    opened = within(data, plant.divergence_bounds, 0.0)
    found = _law(plant, opened, key_law, history, disturbances, static)
    both = opened
    for i, key_run in enumerate(keys):
        ran = (episodes + i) // ROUNDS
        both = joined(both, in_closed_loop(plant, params, found.chosen.law, key_run, ran))
        found = _law(plant, both, key_law, history, disturbances, static)
    warnings.warn(
        f"{plant.name} is unstable alone; {len(found.params.y)} of {len(both.y)} recorded starts can be brought back, "
        f"and {len(both.y) - len(opened.y)} of {episodes} episodes under the LQ law stayed within bounds",
        IdentificationWarning,
        stacklevel=2,
    )
    return found


def in_closed_loop(plant: Plant, params: Any, law: LinearLaw, key: chex.PRNGKey, episodes: int) -> Record:
    """Episodes under a law and a dither; those that leave the plant's bounds are left out.

    Half of them begin at rest, where little is known of the plant until r~ has moved it; the others as in training.

    Starts that are hard to hold are among those under random r~; more of them would outweigh how well y follows.

    Args:
        plant, params, law, key: the loop; all random numbers.
        episodes: to run.
    """
    begins_at_rest = jnp.arange(episodes) < episodes // 2
    closed = Record(*map(np.asarray, _closed_loop(plant, params, law, jax.random.split(key, episodes), begins_at_rest)))
    stayed = np.isfinite(within(closed, plant.divergence_bounds, 0.0).y).all(1)
    return Record(*(each[stayed] for each in closed))


def joined(one: Record, two: Record) -> Record:
    """The episodes of two records."""
    return Record(*(np.concatenate(each).astype(np.float64) for each in zip(one, two, strict=True)))


def _law(
    plant: Plant, data: Record, key: chex.PRNGKey, history: int, disturbances: Disturbances, static: LinearLaw
) -> Identified:
    """The LQ law that suits the records best, and the episodes on their model that can be brought back."""
    model = fit(plant, data, history)
    replayed = continued(plant, data, model)
    alive = can_be_brought_back(plant, replayed, impulse_response(model, plant.episode_steps))
    dead = int(np.argmax(np.abs(model.b) > NEGLIGIBLE * np.abs(model.b).max()))
    about = (
        f"{plant.name} is unstable alone: a deviation grows by {radius(model):.3g} in a control step, r~ acts after "
        f"{dead + 1} and lies in {plant.r_tilde_bounds}{in_words(plant.y_unit)}"
    )
    if not alive.any():
        raise ValueError(f"{about}; that brings back none of the {len(data.y)} recorded starts")
    numbers = [np.repeat(each[None], alive.sum(), 0) for each in (model.a, model.b)]
    known = [each[alive] for each in (replayed.r_tilde, replayed.y, replayed.y)]
    params = CounterfactualParams(*(jnp.asarray(each, float) for each in (*numbers, *known)))
    found = lq.choose(
        plant,
        [data],
        static,
        key,
        history,
        disturbances,
        models=[resting(plant, model)],
        prices=PRICES,
        lags=[history],  # laws with more bring back fewer starts
    )
    if found.settings is None:
        raise ValueError(f"{about}; no linear law that was tried holds it")
    return Identified(found, params)


def fit(plant: Plant, data: Record, n: int) -> Model:
    """A model of n lags, fitted as if y were noisier, so that noise does not hide its growth."""
    ((a, b),) = lq.fits(data, n, [NOISE * float(np.ptp(plant.setpoint_range)) / 2], levels=False)
    k = np.arange(n - 1, data.r_tilde.shape[1])
    past = k[:, None] - np.arange(n)
    residual = data.y[:, k + 1] - data.y[:, past] @ a - data.r_tilde[:, past] @ b
    return Model(a, b, np.nanmean(residual), np.nanstd(residual))


def resting(plant: Plant, model: Model) -> CounterfactualParams:
    """An episode in which the model rests in the middle of the set-point range."""
    middle, steps = sum(plant.setpoint_range) / 2, plant.episode_steps
    r_tilde = (middle * (1.0 - model.a.sum()) - model.c) / model.b.sum()
    y = np.full((1, steps + 1), middle)
    episode = model.a[None], model.b[None], np.full((1, steps), r_tilde), y, y
    return CounterfactualParams(*(jnp.asarray(each, float) for each in episode))


def continued(plant: Plant, data: Record, model: Model) -> Record:
    """What the recorded episodes would have been under an LQ law of the model without bounds of r~.

    Until y is unknown (nan), it is the recorded one plus the model's response to the difference of r~; then it is the
    model's alone. Episodes that are unknown before the model has its past are left out.
    """
    n, steps = len(model.a), data.r_tilde.shape[1]
    last = np.where(np.isnan(data.y).any(1), np.isnan(data.y).argmax(1) - 1, steps)  # of the known y
    y, r_tilde, last = (each[last >= n] for each in (data.y, data.r_tilde, last))
    law = LinearLaw(*map(np.asarray, lq.law_for(plant, model.a, model.b, 1.0)))  # type: ignore[arg-type]
    middle = sum(plant.setpoint_range) / 2
    y_new, r_tilde_new = np.repeat(y[:, :1], steps + 1, 1), np.zeros_like(r_tilde)
    y_past = np.repeat(y[:, :1], n, 1)
    r_tilde_past = np.clip(y_past, *plant.r_tilde_bounds)
    dy, dr_tilde = np.zeros((2, len(y), n))  # differences to the record, newest first
    for k in range(steps):
        now = y_new[:, k]
        moved = (y_past - now[:, None]) @ law.y_past + r_tilde_past @ law.r_tilde_past
        r_tilde_new[:, k] = law.r * middle + law.y * now + moved
        dy, dr_tilde = _pushed(dy, now - y[:, k]), _pushed(dr_tilde, r_tilde_new[:, k] - r_tilde[:, k])
        y_past, r_tilde_past = _pushed(y_past, now), _pushed(r_tilde_past, r_tilde_new[:, k])
        of_record = y[:, k + 1] + dy @ model.a + dr_tilde @ model.b
        of_model = model.c + y_past @ model.a + r_tilde_past @ model.b
        y_new[:, k + 1] = np.where(k < last, of_record, of_model)
    return Record(r_tilde_new, y_new)


def _pushed(past: np.ndarray, new: np.ndarray) -> np.ndarray:
    """The past (E, n), newest first, one step later."""
    return np.column_stack([new, past[:, :-1]])


def can_be_brought_back(plant: Plant, episodes: Record, response: np.ndarray) -> np.ndarray:
    """Whether some r~ within its bounds would have had y within its own late in an episode; (episodes,).

    A linear programme for each episode, of a plant that is linear but for the bounds.

    Args:
        plant: as declared.
        episodes: under any r~, without bounds.
        response: of y to a unit of r~ in the control step before the first; (T,).
    """
    steps = episodes.r_tilde.shape[1]
    late = np.arange(steps - max(1, round(LATE * steps)), steps)
    at = late[:, None] - np.arange(steps)
    moved = np.where(at >= 0, response[np.maximum(at, 0)], 0.0)  # (late, steps), of y_(k+1) by r~
    low, high = plant.divergence_bounds
    unit = np.abs(moved).max(1, keepdims=True)  # the solver's tolerances are absolute
    found = []
    for r_tilde, y in zip(episodes.r_tilde, episodes.y, strict=True):
        free = y[late + 1] - moved @ r_tilde
        program = scipy.optimize.linprog(
            np.zeros(steps),
            A_ub=np.concatenate([moved, -moved]) / np.concatenate([unit, unit]),
            b_ub=np.concatenate([high - free, free - low]) / np.concatenate([unit, unit])[:, 0],
            bounds=plant.r_tilde_bounds,
            method="highs",
        )
        found.append(program.status == 0)
    return np.array(found, bool)


class Dithered(NamedTuple):
    """Parameters of a law with a dither."""

    law: LinearLaw
    dither: jax.Array  # (T,), in the unit of r~


@dataclass(frozen=True)
class WithDither:
    """A base law to whose r~ a dither is added; its past holds what was applied."""

    linear: Linear
    host: bool = False

    def init(self, params: Dithered, r0: jax.Array, y0: jax.Array) -> tuple[Past, jax.Array]:
        """As that of the law."""
        return self.linear.init(params.law, r0, y0), jnp.zeros((), jnp.int32)

    def act(
        self, params: Dithered, carry: tuple[Past, jax.Array], r: jax.Array, y: jax.Array, key: Any = None
    ) -> tuple[tuple[Past, jax.Array], jax.Array]:
        """The law's r~ plus the dither, clipped."""
        past, k = carry
        _, r_tilde = self.linear.act(params.law, past, r, y, key)
        r_tilde = jnp.clip(r_tilde + params.dither[k], *self.linear.r_tilde_bounds)
        return (past.then(y, r_tilde), k + 1), r_tilde


@partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
def _closed_loop(
    plant: Plant, params: Any, law: LinearLaw, keys: chex.PRNGKey, at_rest: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """r~ (episodes, T) and y (episodes, T + 1) under a law and a dither, with set-points over most of the range."""
    policy, steps = WithDither(Linear(plant.r_tilde_bounds)), plant.episode_steps
    size = DITHER * np.ptp(plant.r_tilde_bounds) / 2
    low, high = plant.setpoint_range
    edge = (1.0 - INSIDE) / 2 * (high - low)

    def episode(key: chex.PRNGKey, at_rest: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_r, key_dither, key_start, key_run = jax.random.split(key, 4)
        r = redrawn(key_r, steps, low + edge, high - edge)
        dithered = Dithered(law, telegraph(key_dither, steps, -size, size, RATE))
        starts = plant.init(key_start, params), plant.training_start(key_start, params)
        begun = closed_loop.begin(plant, params, jax.tree.map(partial(jnp.where, at_rest), *starts))

        def step(carry: Any, x: Any) -> Any:
            state, memory = carry
            after, memory, *_ = closed_loop.step(
                plant, params, rewards.params(plant), policy, dithered, state, memory, x[0], x[1]
            )
            return (after, memory), (after.r_tilde, after.y)

        begin = begun, policy.init(dithered, r[0], begun.y)
        _, (r_tilde, y) = jax.lax.scan(step, begin, (r, jax.random.split(key_run, steps)))
        return r_tilde, jnp.concatenate([begun.y[None], y])

    return jax.vmap(episode)(keys, at_rest)
