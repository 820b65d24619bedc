"""What a record tells of a plant: order, dead time, whether it comes to rest, and the history that it needs."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import chex
import jax
import numpy as np

from jaxouter.identification.linear_models import (
    HORIZON,
    as_model,
    choose_arx,
    fit_arx,
    kind_of,
    prediction_error,
    settling,
)
from jaxouter.identification.records import Record, record, within
from jaxouter.loop.observation import HISTORY
from jaxouter.plants import Plant

EXPLORED = 8  # episodes from which order and dead time are identified
DRAWN = 4  # plants of which these are, each, where a plant is drawn for each episode
SHOWN = 0.99  # of the prediction error without r~: with r~ it must be smaller, or y does not show it
NEGLIGIBLE = 0.01  # of the largest coefficient of r~; the first ones below are dead time
ENOUGH = 20  # past samples in an observation, of a high order
BEYOND = 8  # of them beyond a long dead time


class Dynamics(NamedTuple):
    """How y answers to r~, as a record tells; times in control steps."""

    order: int
    dead: int  # dead time beyond the one of sampling
    settling: float  # until a step response stays within 5 % of its end; inf: it never does
    kind: Literal["stable", "integrating", "unstable"]
    shown: bool  # whether y shows r~ at all


def of_record(data: Record) -> Dynamics:
    """Order, dead time and kind of a plant from exciting episodes, `EXPLORED` or more."""
    steps = data.r_tilde.shape[1]
    arx = choose_arx(data, max(1, round(HORIZON * steps)))
    n, dead = len(arx.a), arx.dead
    model, horizon = as_model(arx), max(1, min(round(HORIZON * steps), (steps - n - dead) // 3))
    deaf = fit_arx(data._replace(r_tilde=np.zeros_like(data.r_tilde)), n, dead)
    shown = prediction_error(arx, data, horizon) < SHOWN * prediction_error(deaf, data, horizon)
    kind = kind_of(model, steps)
    dead += int(np.argmax(np.abs(arx.b) > NEGLIGIBLE * np.abs(arx.b).max()))
    return Dynamics(n, dead, settling(model) if kind == "stable" else math.inf, kind, shown)


def explore(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[list[Dynamics], int]:
    """Dynamics of a plant, or of some that are drawn where each episode draws one, and the control steps recorded."""
    found = []
    for one in jax.random.split(key, 1 if plant.draw is None else DRAWN):
        drawn = params if plant.draw is None else plant.draw(jax.random.fold_in(one, 1), params)
        found.append(of_record(within(record(plant, drawn, one, EXPLORED), plant.divergence_bounds)))
    return found, len(found) * EXPLORED * plant.episode_steps


def history_for(order: int, dead: int, least: int) -> int:
    """Past samples that an observation must hold to tell what r~ is under way, and the state of such a plant."""
    return max(least, dead + min(order + 1, max(ENOUGH - dead, BEYOND)))


def suitable_history(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[int, int]:
    """Past samples that an observation of a plant holds, as it declares or told by a record; and steps recorded."""
    if plant.history is not None:
        return plant.history, 0
    found, steps = explore(plant, params, key)
    return max([HISTORY, *(history_for(one.order, one.dead, HISTORY) for one in found if one.shown)]), steps
