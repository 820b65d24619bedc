"""What observation and model must hold to represent a plant, chosen before training by what a record tells of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxouter import plants
from jaxouter.loop import identify
from jaxouter.loop.identify import Dynamics
from jaxouter.loop.observation import HISTORY
from jaxouter.plants import Plant
from jaxouter.training.config import PRESETS, TrainConfig

EXPLORATION = 3  # folded into a key


class Choice(NamedTuple):
    """A configuration in which what depends on the plant is chosen."""

    config: TrainConfig
    said: str | None  # what was chosen, in a line
    warnings: tuple[str, ...]


def choose(config: TrainConfig) -> Choice:
    """The configuration with history, lags and length of the recorded episodes chosen by dead time and order.

    They are identified from random r~. What is given stays; so does all of a plant that has presets of its own.

    Raises:
        ValueError: no r~ moves the output.
    """
    if config.plant in PRESETS:
        return Choice(config, None, ())
    plant, params = plants.make(config.plant)
    if plant.identified:
        return fitted(config, plant, [_of_models(params)], 0)
    if config.randomise:
        plant, params = plants.randomised(plant, params, config.randomise)
    key = jax.random.fold_in(jax.random.key(config.seed), EXPLORATION)
    found, steps = identify.explore(plant, params, key)
    if not any(one.shown for one in found):
        identify.dc_gain(plant, params, key)  # which says so where nothing moves y at all
        told = f"y of {plant.name} shows no effect of r~ beside its noise in {steps:,} control steps; history stays"
        return Choice(replace(config, explored_steps=steps), None, (f"{told} {config.history or HISTORY}",))
    return fitted(config, plant, [one for one in found if one.shown], steps)


def _of_models(params: Any) -> Dynamics:
    """The dynamics of the models that a plant is made of."""
    a, b = np.asarray(params.model.a), np.asarray(params.model.b)
    return Dynamics(len(a), int(np.flatnonzero(b)[0]), 0.0, "stable", shown=True)


def fitted(config: TrainConfig, plant: Plant, found: list[Dynamics], steps: int) -> Choice:
    """The choice for these dynamics, of a plant or of several that are drawn, told by so many control steps."""
    start, dead, order = config.pretraining, max(one.dead for one in found), max(one.order for one in found)
    wanted = max(identify.history_for(one.order, one.dead, HISTORY) for one in found)
    given = plant.history if config.history is None else config.history
    warnings = []
    changed = {} if given is not None else {"history": wanted}
    if given is not None and given <= dead:
        declared = "--history" if config.history is not None else f"what {plant.name} declares"
        warnings.append(
            f"the dead time of {dead} control steps does not fit in the {given} past samples of the observation "
            f"({declared}), so r~ that is under way can't be seen; set --history {wanted}"
        )
    lags = start.lags or (wanted if given is None or given <= dead else given)
    recorded = start.episode_steps or plant.episode_steps
    if start.gradient_steps and not plant.identified:
        if start.lags is not None and lags <= dead:
            warnings.append(
                f"the dead time of {dead} control steps does not fit in a model of {lags} lags; set "
                f"--pretraining.lags {wanted}"
            )
        elif 2 * lags > recorded and start.episode_steps is None and plant.differentiable:
            recorded = 2 * lags
            start = replace(start, episode_steps=recorded)
        elif 2 * lags > recorded and start.lags is None:
            lags = max(1, recorded // 2)
            if lags <= dead:
                warnings.append(
                    f"the dead time of {dead} control steps does not fit in a model of {lags} lags, half a recorded "
                    f"episode; make episodes longer, at least {2 * wanted} control steps"
                )
        if lags != (changed.get("history") or given):
            start = replace(start, lags=lags)
    if 2 * dead > plant.episode_steps:
        warnings.append(
            f"the dead time of {dead} control steps is longer than half an episode of {plant.episode_steps}, of which "
            f"r~ moves only the rest; make episodes longer, at least {4 * dead} control steps"
        )
    settled = "" if not 0.0 < max(one.settling for one in found) < np.inf else f", settling time {max(one.settling for one in found):.0f}"
    said = f"identified: dead time {dead} control steps, order {order}{settled}; history {changed.get('history', given)}"
    said += "" if start.lags is None else f", lags {start.lags}"
    said += "" if start.episode_steps == config.pretraining.episode_steps else f", recorded episodes {recorded}"
    return Choice(replace(config, explored_steps=steps, pretraining=start, **changed), said, tuple(warnings))
