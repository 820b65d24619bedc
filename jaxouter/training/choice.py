"""Choose history and model size for a plant before training, from its identified dead time and order."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import chex
import jax
import numpy as np

from jaxouter import agents, plants, tasks
from jaxouter.identification import dynamics, steady_state, unstable
from jaxouter.identification.dynamics import Dynamics
from jaxouter.loop.observation import HISTORY
from jaxouter.plants import Plant
from jaxouter.training.config import PretrainingConfig, TrainConfig, preset, to_dict, with_options

EXPLORATION = 3  # folded into a key
ON_HOST = 4  # episodes on which actors are compared, on a plant that is simulated elsewhere


UNSTABLE = {
    "correction": 1.0,  # the law is tuned to stay off the bounds of r~, so the actor gets the whole range
    "disturbances.noise": unstable.DISTURBANCES.noise,
    "disturbances.load": 0.0,
    "pretraining.closed_loop": unstable.CLOSED,
    "pretraining.gradient_steps": 1_500,
    "pretraining.log_above": 1.0,
    "pairs.rounds": 0,
}


class Choice(NamedTuple):
    """A configuration with all plant-dependent settings chosen."""

    config: TrainConfig
    said: str | None  # what was chosen, in one line
    warnings: tuple[str, ...]


def choose(config: TrainConfig) -> Choice:
    """Choose history, lags and the length of recorded episodes by the plant's dead time and order.

    These are identified under random r~. Settings that are given stay; the built-in plants are not identified.

    Raises:
        ValueError: no r~ moves the output.
    """
    if config.plant in tasks.TASKS or config.base == "bank":
        return Choice(config, None, ())
    plant, params = plants.make(config.plant)
    if plant.identified:
        return fitted(config, plant, [_of_models(params)], 0)
    if not plant.differentiable:
        config = _on_host(config)
    if config.randomise:
        plant, params = plants.randomised(plant, params, config.randomise)
    key = jax.random.fold_in(jax.random.key(config.seed), EXPLORATION)
    found, steps = dynamics.explore(plant, params, key)
    if all(one.kind == "unstable" for one in found) and plant.differentiable and not config.randomise:
        return _unstable(config, plant, params, key, steps)
    if not any(one.shown for one in found):
        try:
            steady_state.dc_gain(plant, params, key)
        except ValueError as error:
            late = (
                f"within an episode of {plant.episode_steps} control steps; r~ does nothing, or its dead time is longer"
            )
            raise ValueError(f"{error} {late}") from None
        text = f"y of {plant.name} shows no effect of r~ above its noise in {steps:,} control steps; history stays"
        return Choice(replace(config, explored_steps=steps), None, (f"{text} {config.history or HISTORY}",))
    return fitted(config, plant, [one for one in found if one.shown], steps)


def _unstable(config: TrainConfig, plant: Plant, params: Any, key: chex.PRNGKey, steps: int) -> Choice:
    """The choice for a plant that diverges under random r~: it is held by the LQ law first, and then learned on."""
    if config.base != "lq":
        text = f"{plant.name} is unstable alone; train with --base lq, which holds it"
        return Choice(replace(config, explored_steps=steps), None, (text,))
    defaults = to_dict(preset(config.plant, config.preset, agents.name_of(config.agent)))
    given = to_dict(config)
    lags = unstable.lags(plant, params, key)
    wanted = {**UNSTABLE, "pretraining.episode_steps": 2 * plant.episode_steps}
    free = {name: value for name, value in wanted.items() if _of(given, name) == _of(defaults, name)}
    steps += unstable.EPISODES * plant.episode_steps
    config = with_options(replace(config, history=config.history or lags, explored_steps=steps), free)
    said = f"identified: unstable alone; chosen: history {config.history}"
    return Choice(config, f"{said}, {', '.join(f'{name} {value}' for name, value in free.items())}", ())


def _of(values: Any, name: str) -> Any:
    """The value of an option in nested dicts."""
    for part in name.split("."):
        values = values[part]
    return values


def _on_host(config: TrainConfig) -> TrainConfig:
    """The configuration on a plant outside JAX: it can't be branched, and its episodes may be slow."""
    config = replace(config, compared=min(config.compared, ON_HOST), pairs=replace(config.pairs, rounds=0))
    if config.steps or config.pretraining.gradient_steps:
        return config
    steps = tasks.options(config.plant, "record")["pretraining.gradient_steps"]
    return replace(config, pretraining=replace(config.pretraining, gradient_steps=steps))


