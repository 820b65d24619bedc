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
from jaxouter.loop.bank import Bank
from jaxouter.loop.policy import LinearLaw
from jaxouter.plants import Plant
from jaxouter.plants.base import RUN_ONCE, in_words
from jaxouter.training.policy import LearnedParams, LearnedPolicy

ON_HOST = 4  # episodes of a plant that is simulated elsewhere, and may be slow


class Verdict(Struct, frozen=True):
    """The learned policies beside affine ones, on fresh training episodes."""

    episodes: int
    mae: dict[str, float | dict[str, float | None] | None]  # by name, `learned` by seed; None where diverged
    worse: list[int]  # seeds that are worse than the inner loop alone or the static prefilter
    text: str  # for people


def steps(plant: Plant) -> int:
    """Control steps for which `judge` runs each policy."""
    return (EPISODES if plant.differentiable else ON_HOST) * plant.episode_steps


def judge(
    plant: Plant,
    params: Any,
    key: chex.PRNGKey,
    policy: LearnedPolicy,
    learned: Mapping[int, LearnedParams],
    simple: Mapping[str, LinearLaw],
) -> Verdict:
    """MAE of the learned policies, by seed, and of affine ones, by name, on fresh training episodes.

    That of an episode counts as the range of the divergence bounds at most: where y may grow, how often it does so
    counts.

    Args:
        plant, params: of the training distribution.
        key: of the episodes, of which training has seen none.
        policy: of all seeds.
        learned, simple: what is compared.
    """
    count = steps(plant) // plant.episode_steps
    idle = jax.tree.map(
        jnp.zeros_like, next(iter(learned.values())).actor
    )  # its action is zero: what is left is affine

    def of(policy_params: LearnedParams) -> np.ndarray:
        strong = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), policy_params)  # else compiled for anew
        errors = np.asarray(_errors(plant, policy, count, params, strong, key), np.float64)
        return np.where(np.isfinite(errors), np.minimum(errors, np.ptp(plant.divergence_bounds)), np.inf)

    base = next(iter(learned.values())).base  # with a bank, laws of one, so that all share a compiled function
    alike = {name: base.all_of(law) if isinstance(base, Bank) else law for name, law in simple.items()}
    errors = {name: of(LearnedParams(idle, law)) for name, law in alike.items()}
    by = {seed: of(each) for seed, each in learned.items()}
    found = {name: float(each.mean()) for name, each in errors.items()}
    of_seeds = {seed: float(each.mean()) for seed, each in by.items()}
    best = min(found, key=lambda name: found[name])
    # The gate has compared it with the LQ law, by the reward, which moves of r~ have a price in.
    simplest = {name: each for name, each in errors.items() if name != "lq"}
    worse = [seed for seed, each in by.items() if any(_is_worse(each, other) for other in simplest.values())]
    mae = {name: _finite(value) for name, value in found.items()}
    by_seed = {str(seed): _finite(value) for seed, value in of_seeds.items()}
    text = _text(found, of_seeds, best, worse, count, plant.y_unit)
    return Verdict(count, {**mae, "learned": by_seed}, worse, text)


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=RUN_ONCE)
def _errors(
    plant: Plant, policy: LearnedPolicy, count: int, params: Any, policy_params: LearnedParams, key: chex.PRNGKey
) -> jax.Array:
    """MAE of each episode."""
    episodes = training_episodes(plant, params, key, count)
    return jnp.mean(jnp.abs(episodes.r - outputs(policy, policy_params, episodes)), 1)


def _is_worse(errors: np.ndarray, others: np.ndarray) -> bool:
    """Whether a policy is worse on the same episodes than another."""
    diverged, other_diverged = (not np.isfinite(each).all() for each in (errors, others))
    if diverged or other_diverged:
        return diverged
    return bool(errors.mean() > others.mean())


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _text(
    found: Mapping[str, float], of_seeds: Mapping[int, float], best: str, worse: list[int], count: int, unit: str
) -> str:
    def told(value: float) -> str:
        return f"{value:.3g}" if np.isfinite(value) else "diverged"

    unit = in_words(unit, " in {}")
    others = ", ".join(f"{name} {told(value)}" for name, value in found.items())
    ours = ", ".join(told(of_seeds[seed]) for seed in (worse or of_seeds))
    on = f"on {count} fresh training episodes"
    if not worse:
        best_of_all = max(of_seeds.values()) <= found[best]
        what = "the best" if best_of_all else f"better than none and static, but {best} has the lower MAE"
        return f"verdict: {on} what was learned is {what}; MAE{unit}: learned {ours}, {others}"
    which = "" if len(of_seeds) == 1 else f" by seed {', '.join(map(str, worse))}"
    return (
        f"verdict: {on} what was learned{which} is worse than {best}; MAE{unit}: learned {ours}, {others}. Use {best} "
        "in its place, or train differently; export asks for --force"
    )
