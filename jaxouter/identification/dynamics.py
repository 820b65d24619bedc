"""Dynamics of a plant from a record: order, dead time, whether it is stable, and the history an agent needs."""

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
DRAWN = 4  # plants to identify if each episode draws another plant
SHOWN = 0.99  # y shows r~ if r~ reduces the prediction error below this share
ROUNDING = 1e-6  # share of y below which nothing is an effect
NEGLIGIBLE = 0.01  # of the largest coefficient of r~; leading ones below are dead time
ENOUGH = 20  # cap on the past samples in an observation for a high order ...
BEYOND = 8  # ... but after a long dead time up to this many more


class Dynamics(NamedTuple):
    """How y responds to r~ according to a record; times in control steps."""

    order: int
    dead: int  # dead time in addition to the one step of sampling
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
    missed = prediction_error(deaf, data, horizon)  # without r~
    shown = ROUNDING * np.nanmax(np.abs(data.y)) < missed and prediction_error(arx, data, horizon) < SHOWN * missed
    kind = kind_of(model, steps)
    dead += int(np.argmax(np.abs(arx.b) > NEGLIGIBLE * np.abs(arx.b).max()))
    return Dynamics(n, dead, settling(model) if kind == "stable" else math.inf, kind, shown)


def exploration(plant: Plant) -> int:
    """Control steps that `explore` records."""
    return (1 if plant.draw is None else DRAWN) * EXPLORED * plant.episode_steps


def explore(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[list[Dynamics], int]:
    """Dynamics of the plant (of `DRAWN` plants if episodes draw them), and the control steps that were recorded."""
    found = []
    for one in jax.random.split(key, 1 if plant.draw is None else DRAWN):
        drawn = params if plant.draw is None else plant.draw(jax.random.fold_in(one, 1), params)
        found.append(of_record(within(record(plant, drawn, one, EXPLORED), plant.divergence_bounds)))
    return found, exploration(plant)


def history_for(order: int, dead: int, least: int) -> int:
    """Past samples an observation must hold to show the r~ still in the dead time, and the state of the plant."""
    return max(least, dead + min(order + 1, max(ENOUGH - dead, BEYOND)))


def suitable_history(plant: Plant, params: Any, key: chex.PRNGKey) -> tuple[int, int]:
    """Past samples in the observation, as declared by the plant or identified; and the control steps recorded."""
    if plant.history is not None:
        return plant.history, 0
    found, steps = explore(plant, params, key)
    return max([HISTORY, *(history_for(one.order, one.dead, HISTORY) for one in found if one.shown)]), steps
