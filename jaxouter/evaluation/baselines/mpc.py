"""`mpc`: linear model predictive control on a model identified from an exciting record.

The model is an ARX model with dead time. In innovations form it is its own observer; a disturbance at its input, a
random walk, is estimated along (offset-free). At each step a quadratic programme over the coming r~ is solved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import chex
import jax
import numpy as np
import scipy

from jaxouter.evaluation.baselines.qp import Condensed, Solver, blocks, differences, limit_rows
from jaxouter.evaluation.baselines.tuning import Report, coordinate_search, learners_episodes, score
from jaxouter.evaluation.cache import Tuned
from jaxouter.identification.linear_models import ARX, HORIZON, choose_arx
from jaxouter.identification.records import Record, record, within
from jaxouter.plants import Plant

RECORD = 50  # episodes of the record


class Model(NamedTuple):
    """x_(k+1) = A x_k + B (r~_k + d) + K e_k, y_k = C x_k + e_k, deviations included in d."""

    A: np.ndarray  # (n, n)
    B: np.ndarray  # (n,)
    C: np.ndarray  # (n,)
    K: np.ndarray  # (n,)
    d: float  # disturbance at the input before anything is seen

    @property
    def gain(self) -> float:
        """DC gain."""
        return float(self.C @ np.linalg.solve(np.eye(len(self.A)) - self.A, self.B))


def innovations_form(arx: ARX) -> Model:
    """The ARX model as state space, in observer canonical form."""
    n, size = len(arx.a), len(arx.a) + arx.dead
    a, b = np.zeros(size), np.zeros(size)
    a[:n], b[arx.dead :] = arx.a, arx.b
    A = np.eye(size, k=1)
    A[:, 0] = a
    return Model(A, b, np.eye(size)[0], a, arx.c / arx.b.sum())


def effect(model: Model, steps: int, horizon: int) -> float:
    """What a unit step of r~ does to y: the DC gain, or within the horizon where y does not settle in so many steps."""
    x, y = np.zeros(len(model.B)), np.zeros(max(steps, horizon) + 1)
    for k in range(len(y)):
        x, y[k] = model.A @ x + model.B, float(model.C @ x)
    settles = np.max(np.abs(np.linalg.eigvals(model.A))) < 1.0
    return model.gain if settles and abs(y[steps] - model.gain) <= 0.5 * abs(model.gain) else float(y[horizon])


class MPCSettings(NamedTuple):
    """What is tuned."""

    horizon: int  # control steps
    move_weight: float  # of squared moves of r~, in squared errors that their DC effect would be
    disturbance: float  # standard deviation of its step, as share of the range of r~
    margin: float  # kept from the limits, in standard deviations of e
    noise: float  # of the sensor that the observer expects, standard deviation as share of the set-point range


class MPCParams(NamedTuple):
    """The augmented model and the programme."""

    A: np.ndarray  # (n + 1, n + 1), the last state is d
    B: np.ndarray
    C: np.ndarray
    K: np.ndarray  # observer
    d: float
    programme: Condensed


class Carry(NamedTuple):
    """Observer and last r~."""

    x: np.ndarray  # (n + 1,), of t_k, from what came before
    r_tilde: float


@dataclass(frozen=True)
class MPC:
    """Observer, then programme; no preview: the reference stays as it is."""

    params: MPCParams
    r_tilde_bounds: tuple[float, float]
    host: bool = True

    @cached_property
    def _solver(self) -> Solver:
        return Solver(self.params.programme)

    def init(self, params: Any, r0: float, y0: float) -> Carry:
        """In steady state at y_0."""
        p = self.params
        n = len(p.A) - 1
        rest = np.block([[p.A[:n, :n] - np.eye(n), p.B[:n, None]], [p.C[:n], np.zeros(1)]])  # of state and input
        x = np.linalg.lstsq(rest, np.append(np.zeros(n), y0), rcond=None)[0][:n]
        return Carry(np.append(x, p.d), float(np.clip(y0, *self.r_tilde_bounds)))

    def act(self, params: Any, carry: Carry, r: float, y: float, key: Any = None) -> tuple[Carry, float]:
        """Correct the state by the innovation, solve, predict."""
        p = self.params
        free = p.A @ carry.x + p.K * (y - p.C @ carry.x)
        u = self._solver(np.concatenate([free, [r, y, carry.r_tilde]]))[0]
        return Carry(free + p.B * u, u), u


def observer(
    model: Model, sigma: float, disturbance: float, noise: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C of the model with its disturbance as last state, and the Kalman gain of one-step prediction.

    Args:
        model: with innovations e.
        sigma, disturbance, noise: standard deviations of e, of a step of d, and of the sensor.
    """
    n = len(model.A)
    A = np.zeros((n + 1, n + 1))
    A[:n, :n], A[:n, n], A[n, n] = model.A, model.B, 1.0
    B, C, K = np.append(model.B, 0.0), np.append(model.C, 0.0), np.append(model.K, 0.0)
    e, v, d = (np.array([sigma, noise, disturbance]) / np.hypot(sigma, noise)) ** 2  # only their ratios matter
    Q = e * np.outer(K, K)
    Q[n, n] = d
    P = scipy.linalg.solve_discrete_are(A.T, C[:, None], Q, np.eye(1) * (e + v), s=e * K[:, None])
    return A, B, C, (A @ P @ C + e * K) / (C @ P @ C + e + v)


