"""`oracle`, the limit: the learner's own actor and observation, trained through the simulator on the return itself.

The plants are differentiable, so the gradient of the return is computed by back-propagation through whole episodes of
the training distribution (analytic policy gradient). What this policy reaches is what the observation and the network
allow; what the learner lacks to it, it lacks by learning. It reads the plant's equations, which no outer loop can.

The first layer is trained in whitened coordinates of the observation and folded back: consecutive samples of y differ
little, and the small differences are what tells the state of the plant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.traverse_util import flatten_dict, unflatten_dict

from jaxouter.evaluation.cache import Tuned
from jaxouter.evaluation.rivals.tuning import Report, set_points
from jaxouter.loop import rewards
from jaxouter.loop.identify import LEVELS, static
from jaxouter.loop.policy import AffineParams, Policy
from jaxouter.plants import Plant
from jaxouter.training.config import preset
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from jaxouter.training.trainer import build as build_trainer

SEEDS = 3
BATCH = 64  # episodes a gradient step and seed
FIRST_STAGE = 1000  # gradient steps; each stage then doubles their number
STAGES = 3
ENOUGH = 0.01  # relative gain of the return by doubling, below which training ends
CHUNK = 50  # gradient steps between two reports
RATE, CLIP = 3e-3, 1.0
VALIDATION = 512  # training episodes on which the best seed is chosen
FLOOR = 1e-2  # of the standard deviations by which the observation is whitened


class Whitening(NamedTuple):
    """(obs - mean) @ matrix has nearly unit covariance."""

    mean: jax.Array  # (n,)
    matrix: jax.Array  # (n, n)


@dataclass(frozen=True)
class Teacher:
    """Episodes of the training distribution, as a differentiable function. Static and hashable."""

    plant: Plant
    policy: LearnedPolicy

    def episode(self, policy: Policy, policy_params: Any, plant_params: Any, key: chex.PRNGKey) -> Any:
        """One episode: mean reward a step, and the policy's carries (T, ...) with r and y (T,)."""
        plant, steps = self.plant, self.plant.episode_steps
        key_draw, key_start, key_r, key_run, key_quiet = jax.random.split(key, 5)
        plant_params = plant_params if plant.draw is None else plant.draw(key_draw, plant_params)
        quiet = jax.random.bernoulli(key_quiet)
        plant_params = jax.tree.map(partial(jnp.where, quiet), plant.noise_free(plant_params), plant_params)
        price = rewards.params(plant)
        r = set_points(key_r, plant, steps)
        state = plant.training_start(key_start, plant_params)
        y = plant.output(plant_params, state)

        def step(loop: Any, x: Any) -> Any:
            state, carry, y, before = loop
            r_k, key = x
            after, r_tilde = policy.act(policy_params, carry, r_k, y)
            state = plant.step(plant_params, state, r_tilde, key)
            y_next = plant.output(plant_params, state)
            reward = rewards.reward(price, r_k, y_next, y, r_tilde, before)
            return (state, after, y_next, r_tilde), (reward, carry, r_k, y)

        begin = (state, policy.init(policy_params, r[0], y), y, jnp.clip(y, *plant.r_tilde_bounds))
        _, (reward, *seen) = jax.lax.scan(step, begin, (r, jax.random.split(key_run, steps)))
        return jnp.mean(reward), seen

    @partial(jax.jit, static_argnums=0)
    def whitening(self, prior: AffineParams, plant_params: Any, key: chex.PRNGKey) -> Whitening:
        """From the observations under an actor whose action is zero."""
        zero = jax.tree.map(jnp.zeros_like, self.policy.learner.init(key).actor)

        def observed(key: chex.PRNGKey) -> jax.Array:
            _, seen = self.episode(self.policy, LearnedParams(zero, prior), plant_params, key)
            return jax.vmap(lambda carry, r, y: self.policy.observer.observe(carry, r, y)[1])(*seen)

        obs = jax.vmap(observed)(jax.random.split(key, BATCH)).reshape(-1, self.policy.observer.size)
        variance, axes = jnp.linalg.eigh(jnp.cov(obs, rowvar=False))
        return Whitening(obs.mean(0), (axes / jnp.sqrt(jnp.maximum(variance, 0.0) + FLOOR**2)[None]) @ axes.T)

    @partial(jax.jit, static_argnums=0)
    def returns(self, actors: Any, prior: AffineParams, plant_params: Any, key: chex.PRNGKey) -> jax.Array:
        """Mean return of each actor (seeds, ...) on `VALIDATION` episodes of the training distribution; (seeds,)."""

        def mean(actor: Any) -> jax.Array:
            keys = jax.random.split(key, VALIDATION)
            each = jax.vmap(lambda key: self.episode(self.policy, LearnedParams(actor, prior), plant_params, key)[0])
            return jnp.mean(each(keys)) * self.plant.episode_steps

        return jax.lax.map(mean, actors)

    @partial(jax.jit, static_argnums=0)
    def train(
        self, carry: Any, white: Whitening, prior: AffineParams, plant_params: Any, rates: jax.Array, key: chex.PRNGKey
    ) -> Any:
        """Gradient steps with the given rates (n,), on fresh episodes each.

        Args:
            carry: whitened actors and optimiser state, each leaf (seeds, ...).
            white, prior, plant_params: the same for all seeds.
            rates: learning rates.
            key: episodes, the same for all seeds.
        """

        def loss(actor: Any, keys: chex.PRNGKey) -> jax.Array:
            params = LearnedParams(folded(actor, white), prior)
            return -jnp.mean(jax.vmap(lambda key: self.episode(self.policy, params, plant_params, key)[0])(keys))

        def update(actor: Any, state: Any, rate: jax.Array, keys: chex.PRNGKey) -> Any:
            with jax.numpy_dtype_promotion("standard"):  # optax's Adam raises a float to an integer power
                step, state = ADAM.update(jax.grad(loss)(actor, keys), state)
            return jax.tree.map(lambda p, s: p - rate * s, actor, step), state

        def step(carry: Any, x: Any) -> tuple[Any, None]:
            rate, key = x
            keys = jax.random.split(key, BATCH)
            return jax.vmap(update, (0, 0, None, None))(carry[0], carry[1], rate, keys), None

        return jax.lax.scan(step, carry, (rates, jax.random.split(key, len(rates))))[0]


