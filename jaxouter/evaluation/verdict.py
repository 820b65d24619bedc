"""Whether what was learned is better than doing nothing, told on training episodes that it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from msgspec import Struct

from jaxouter.evaluation.baselines.tuning import EPISODES, training_episodes
from jaxouter.evaluation.rollout import outputs
from jaxouter.loop.policy import LinearLaw
from jaxouter.plants import Plant
from jaxouter.plants.base import RUN_ONCE
from jaxouter.training.policy import LearnedParams, LearnedPolicy

ON_HOST = 4  # episodes of a plant that is simulated elsewhere, and may be slow


class Verdict(Struct, frozen=True):
    """The learned policies beside affine ones, on fresh training episodes."""

    episodes: int
    mae: dict[str, float | dict[str, float | None] | None]  # by name, `learned` by seed; None where diverged
    worse: list[int]  # seeds that are not the best
    text: str  # for people


def judge(
    plant: Plant,
    params: Any,
    key: chex.PRNGKey,
    policy: LearnedPolicy,
    learned: Mapping[int, LearnedParams],
    simple: Mapping[str, LinearLaw],
) -> Verdict:
    """MAE of the learned policies, by seed, and of affine ones, by name, on fresh training episodes.

    Args:
        plant, params: of the training distribution.
        key: of the episodes, of which training has seen none.
        policy: of all seeds.
        learned, simple: what is compared.
    """
    count = EPISODES if plant.differentiable else ON_HOST
    idle = jax.tree.map(
        jnp.zeros_like, next(iter(learned.values())).actor
    )  # its action is zero: what is left is affine

    def of(policy_params: LearnedParams) -> float:
        strong = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), policy_params)  # else compiled for anew
        value = float(_mean_error(plant, policy, count, params, strong, key))
        return value if np.isfinite(value) else np.inf

    found = {name: of(LearnedParams(idle, affine)) for name, affine in simple.items()}
    of_seeds = {seed: of(each) for seed, each in learned.items()}
    best = min(found, key=lambda name: found[name])
    worse = [seed for seed, value in of_seeds.items() if not value <= found[best] or np.isinf(value)]
    mae = {name: _finite(value) for name, value in found.items()}
    by_seed = {str(seed): _finite(value) for seed, value in of_seeds.items()}
    text = _text(found, of_seeds, best, worse, count, plant.y_unit)
    return Verdict(count, {**mae, "learned": by_seed}, worse, text)


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=RUN_ONCE)
def _mean_error(
    plant: Plant, policy: LearnedPolicy, count: int, params: Any, policy_params: LearnedParams, key: chex.PRNGKey
) -> jax.Array:
    episodes = training_episodes(plant, params, key, count)
    return jnp.mean(jnp.abs(episodes.r - outputs(policy, policy_params, episodes)))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _text(
    found: Mapping[str, float], of_seeds: Mapping[int, float], best: str, worse: list[int], count: int, unit: str
) -> str:
    def told(value: float) -> str:
        return f"{value:.3g}" if np.isfinite(value) else "diverged"

    unit = "" if unit in ("", "1") else f" in {unit}"
    others = ", ".join(f"{name} {told(value)}" for name, value in found.items())
    ours = ", ".join(told(of_seeds[seed]) for seed in (worse or of_seeds))
    on = f"on {count} fresh training episodes"
    if not worse:
        return f"verdict: {on} what was learned is the best; MAE{unit}: learned {ours}, {others}"
    which = "" if len(of_seeds) == 1 else f" by seed {', '.join(map(str, worse))}"
    return (
        f"verdict: {on} what was learned{which} is worse than {best}; MAE{unit}: learned {ours}, {others}. Use {best} "
        "in its place, or train otherwise; export asks for --force"
    )
