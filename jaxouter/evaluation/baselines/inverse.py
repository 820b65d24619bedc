"""`inverse`: a network learned as the inverse of the loop, after Zhou, Helwa & Schoellig (arXiv 1705.10932).

From recorded data it learns (past y, past r~, y_(t+h)) -> r~_t, and is asked for y_(t+h) = r_t.

Departures from the paper: there the state of the loop is measured, the desired output h steps ahead is known, and h is
the loop's relative degree. Here the state is replaced by past y and r~, there is no preview, so that y comes h steps
late, and h is tuned: a larger one asks for less and is better conditioned. The network is the learner's actor, in its
own observation with y_(t+h) for r and without the integral; its output is r~ over half its range.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.traverse_util import flatten_dict, unflatten_dict

from jaxouter.agents.adam import adam, descend
from jaxouter.agents.networks import Actor
from jaxouter.evaluation.baselines.tuning import Report, learner, learners_episodes, score
from jaxouter.evaluation.cache import Tuned
from jaxouter.identification import dynamics, records
from jaxouter.identification.records import Record
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.loop.observation import Memory, Observer
from jaxouter.plants import Plant

HIDDEN = (128, 128)
BATCH, UPDATES, RATE = 256, 6_000, 2e-3
NOISE = 1  # folded into a key
CANDIDATES = 8  # values of h tried, geometric from 1 to a quarter of an episode


@dataclass(frozen=True)
class Inverse:
    """r~ for which y would be r, h steps ahead."""

    observer: Observer
    hidden: tuple[int, ...] = HIDDEN
    host: bool = False

    def wanted(self, params: Any, memory: Memory, target: jax.Array, y: jax.Array) -> jax.Array:
        """Network: r~ over half its range, before it is clipped, from the memory at t, y_t and y_(t+h)."""
        return Actor(self.hidden, 1).apply(params, self.observer.features(memory, target, y))[0]  # pyright: ignore

    def init(self, params: Any, r0: jax.Array, y0: jax.Array) -> Memory:
        """Memory before the first step."""
        del params
        return self.observer.init(r0, y0)

    def act(
        self, params: Any, carry: Memory, r: jax.Array, y: jax.Array, key: chex.PRNGKey | None = None
    ) -> tuple[Memory, jax.Array]:
        """Ask the network for r."""
        del key
        low, high = self.observer.r_tilde_bounds
        carry = carry._replace(integral=jnp.zeros_like(y))
        r_tilde = jnp.clip((low + high) / 2 + (high - low) / 2 * self.wanted(params, carry, r, y), low, high)
        return self.observer.record(carry, y, r_tilde), r_tilde


@partial(jax.jit, static_argnums=0)
def fit(policy: Inverse, r_tilde: jax.Array, y: jax.Array, h: jax.Array, key: chex.PRNGKey) -> Any:
    """Network parameters that minimise the squared error of r~ on a record, by Adam.

    Args:
        policy: the network and its observation.
        r_tilde: (episodes, T).
        y: (episodes, T + 1).
        h: steps ahead, int; traced, so that all candidates share a compilation.
        key: initialisation and batches.
    """
    episodes, steps = r_tilde.shape
    H, (low, high) = policy.observer.history, policy.observer.r_tilde_bounds
    scaled = (r_tilde - (low + high) / 2) / ((high - low) / 2)
    key_init, key_batches = jax.random.split(key)
    params = Actor(policy.hidden, 1).init(key_init, jnp.zeros(policy.observer.size))
    optimiser = adam(optax.cosine_decay_schedule(RATE, UPDATES))

    def error(params: Any, episode: jax.Array, t: jax.Array) -> jax.Array:
        back = t - jnp.arange(1, H + 1)
        memory = Memory(y[episode, back], r_tilde[episode, back], jnp.zeros(()))
        return (policy.wanted(params, memory, y[episode, t + h], y[episode, t]) - scaled[episode, t]) ** 2

    def update(carry: tuple[Any, Any], key: chex.PRNGKey) -> tuple[tuple[Any, Any], None]:
        params, state = carry
        key_episode, key_t = jax.random.split(key)
        episode = jax.random.randint(key_episode, (BATCH,), 0, episodes)
        t = H + jnp.floor(jax.random.uniform(key_t, (BATCH,)) * (steps + 1 - H - h)).astype(episode.dtype)
        gradient = jax.grad(lambda p: jnp.mean(jax.vmap(error, (None, 0, 0))(p, episode, t)))(params)
        return descend(optimiser, gradient, state, params), None

    return jax.lax.scan(update, (params, optimiser.init(params)), jax.random.split(key_batches, UPDATES))[0][0]


def tune(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    """Fit a network for each candidate h on as long a record as the budget allows; keep that of the greatest return."""
    key_record, key_fit, key_episodes = jax.random.split(key, 3)
    key_noise = jax.random.fold_in(key, NOISE)
    history, explored = dynamics.suitable_history(plant, params, key_record)
    episodes = learners_episodes(plant, params, key_episodes)
    tried = sorted({round(h) for h in np.geomspace(1, plant.episode_steps / 4, CANDIDATES)})
    spent = explored + len(tried) * episodes.r.size
    data = records.record(plant, params, key_record, (budget - spent) // plant.episode_steps)
    data = data._replace(y=data.y + _noise(plant, data, key_noise))
    policy = Inverse(Observer.of(plant, history))
    best: tuple[float, int, Any] | None = None
    for i, h in enumerate(tried):
        found = fit(policy, *(jnp.asarray(part, float) for part in data), jnp.asarray(h), key_fit)
        value = score(policy, found, episodes)
        report(f"{i + 1} of {len(tried)} horizons", (i + 1) / len(tried))
        best = (value, h, found) if best is None or value > best[0] else best
    assert best is not None
    arrays = {"/".join(path): np.asarray(leaf) for path, leaf in flatten_dict(best[2]).items()}
    return Tuned({"h": best[1], "updates": UPDATES, "history": history}, arrays, data.r_tilde.size + spent)


def _noise(plant: Plant, data: Record, key: chex.PRNGKey) -> np.ndarray:
    """The measurement noise of the learner's episodes, for a record."""
    episodes = TrainingEpisodes(plant, learner(plant).disturbances)
    keys, steps = jax.random.split(key, len(data.y)), data.y.shape[1]
    return np.asarray(jax.vmap(lambda key: episodes.noises(key, steps))(keys), np.float64)


def build(plant: Plant, tuned: Tuned) -> tuple[Inverse, Any]:
    """The policy from what `tune` found."""
    params = unflatten_dict({tuple(name.split("/")): jnp.asarray(leaf) for name, leaf in tuned.arrays.items()})
    return Inverse(Observer.of(plant, tuned.settings["history"])), params
