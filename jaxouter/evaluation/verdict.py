"""Whether what was learned is better than doing nothing, told on training episodes that it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import chex
import numpy as np

from jaxouter.evaluation.evaluate import Named
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rivals.tuning import EPISODES, training_episodes
from jaxouter.evaluation.rollout import rollout
from jaxouter.plants import Plant

ON_HOST = 4  # episodes of a plant that is simulated elsewhere, and may be slow


def judge(
    plant: Plant, params: Any, key: chex.PRNGKey, learned: Mapping[int, Named], simple: Mapping[str, Named]
) -> dict[str, Any]:
    """MAE of the learned policies, by seed, and of the simple ones, by name, on fresh training episodes.

    Args:
        plant, params: of the training distribution.
        key: of the episodes, of which training has seen none.
        learned, simple: what is compared.

    Returns:
        As JSON values: episodes; mae, by name and by seed, None where diverged; worse, seeds that are not the best;
        text, for people.
    """
    count = EPISODES if plant.differentiable else ON_HOST
    episodes = training_episodes(plant, params, key, count)
    found = {name: _mae(named, episodes) for name, named in simple.items()}
    of_seeds = {seed: _mae(named, episodes) for seed, named in learned.items()}
    best = min(found, key=lambda name: found[name])
    worse = [seed for seed, value in of_seeds.items() if not value <= found[best] or np.isinf(value)]
    return {
        "episodes": count,
        "mae": {name: _json(value) for name, value in found.items()}
        | {"learned": {str(seed): _json(value) for seed, value in of_seeds.items()}},
        "worse": worse,
        "text": _text(found, of_seeds, best, worse, count, plant.y_unit),
    }


def _mae(named: Named, episodes: Any) -> float:
    value = mae(rollout(named.policy, named.params, episodes))
    return value if np.isfinite(value) else np.inf


def _json(value: float) -> float | None:
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