def _of_models(params: Any) -> Dynamics:
    """The dynamics of a plant that consists of identified models."""
    a, b = np.asarray(params.model.a), np.asarray(params.model.b)
    return Dynamics(len(a), int(np.flatnonzero(b)[0]), 0.0, "stable", shown=True)


def fitted(config: TrainConfig, plant: Plant, found: list[Dynamics], steps: int) -> Choice:
    """The choice for the dynamics of one or several drawn plants, identified in `steps` control steps."""
    dead, order = max(one.dead for one in found), max(one.order for one in found)
    wanted = max(dynamics.history_for(one.order, one.dead, HISTORY) for one in found)
    given = plant.history if config.history is None else config.history
    history, warnings = wanted if given is None else given, []
    if history <= dead:
        whose = "--history" if config.history is not None else f"what {plant.name} declares"
        warnings.append(
            f"the dead time of {dead} control steps does not fit in the {history} past samples of the observation "
            f"({whose}), so the observation lacks the r~ to which y has not yet responded; set --history {wanted}"
        )
    start, warned = _pretraining(config, plant, history if history > dead else wanted, dead)
    if 2 * dead > plant.episode_steps:
        warned += (
            f"the dead time of {dead} control steps is longer than half an episode of {plant.episode_steps}, so r~ "
            f"moves y only in its remainder; {_longer(4 * dead)}",
        )
    if config.pretraining.lags is None and start.lags == history:
        start = replace(start, lags=None)
    settling = max(one.settling for one in found)
    if plant.episode_steps < settling < np.inf:
        warned += (
            f"y takes about {settling:.0f} control steps to settle, longer than an episode of {plant.episode_steps}; "
            f"{_longer(2 * round(settling))}, or the control step longer",
        )
    identified = [f"dead time {dead} control steps", f"order {order}"]
    identified += [f"settling time {settling:.0f} control steps"] if 0.0 < settling < np.inf else []
    chosen = [f"history {history}"] if given is None else []
    chosen += [f"lags {start.lags}"] if start.lags != config.pretraining.lags else []
    longer = start.episode_steps != config.pretraining.episode_steps
    chosen += [f"recorded episodes of {start.episode_steps} control steps"] if longer else []
    said = f"identified: {', '.join(identified)}" + (f"; chosen: {', '.join(chosen)}" if chosen else "")
    known = replace(config, explored_steps=steps, pretraining=start)
    return Choice(known if given is not None else replace(known, history=history), said, (*warnings, *warned))


def _longer(steps: int) -> str:
    """Advice for an episode that is too short."""
    return f"make episode_steps {steps} or more (--episode-steps for gym:, fmu: and log:)"


def _pretraining(config: TrainConfig, plant: Plant, lags: int, dead: int) -> tuple[PretrainingConfig, tuple[str, ...]]:
    """Pretraining with lags (at most half a recorded episode) and length of recorded episodes; and warnings."""
    start = config.pretraining
    if not config.records or plant.identified:
        return start, ()
    if start.lags is not None:
        wrong = f"the dead time of {dead} control steps does not fit in --pretraining.lags {start.lags}; set {lags}"
        return start, (wrong,) if start.lags <= dead else ()
    most = (start.episode_steps or plant.episode_steps) // 2
    if lags > most and start.episode_steps is None and plant.differentiable:
        return replace(start, lags=lags, episode_steps=2 * lags), ()
    wrong = (
        f"the dead time of {dead} control steps does not fit in a model of half a recorded episode, {most} control "
        f"steps; {_longer(2 * lags)}"
    )
    return replace(start, lags=min(lags, most)), (wrong,) if most <= dead else ()
