"""`deepc`: data-enabled predictive control on the record that `mpc` is identified from (Coulson et al. 2019).

No model: the future is a combination g of windows of the record that agrees with the recent past. The windows hold
moves of r~ and levels of y, so that constant disturbances and offsets cancel (offset-free). With the projected
regulariser (Doerfler et al. 2023) the programme is

    min |Y_f g - r|^2 + w_move |moves|^2 + w_g |(I - Pi) g|^2   with   U_f g = moves, [U_p; Y_p] g = past,

Pi the projection on the rows of [U_p; Y_p; U_f]. It is condensed by their LQ decomposition
[U_p Y_p U_f; Y_f] = [L11 0; L21 L22] Q: the part of g that is not projected, g2, enters y_f by L22 g2 alone and is
eliminated in closed form, which weighs the errors by W = (I + L22 L22' / w_g)^-1, less where the record predicts badly.
The reduction is exact without output limits; it loses that g2 could move to keep a limit: limits hold for the
prediction with g2 = 0. Past and moves are met in a least-squares sense where noise-free data leave L11 singular.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import chex
import jax
import numpy as np

from jaxouter.evaluation.baselines.mpc import RECORD, horizons_for, late
from jaxouter.evaluation.baselines.qp import Condensed, Solver, blocks, differences, limit_rows
from jaxouter.evaluation.baselines.tuning import Report, coordinate_search, learners_episodes, score
from jaxouter.evaluation.cache import Tuned
from jaxouter.identification.linear_models import HORIZON, choose_arx
from jaxouter.identification.records import Record, record
from jaxouter.identification.steady_state import LEVELS, dc_gain
from jaxouter.plants import Plant

RANK = 1e-6  # singular values below this share of the largest count as zero


class DeePCSettings(NamedTuple):
    """What is tuned."""

    past: int  # control steps that must agree
    horizon: int  # control steps
    move_weight: float  # of squared moves of r~, in squared errors that their DC effect would be
    g_weight: float  # w_g over the number of windows, in mean squares of y
    margin: float  # kept from the limits, in standard deviations of the one-step prediction
    noise: float  # added to y of the record, standard deviation as share of the set-point range


class Carry(NamedTuple):
    """The recent past, oldest first."""

    moves: np.ndarray  # (past,) of r~
    y: np.ndarray  # (past,)
    r_tilde: float


@dataclass(frozen=True)
class DeePC:
    """The programme, and how much of the past it takes; no preview."""

    programme: Condensed
    past: int
    r_tilde_bounds: tuple[float, float]
    host: bool = True

    @cached_property
    def _solver(self) -> Solver:
        return Solver(self.programme)

    def init(self, params: Any, r0: float, y0: float) -> Carry:
        """A past at rest."""
        return Carry(np.zeros(self.past), np.full(self.past, y0), float(np.clip(y0, *self.r_tilde_bounds)))

    def act(self, params: Any, carry: Carry, r: float, y: float, key: Any = None) -> tuple[Carry, float]:
        """Solve, remember."""
        seen = np.append(carry.y[1:], y)
        u = self._solver(np.concatenate([carry.moves, seen, [r, carry.r_tilde]]))[0]
        return Carry(np.append(carry.moves[1:], u - carry.r_tilde), seen, u), u


def windows(data: Record, past: int, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the record: what is given (past moves, past y, future moves) and future y; rows are times."""
    moves = np.diff(data.r_tilde, axis=1, prepend=np.nan)
    now = np.arange(past + 1, data.r_tilde.shape[1] - horizon + 1)  # the move at the start is not known

    def rows(signal: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        return signal[:, now[:, None] + offsets].reshape(-1, len(offsets)).T

    back, ahead = np.arange(-past, 0), np.arange(horizon)
    return np.vstack([rows(moves, back), rows(data.y, back + 1), rows(moves, ahead)]), rows(data.y, ahead + 1)


def controller(plant: Plant, data: Record, gain: float, settings: DeePCSettings) -> DeePC:
    """The controller that a record gives, its costs scaled by the DC gain of the plant."""
    past, horizon = settings.past, settings.horizon
    noise = settings.noise * np.ptp(plant.setpoint_range) * np.random.default_rng(0).normal(size=data.y.shape)
    given, future = windows(data._replace(y=data.y + noise), past, horizon)
    count = given.shape[1]
    L = np.asarray(np.linalg.qr(np.vstack([given, future]).T / np.sqrt(count), mode="r")).T
    L11, L21, L22 = L[: len(given), : len(given)], L[len(given) :, : len(given)], L[len(given) :, len(given) :]
    predictor = L21 @ np.linalg.pinv(L11, rcond=RANK)  # future y of what is given
    W = np.linalg.inv(np.eye(horizon) + L22 @ L22.T / (settings.g_weight * np.mean(data.y**2)))

    # z = [past moves, past y, r, last r~]; moves = steps u - first * last r~, from the levels u of a few blocks.
    held = blocks(horizon)
    size, last = 2 * past + 2, np.eye(2 * past + 2)[-1]
    of_past, of_moves = np.split(predictor, [2 * past], axis=1)
    forced = of_moves @ differences(horizon) @ held
    free = np.hstack([of_past, np.zeros((horizon, 2))]) - np.outer(of_moves[:, 0], last)
    reference = np.outer(np.ones(horizon), np.eye(size)[-2])
    steps = differences(held.shape[1])
    weight = settings.move_weight * gain**2
    H = forced.T @ W @ forced + weight * steps.T @ steps
    F = forced.T @ W @ (free - reference) - weight * np.outer(steps[0], last)
    rows = limit_rows(plant, free, forced, np.eye(size)[2 * past - 1], settings.margin * abs(L22[0, 0]))
    return DeePC(Condensed(H, F, *plant.r_tilde_bounds, *rows), past, plant.r_tilde_bounds)


def tune(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    """A record, then the settings with the greatest return on training episodes; the keys give `mpc` the same ones."""
    key_record, key_episodes = jax.random.split(key)
    data = record(plant, params, key_record, RECORD)
    gain = float(dc_gain(plant, params, key_record).gain)
    dead = choose_arx(data, round(HORIZON * plant.episode_steps)).dead
    episodes = learners_episodes(plant, params, key_episodes)
    spent = data.r_tilde.size + LEVELS * plant.episode_steps
    horizons, beyond = horizons_for(plant, dead), late(plant, dead)
    grid = {
        "move_weight": (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0),
        "g_weight": (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0),
        "noise": (0.0, 1e-4, 3e-4, 1e-3, 3e-3),
        "past": [beyond + past for past in (1, 2, 3, 5, 8, 12, 16, 20)],
        "horizon": horizons,
        "margin": (0.0, 1.0, 2.0, 3.0),
    }
    start = {
        "move_weight": 0.1,
        "g_weight": 1e-2,
        "noise": 0.0,
        "past": beyond + 12,
        "horizon": horizons[2],
        "margin": 1.0,
    }

    def value(settings: dict[str, Any]) -> float:
        return score(controller(plant, data, gain, DeePCSettings(**settings)), (), episodes)

    found, tried = coordinate_search(value, grid, start, (budget - spent) // episodes.r.size, report)
    arrays = {"r_tilde": data.r_tilde, "y": data.y}
    return Tuned(found | {"gain": gain}, arrays, spent + tried * episodes.r.size)


def build(plant: Plant, tuned: Tuned) -> tuple[DeePC, tuple[()]]:
    """The policy from what `tune` found."""
    settings = dict(tuned.settings)
    gain = settings.pop("gain")
    return controller(plant, Record(tuned.arrays["r_tilde"], tuned.arrays["y"]), gain, DeePCSettings(**settings)), ()