ADAM = optax.chain(optax.clip_by_global_norm(CLIP), optax.scale_by_adam())


def folded(actor: Any, white: Whitening) -> Any:
    """The actor in terms of the observation, from one whose first layer takes the whitened one."""
    layers = actor["params"]
    first = min(layers)
    kernel = white.matrix @ layers[first]["kernel"]
    bias = layers[first]["bias"] - white.mean @ kernel
    return {"params": layers | {first: {"kernel": kernel, "bias": bias}}}


def teacher(plant: Plant) -> tuple[Teacher, Any]:
    """The teacher with the actor of the plant's `default` preset, and the nominal parameters of the plant."""
    trainer, env = build_trainer(preset(plant.name))
    return Teacher(plant, trainer.policy), env.plant


def tune(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    """Train three seeds in stages, each twice as long as all before, until a stage gains less than 1 %; the best seed.

    `budget` is no bound: the oracle may take what it needs.
    """
    del budget
    school, _ = teacher(plant)
    key_static, key_white, key_seeds, key_run, key_test = jax.random.split(key, 5)
    _, prior = static(plant, params, key_static)
    white = school.whitening(prior, params, key_white)
    actors = jax.vmap(lambda key: school.policy.learner.init(key).actor)(jax.random.split(key_seeds, SEEDS))
    fold = jax.jit(jax.vmap(folded, (0, None)))
    stages: list[np.ndarray] = []  # returns (seeds,) after each
    best, gradient_steps = actors, 0
    for stage in range(STAGES):
        length = FIRST_STAGE * 2 ** max(0, stage - 1)  # 1000, 1000, 2000: each doubles what there is
        rates = RATE * (1.0 + np.cos(np.pi * np.arange(length) / length)) / 2
        carry = actors, jax.vmap(ADAM.init)(actors)
        for i in range(0, length, CHUNK):
            key_run, key_chunk = jax.random.split(key_run)
            carry = school.train(carry, white, prior, params, jnp.asarray(rates[i : i + CHUNK], float), key_chunk)
            jax.block_until_ready(carry)
            report(f"stage {stage + 1}, gradient step {gradient_steps + i + CHUNK}")
        actors, gradient_steps = carry[0], gradient_steps + length
        stages.append(np.asarray(school.returns(fold(actors, white), prior, params, key_test)))
        so_far = [values.max() for values in stages]
        if so_far[-1] == max(so_far):
            best = jax.tree.map(lambda leaf: leaf[stages[-1].argmax()], fold(actors, white))
        if stage and so_far[-1] - max(so_far[:-1]) < ENOUGH * abs(so_far[-1]):
            break
    arrays = {"/".join(path): np.asarray(leaf) for path, leaf in flatten_dict(best).items()}
    settings = {
        "slope": float(prior.slope),
        "offset": float(prior.offset),
        "gradient_steps": gradient_steps,
        "returns": [values.round(3).tolist() for values in stages],
    }
    steps = (SEEDS * gradient_steps * BATCH + LEVELS) * plant.episode_steps
    return Tuned(settings, arrays, steps)


def build(plant: Plant, tuned: Tuned) -> tuple[LearnedPolicy, LearnedParams]:
    """The policy from what `tune` found."""
    actor = unflatten_dict({tuple(name.split("/")): jnp.asarray(leaf) for name, leaf in tuned.arrays.items()})
    prior = AffineParams(*(jnp.asarray(tuned.settings[name], float) for name in ("slope", "offset")))
    return teacher(plant)[0].policy, LearnedParams(actor, prior)
