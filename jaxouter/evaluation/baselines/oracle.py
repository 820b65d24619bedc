"""`oracle`: a correction of the true plant's LQ law, trained through the simulator on the MAE itself.

The plants are differentiable, so the gradient of the cost is computed by back-propagation through whole episodes of the
training distribution (analytic policy gradient). The cost is the error and what y exceeds the plant's limits by, at
fifty times the reward's price: at five times it left the heaters' comfort limit in 1.6 % of the hours. The network is
the learner's, its history as long as that of the law. It reads the plant's equations, which no outer loop can. With
`lq-exact` and `mpc-exact` it is the limit.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from jaxouter.agents.whitening import Whitening
from jaxouter.evaluation.baselines import exact
from jaxouter.evaluation.baselines.tuning import Report, learner
from jaxouter.evaluation.cache import Tuned
from jaxouter.identification.steady_state import LEVELS
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.loop.policy import LinearLaw, padded
from jaxouter.loop.rewards import RewardConfig
from jaxouter.plants import Plant
from jaxouter.training.config import TrainConfig
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from jaxouter.training.pretraining import ADAM, DifferentiableRollout, cosine
from jaxouter.training.trainer import build as build_trainer

SEEDS = 3
BATCH = 64  # episodes a gradient step and seed
BASE = "base"  # of the arrays of the law, among those of the actor
FIRST_STAGE = 1000  # gradient steps; each stage then doubles their number
STAGES = 3
MOST = FIRST_STAGE * 2 ** (STAGES - 1)  # gradient steps
ENOUGH = 0.01  # relative gain of the return by doubling, below which training ends
CHUNK = 50  # gradient steps between two reports
ERROR = RewardConfig(beta_h=0.0, beta_b=0.0, delta_b=50.0)  # the error, and what is outside the limits
VALIDATION = 512  # training episodes on which the best seed is chosen


@partial(jax.jit, static_argnums=0)
def returns(
    rollout: DifferentiableRollout, actors: Any, base: LinearLaw, plant_params: Any, key: chex.PRNGKey
) -> jax.Array:
    """Minus the mean cost of each actor (seeds, ...) on `VALIDATION` episodes of training; (seeds,)."""

    def mean(actor: Any) -> jax.Array:
        keys = jax.random.split(key, VALIDATION)
        each = jax.vmap(lambda key: rollout.mean_reward(LearnedParams(actor, base), plant_params, key))
        return jnp.mean(each(keys)) * rollout.plant.episode_steps * rollout.plant.error_scale

    return jax.lax.map(mean, actors)


def differentiable(config: TrainConfig, noise: float = 0.0) -> tuple[DifferentiableRollout, Any]:
    """The roll-out with actor and disturbances of a configuration, and the parameters of its plant."""
    trainer, env = build_trainer(config)
    plant = replace(trainer.env.plant, reward_terms=())  # the limit is of what is reported
    episodes = TrainingEpisodes(plant, exact.KnownNoise.of(plant, noise), ERROR)
    return DifferentiableRollout.of(config.pretraining, episodes, trainer.policy, BATCH), env.plant


def tune(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report, noise: float = 0.0) -> Tuned:
    """`train` of the actor of the plant's `default` preset; `budget` is no bound: it may take what it needs."""
    del budget
    key_law, key_train = jax.random.split(key)
    found, history = exact.law(plant, params, key_law, noise)
    history = max(history, len(found.law.y_past))
    rollout = differentiable(_config(plant, history), noise)[0]
    trained = train(rollout, params, padded(found.law, history), key_train, report)
    return trained._replace(settings=trained.settings | {"history": history})


def _config(plant: Plant, history: int) -> TrainConfig:
    """The default preset with another history; the base law is made elsewhere."""
    return replace(learner(plant), history=history, base="static")


def train(rollout: DifferentiableRollout, params: Any, base: LinearLaw, key: chex.PRNGKey, report: Report) -> Tuned:
    """Train three seeds in stages that double what there is, until one gains less than 1 %; the best seed."""
    plant = rollout.plant
    key_white, key_seeds, key_run, key_test = jax.random.split(key, 4)
    white = rollout.whitening(base, params, key_white)
    actors = jax.vmap(lambda key: rollout.policy.init_actor(jax.random.split(key)[0]))(
        jax.random.split(key_seeds, SEEDS)
    )
    fold = jax.jit(jax.vmap(Whitening.folded, (None, 0)))
    stages: list[np.ndarray] = []  # returns (seeds,) after each
    best, gradient_steps = actors, 0
    for stage in range(STAGES):
        length = FIRST_STAGE * 2 ** max(0, stage - 1)  # 1000, 1000, 2000: each doubles what there is
        rates = cosine(length)
        carry = actors, jax.vmap(ADAM.init)(actors)
        for i in range(0, length, CHUNK):
            key_run, key_chunk = jax.random.split(key_run)
            carry, _ = rollout.train(carry, white, base, params, rates[i : i + CHUNK], key_chunk)
            jax.block_until_ready(carry)
            done = gradient_steps + i + CHUNK
            report(f"{done:,} of at most {MOST:,} gradient steps", done / MOST)
        actors, gradient_steps = carry[0], gradient_steps + length
        stages.append(np.asarray(returns(rollout, fold(white, actors), base, params, key_test)))
        so_far = [values.max() for values in stages]
        if so_far[-1] == max(so_far):
            best = jax.tree.map(lambda leaf: leaf[stages[-1].argmax()], fold(white, actors))
        if stage and so_far[-1] - max(so_far[:-1]) < ENOUGH * abs(so_far[-1]):
            break
    settings = {"gradient_steps": gradient_steps, "returns": [values.round(3).tolist() for values in stages]}
    return kept(best, base, settings, (SEEDS * gradient_steps * BATCH + LEVELS) * plant.episode_steps)


def kept(actor: Any, base: LinearLaw, settings: dict[str, Any], steps: int) -> Tuned:
    """What was found, as it is kept."""
    arrays = {"/".join(path): np.asarray(leaf) for path, leaf in flatten_dict(actor).items()}
    arrays |= {f"{BASE}/{name}": np.asarray(leaf) for name, leaf in base._asdict().items()}
    return Tuned(settings, arrays, steps)


def learned(tuned: Tuned) -> LearnedParams:
    """The policy's parameters from what was found."""
    leaves = unflatten_dict({tuple(name.split("/")): jnp.asarray(leaf, float) for name, leaf in tuned.arrays.items()})
    base = LinearLaw(**leaves.pop(BASE))
    return LearnedParams(leaves, base)


def build(plant: Plant, tuned: Tuned) -> tuple[LearnedPolicy, LearnedParams]:
    """The policy from what `tune` found."""
    return build_trainer(_config(plant, tuned.settings["history"]))[0].policy, learned(tuned)
