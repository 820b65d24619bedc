"""A start for the learner: its actor, trained by back-propagation through whole episodes (analytic policy gradient).

`Teacher` takes any differentiable plant. `pretrain` gives it one that was identified from a record of r~ and y alone;
the oracle gives it the plant itself.

The first layer is trained in whitened coordinates of the observation and folded back: consecutive samples of y differ
little, and the small differences are what tells the state of the plant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax

from jaxouter.loop import counterfactual, identify, rewards
from jaxouter.loop.policy import AffineParams, Policy
from jaxouter.loop.references import redrawn
from jaxouter.plants import Plant
from jaxouter.training.config import PretrainingConfig
from jaxouter.training.policy import LearnedParams, LearnedPolicy

RATE, CLIP = 3e-3, 1.0  # learning rate at first; bound of the gradient's norm
CHUNK = 50  # gradient steps between two reports
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
    batch: int = 64
    """Episodes a gradient step (and seed)."""

    def episode(self, policy: Policy, policy_params: Any, plant_params: Any, key: chex.PRNGKey) -> Any:
        """One episode: mean reward a step, and the policy's carries (T, ...) with r and y (T,)."""
        plant, steps = self.plant, self.plant.episode_steps
        key_draw, key_start, key_r, key_run, key_quiet = jax.random.split(key, 5)
        plant_params = plant_params if plant.draw is None else plant.draw(key_draw, plant_params)
        quiet = jax.random.bernoulli(key_quiet)
        plant_params = jax.tree.map(partial(jnp.where, quiet), plant.noise_free(plant_params), plant_params)
        price = rewards.params(plant)
        r = redrawn(key_r, steps, *plant.setpoint_range)
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

        obs = jax.vmap(observed)(jax.random.split(key, self.batch)).reshape(-1, self.policy.observer.size)
        variance, axes = jnp.linalg.eigh(jnp.cov(obs, rowvar=False))
        return Whitening(obs.mean(0), (axes / jnp.sqrt(jnp.maximum(variance, 0.0) + FLOOR**2)[None]) @ axes.T)

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
            keys = jax.random.split(key, self.batch)
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


def cosine(steps: int) -> jax.Array:
    """Learning rates (steps,), falling to zero along a cosine."""
    return RATE * (1.0 + jnp.cos(jnp.pi * jnp.arange(steps, dtype=float) / steps)) / 2


def pretrain(
    config: PretrainingConfig,
    plant: Plant,
    plant_params: Any,
    policy: LearnedPolicy,
    prior: AffineParams,
    key: chex.PRNGKey,
    report: Callable[[int], None] = lambda done: None,
) -> Any:
    """The actor after so many gradient steps on a plant that is identified from recorded episodes.

    Args:
        config: how many of both.
        plant, plant_params: only recorded from, through r~ and y.
        policy: gives the actor its shape.
        prior: of the policy.
        key: random numbers.
        report: called with the gradient steps done (progress).
    """
    key_record, key_white, key_actor, key_run = jax.random.split(key, 4)
    model = counterfactual.fit(identify.record(plant, plant_params, key_record, config.episodes), config.lags)
    school = Teacher(counterfactual.plant(plant, config.lags), policy, config.batch_size)
    white = school.whitening(prior, model, key_white)
    actors = jax.tree.map(lambda leaf: leaf[None], policy.learner.init(key_actor).actor)
    carry = actors, jax.vmap(ADAM.init)(actors)
    rates = cosine(config.gradient_steps)
    for begin in range(0, config.gradient_steps, CHUNK):
        chunk = rates[begin : begin + CHUNK]
        carry = school.train(carry, white, prior, model, chunk, jax.random.fold_in(key_run, begin))
        jax.block_until_ready(carry)
        report(begin + len(chunk))
    return folded(jax.tree.map(lambda leaf: leaf[0], carry[0]), white)
