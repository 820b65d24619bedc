"""Model-based pretraining: train the actor by back-propagation through whole episodes (analytic policy gradient).

`DifferentiableRollout` takes any differentiable plant. Training passes a model identified from recorded r~ and y alone;
the baseline `oracle` passes the plant itself.

The first layer is trained on whitened observations (`jaxouter.agents.whitening`), and the whitening is then folded into
it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from jaxouter.agents.whitening import Whitening
from jaxouter.identification import counterfactual, records
from jaxouter.identification.records import Record
from jaxouter.loop.bank import BaseLaw
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.plants import Plant
from jaxouter.plants.base import RUN_ONCE
from jaxouter.training.config import PretrainingConfig
from jaxouter.training.policy import LearnedParams, LearnedPolicy

RATE = 3e-3  # initial learning rate
CLIP = 0.1  # bound on the gradient's norm; lower than usual, so that a batch with an unstable loop counts no more
CHUNK = 50  # gradient steps between two reports
LAST, COLLAPSED = 5, 2.0  # the loop has become unstable if the last 5 steps' mean cost is twice the best one
SHORT = 1 / 3  # first share of the gradient steps, with episodes no longer than the plant's
CUT, GROWTH = 0.5, 1.25  # factors on the learning rate after a chunk that became unstable, and after one that did not
EPISODES = "episodes"  # axis over which devices share the episodes


class PretrainingState(NamedTuple):
    """State of a pretraining: everything that its next gradient steps depend on."""

    before: Any  # whitened actors and optimiser state, each leaf (1, ...), one report ago
    now: Any  # the current ones
    best: Any  # best mean reward
    rate_scale: Any  # factor on the learning rate of the next steps, at most 1
    done: Any  # int32, gradient steps so far

    @classmethod
    def begin(cls, actor: Any) -> PretrainingState:
        """State before the first step, from an actor whose first layer takes the whitened observation."""
        actors = jax.tree.map(lambda leaf: leaf[None], actor)
        carry = actors, jax.vmap(ADAM.init)(actors)
        return cls(carry, carry, jnp.asarray(-np.inf, float), jnp.ones((), float), np.int32(0))


Report = Callable[[PretrainingState, Callable[[], Any]], None]
"""`report(at, actor)`: called now and then with the state of the pretraining, and a function that gives its actor."""
Say = Callable[[str, int, int], None]
"""`say(what, done, of)`: called with the phase ("recording", "compiling") and its progress; 0 of 0 if unknown."""


@dataclass(frozen=True)
class DifferentiableRollout:
    """Training episodes as a differentiable function. Static and hashable."""

    episodes: TrainingEpisodes
    policy: LearnedPolicy
    batch: int = 64
    """Episodes per gradient step (and seed)."""
    log_above: float = 0.0
    """c > 0: a cost per step counts as c log(1 + cost / c); 0: it counts in full."""
    devices: int = 1
    """Devices of this process that share the episodes of a gradient step evenly."""

    @classmethod
    def of(
        cls,
        config: PretrainingConfig,
        episodes: TrainingEpisodes,
        policy: LearnedPolicy,
        batch: int,
        devices: int = 1,
    ) -> DifferentiableRollout:
        """The roll-out as configured, on as many of the devices as can share a batch evenly."""
        return cls(episodes, policy, batch, config.log_above, math.gcd(batch, devices))

    @property
    def plant(self) -> Plant:
        """The plant."""
        return self.episodes.plant

    def mean_reward(self, params: LearnedParams, plant_params: Any, key: chex.PRNGKey) -> jax.Array:
        """Mean reward per step of one episode, in error scales."""
        return jnp.mean(self.episodes.run(self.policy, params, plant_params, key).reward / self.plant.error_scale)

    @partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
    def whitening(self, base: BaseLaw, plant_params: Any, key: chex.PRNGKey) -> Whitening:
        """Whitening of the observations under a zero action."""
        zero = jax.tree.map(jnp.zeros_like, self.policy.init_actor(key))

        def observed(key: chex.PRNGKey) -> jax.Array:
            seen = self.episodes.run(self.policy, LearnedParams(zero, base), plant_params, key)
            return jax.vmap(lambda memory, r, y: self.policy.observe(base, memory, r, y)[1])(
                seen.memory, seen.r, seen.y_seen
            )

        obs = jax.vmap(observed)(jax.random.split(key, self.batch)).reshape(-1, self.policy.observer.size)
        return Whitening.of(obs)

    @partial(jax.jit, static_argnums=0)
    def train(
        self,
        carry: Any,
        white: Whitening,
        base: BaseLaw,
        plant_params: Any,
        rates: jax.Array,
        key: chex.PRNGKey,
    ) -> tuple[Any, jax.Array]:
        """Gradient steps with the given rates (n,), each on fresh episodes.

        Args:
            carry: whitened actors and optimiser state, each leaf (seeds, ...).
            white, base, plant_params: the same for all seeds.
            rates: learning rates.
            key: for the episodes, which are the same for all seeds.

        Returns:
            carry, and the mean reward before each step, with `log_above` applied (n, seeds).
        """

        def loss(actor: Any, keys: chex.PRNGKey) -> jax.Array:
            params = LearnedParams(white.folded(actor), base)
            cost = jax.vmap(lambda key: -self.mean_reward(params, plant_params, key))(keys)
            return jnp.mean(self.log_above * jnp.log1p(cost / self.log_above) if self.log_above else cost)

        def update(actor: Any, state: Any, rate: jax.Array, keys: chex.PRNGKey) -> Any:
            cost, gradient = of_all(jax.value_and_grad(loss)(actor, keys))
            finite = jnp.isfinite(optax.tree.norm(gradient))  # if not, skip these episodes
            gradient = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradient)
            with jax.numpy_dtype_promotion("standard"):  # optax's Adam raises a float to an integer power
                step, state = ADAM.update(gradient, state)
            return (jax.tree.map(lambda p, s: p - rate * s, actor, step), state), -cost

        def step(carry: Any, x: Any) -> tuple[Any, jax.Array]:
            rate, key = x
            keys = own(jax.random.split(key, self.batch))
            return jax.vmap(update, (0, 0, None, None))(carry[0], carry[1], rate, keys)

        def steps(carry: Any, rates: jax.Array, key: chex.PRNGKey) -> tuple[Any, jax.Array]:
            return jax.lax.scan(step, carry, (rates, jax.random.split(key, len(rates))))

        def own(keys: chex.PRNGKey) -> chex.PRNGKey:
            return keys if self.devices == 1 else keys.reshape(self.devices, -1)[jax.lax.axis_index(EPISODES)]

        def of_all(found: Any) -> Any:
            return found if self.devices == 1 else jax.lax.pmean(found, EPISODES)

        if self.devices > 1:
            mesh = Mesh(np.array(jax.local_devices()[: self.devices]), (EPISODES,))
            steps = jax.shard_map(steps, mesh=mesh, in_specs=P(), out_specs=P(), check_vma=False)
        return steps(carry, rates, key)


ADAM = optax.chain(optax.clip_by_global_norm(CLIP), optax.scale_by_adam())


def cosine(steps: int) -> jax.Array:
    """Learning rates (steps,), falling to zero along a cosine."""
    return jnp.asarray(RATE * (1.0 + np.cos(np.pi * np.arange(steps) / steps)) / 2, float)


def recorded(
    config: PretrainingConfig,
    plant: Plant,
    plant_params: Any,
    key: chex.PRNGKey,
    say: Say = lambda what, done, of: None,
) -> list[Record]:
    """Recorded episodes of each of the configured plants, through r~ and y alone."""
    longer = replace(plant, episode_steps=config.episode_steps or plant.episode_steps)
    found = []
    for i, key_plant in enumerate(jax.random.split(key, config.plants)):
        say("recording", i, config.plants)
        one = plant_params if plant.draw is None else plant.draw(jax.random.fold_in(key_plant, 1), plant_params)
        found.append(records.record(longer, one, key_plant, config.episodes // config.plants))
    return found


def model_of(
    config: PretrainingConfig, plant: Plant, plant_params: Any, data: Sequence[Record], history: int
) -> tuple[Plant, Any]:
    """The differentiable plant of recorded episodes, and its parameters; a plant of identified models as it is."""
    if plant.identified:
        return plant, plant_params
    models = [counterfactual.fit(each, config.lags or history) for each in data]
    params = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *models)
    return counterfactual.plant(plant, config.lags or history), params


def pretrain(
    config: PretrainingConfig,
    episodes: TrainingEpisodes,
    plant_params: Any,
    policy: LearnedPolicy,
    learned: LearnedParams,
    keys: Sequence[chex.PRNGKey],
    report: Report = lambda at, actor: None,
    begin: PretrainingState | None = None,
    devices: int = 1,
    say: Say = lambda what, done, of: None,
) -> Any:
    """Pretrain an actor on a differentiable plant, of which each episode is a draw.

    Its correction of the base law is near zero at first. Instability may show only late in an episode, but long
    episodes help only an actor that already controls short ones, so if longer episodes than the plant's are configured,
    they come last. Gradients through an unstable loop are useless: if the loop becomes unstable, training returns to
    the state two reports ago, and continues with other episodes and half the learning rate, which grows again while all
    is well.

    Args:
        config: number of gradient steps, among others.
        episodes, plant_params: with the plant's own length of an episode.
        policy, learned: the policy and its initial parameters; the actor's first layer takes whitened observations.
        keys: two, for the whitening and for the episodes.
        report: see `Report`.
        begin: state from which to resume a pretraining with the same arguments; None: from its start.
        devices: of this process, to share the episodes of a gradient step.
        say: see `Say`.

    Returns:
        The actor's parameters, for plain observations.
    """
    key_white, key_run = keys
    base, plant = learned.base, episodes.plant
    stages = [DifferentiableRollout.of(config, episodes, policy, config.batch_size, devices)]
    longer = config.gradient_steps  # first step with longer episodes
    if (config.episode_steps or 0) > plant.episode_steps:
        longer = int(SHORT * config.gradient_steps) // CHUNK * CHUNK
        longer_plant = replace(plant, episode_steps=config.episode_steps)
        stages.append(replace(stages[0], episodes=replace(episodes, plant=longer_plant)))
    say("compiling", 0, 0)
    white = stages[0].whitening(base, plant_params, key_white)
    rates, at = cosine(config.gradient_steps), PretrainingState.begin(learned.actor) if begin is None else begin

    def actor() -> Any:
        return white.folded(jax.tree.map(lambda leaf: leaf[0], at.now[0]))

    while (done := int(at.done)) < config.gradient_steps:
        chunk, stage = at.rate_scale * rates[done : done + CHUNK], stages[done >= longer]
        if done == longer:  # longer episodes compile again
            say("compiling", 0, 0)
        found = stage.train(at.now, white, base, plant_params, chunk, jax.random.fold_in(key_run, done))
        carry, gained = jax.device_get(found)  # inputs on several devices would compile again
        gained = gained[:, 0]
        first, reached = gained[0] if np.isfinite(gained[0]) else -np.inf, gained[-LAST:].mean()
        best = first if done == longer else max(float(at.best), first)
        then = np.int32(done + len(chunk))
        if reached > COLLAPSED * best:  # both negative
            rate_scale = jnp.minimum(1.0, GROWTH * at.rate_scale)
            at = PretrainingState(at.now, carry, jnp.asarray(max(best, reached), float), rate_scale, then)
        else:
            at = PretrainingState(at.before, at.before, jnp.asarray(best, float), CUT * at.rate_scale, then)
        report(at, actor)
    return actor()
