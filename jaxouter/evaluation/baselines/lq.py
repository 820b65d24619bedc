"""`lq`: the LQ law of `jaxouter.identification.lq`, which learned policies have as their base law, by itself.

`lq-return` is chosen by the return in place of the MAE.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import chex
import jax
import numpy as np

from jaxouter.evaluation.baselines.tuning import Report, learner
from jaxouter.evaluation.cache import Tuned
from jaxouter.identification import dynamics, steady_state, unstable
from jaxouter.identification.lq import Choice, Figure, choose, warn_short
from jaxouter.identification.records import record, within
from jaxouter.loop.policy import Linear, LinearLaw
from jaxouter.plants import Plant

RECORD = 64  # episodes


def tune(figure: Figure, plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    """The best law of a record, under the noise and loads of the learner."""
    del budget
    key_explore, key_static, key_record, key_choose = jax.random.split(key, 4)
    history, explored = dynamics.suitable_history(plant, params, key_explore)
    _, static = steady_state.static(plant, params, key_static)
    data = within(record(plant, params, key_record, RECORD), plant.divergence_bounds)
    report("choosing its law", 0.5)
    if plant.differentiable and dynamics.of_record(data).kind == "unstable":
        return _of_unstable(plant, params, key_choose, static, explored + data.r_tilde.size)
    found = choose(plant, [data], static, key_choose, history, learner(plant).disturbances, figure)
    return kept(found, explored + steady_state.LEVELS * plant.episode_steps + data.r_tilde.size)


def _of_unstable(plant: Plant, params: Any, key: chex.PRNGKey, static: LinearLaw, steps: int) -> Tuned:
    """The law that a learned policy has as its base on a plant that is unstable alone, chosen by the MAE.

    `steps` of the plant were taken before, which count too.
    """
    key_lags, key_record, key_law = jax.random.split(key, 3)
    longer = replace(plant, episode_steps=2 * plant.episode_steps)
    history, data = unstable.lags(plant, params, key_lags), record(longer, params, key_record, RECORD)
    of_law = key_law, history, unstable.DISTURBANCES, static, unstable.CLOSED
    found = unstable.identify(longer, params, data, *of_law)
    recorded = unstable.EPISODES * plant.episode_steps + (RECORD + unstable.CLOSED) * longer.episode_steps
    return kept(found.chosen, steps + steady_state.LEVELS * plant.episode_steps + recorded)


def kept(found: Choice, steps: int) -> Tuned:
    """What was found, as it is kept."""
    law = LinearLaw(*(np.asarray(each, np.float64) for each in found.law))  # type: ignore[arg-type]
    settings = {name: float(getattr(law, name)) for name in ("offset", "r", "y")}
    settings |= {} if found.settings is None else found.settings._asdict()
    settings |= {"mae": found.mae, "static_mae": found.static_mae, "most": found.most}
    return Tuned(settings, {name: np.asarray(getattr(law, name)) for name in ("y_past", "r_tilde_past")}, steps)


def build(plant: Plant, tuned: Tuned) -> tuple[Linear, LinearLaw]:
    """The policy from what `tune` found."""
    warn_short(plant, tuned.settings["most"])
    numbers = {name: tuned.settings[name] for name in ("offset", "r", "y")} | tuned.arrays
    return Linear(plant.r_tilde_bounds), LinearLaw(**{name: jax.numpy.asarray(x, float) for name, x in numbers.items()})