def controller(plant: Plant, model: Model, sigma: float, settings: MPCSettings) -> MPC:
    """The controller of a model."""
    span, width = np.diff(plant.setpoint_range)[0], np.diff(plant.r_tilde_bounds)[0]
    A, B, C, K = observer(model, sigma, settings.disturbance * width, settings.noise * span)
    horizon, moves = settings.horizon, blocks(settings.horizon)
    powers = [C]
    for _ in range(horizon - 1):
        powers.append(powers[-1] @ A)
    impulse = np.array([row @ B for row in powers])
    forced = scipy.linalg.toeplitz(impulse, np.zeros(horizon)) @ moves
    size = len(A)
    free = np.hstack([np.array(powers), np.zeros((horizon, 3))])  # z = [free state, r, y, last r~]
    reference = np.zeros((horizon, size + 3))
    reference[:, size] = 1.0
    now, last = np.eye(size + 3)[size + 1], np.eye(size + 3)[size + 2]
    steps = differences(moves.shape[1])
    weight = settings.move_weight * effect(model, plant.episode_steps, horizon) ** 2
    H = forced.T @ forced + weight * steps.T @ steps
    F = forced.T @ (free - reference) - weight * np.outer(steps[0], last)
    rows = limit_rows(plant, free, forced, now, settings.margin * sigma)
    programme = Condensed(H, F, *plant.r_tilde_bounds, *rows)
    return MPC(MPCParams(A, B, C, K, model.d, programme), plant.r_tilde_bounds)


def late(plant: Plant, dead: int) -> int:
    """Control steps of a dead time beyond those that horizons and pasts, as they are chosen else, leave room for."""
    return max(0, dead - plant.episode_steps // 20)


def horizons_for(plant: Plant, dead: int) -> list[int]:
    """Horizons that are tried, in control steps."""
    return [late(plant, dead) + max(1, round(plant.episode_steps * share)) for share in (0.1, 0.15, 0.2, HORIZON)]


def tune(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    """Model, then the settings with the greatest return on training episodes."""
    key_record, key_episodes = jax.random.split(key)
    data = within(record(plant, params, key_record, RECORD), plant.divergence_bounds)
    report("identifying its model", 0.0)
    episodes = learners_episodes(plant, params, key_episodes)
    return tuned(plant, data, lambda found: score(found, (), episodes), budget, episodes.r.size, report)


def tuned(plant: Plant, data: Record, score: Callable[[MPC], float], budget: int, each: int, report: Report) -> Tuned:
    """The model of a record, and the settings with the greatest score.

    Args:
        plant: as declared.
        data: exciting episodes.
        score: of a controller.
        budget: control steps of the record and of all scores together.
        each: control steps of a score.
        report: told how far it is.
    """
    arx = choose_arx(data, round(HORIZON * plant.episode_steps))
    horizons = horizons_for(plant, arx.dead)
    model = innovations_form(arx)
    most = max(1, (budget - data.r_tilde.size) // each)
    grid = {
        "move_weight": (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0),
        "disturbance": (1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1),
        "noise": (3e-4, 1e-3, 3e-3, 1e-2, 3e-2),
        "horizon": horizons,
        "margin": (0.0, 1.0, 2.0, 3.0),
    }
    start = {"move_weight": 0.1, "disturbance": 1e-3, "noise": 3e-3, "horizon": horizons[2], "margin": 1.0}

    def value(settings: dict[str, Any]) -> float:
        return score(controller(plant, model, arx.sigma, MPCSettings(**settings)))

    found, spent = coordinate_search(value, grid, start, most, report)
    settings = found | {"dead": arx.dead, "c": arx.c, "sigma": arx.sigma}
    return Tuned(settings, {"a": arx.a, "b": arx.b}, data.r_tilde.size + spent * each)


def build(plant: Plant, tuned: Tuned) -> tuple[MPC, tuple[()]]:
    """The policy from what `tune` found."""
    settings = dict(tuned.settings)
    dead, c, sigma = (settings.pop(name) for name in ("dead", "c", "sigma"))
    model = innovations_form(ARX(tuned.arrays["a"], tuned.arrays["b"], c, dead, sigma))
    return controller(plant, model, sigma, MPCSettings(**settings)), ()
