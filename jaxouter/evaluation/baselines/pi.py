"""`pi`: the static prefilter with a PI controller around it, tuned on the training distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxouter.evaluation.baselines.tuning import Report, learners_episodes, score
from jaxouter.evaluation.cache import Tuned
from jaxouter.identification import steady_state
from jaxouter.identification.steady_state import dc_gain, prefilter
from jaxouter.loop.policy import LinearLaw, affine
from jaxouter.plants import Plant


class PIParams(NamedTuple):
    """r~ = offset + slope r + kp e + ki times the integral of e = r - y."""

    base: LinearLaw  # the static prefilter
    kp: jax.Array
    ki: jax.Array  # 1 / time unit


@dataclass(frozen=True)
class PI:
    """Static prefilter and PI; the integral stands still while r~ is at a bound and e would drive it further."""

    r_tilde_bounds: tuple[float, float]
    control_step: float
    host: bool = False

    def init(self, params: PIParams, r0: jax.Array, y0: jax.Array) -> jax.Array:
        """The integral of e, at first zero."""
        del params, r0
        return jnp.zeros_like(y0)

    def act(
        self, params: PIParams, carry: jax.Array, r: jax.Array, y: jax.Array, key: chex.PRNGKey | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """Integral and r~, with conditional integration against wind-up."""
        del key
        low, high = self.r_tilde_bounds
        e = r - y
        integral = carry + e * self.control_step
        wanted = params.base.offset + params.base.r * r + params.kp * e + params.ki * integral
        further = ((wanted > high) & (params.ki * e > 0)) | ((wanted < low) & (params.ki * e < 0))
        return jnp.where(further, carry, integral), jnp.clip(wanted, low, high)


def tune(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    """Gains with the greatest return on training episodes, by COBYQA (scipy), within `budget` environment steps.

    The search runs over asinh of kp G and of ki G times the episode, G the identified DC gain, so that it reaches far
    and is fine near zero; it starts from a gentle controller. The integral acts with the right sign and never quite
    vanishes: a wrong one can pay within an episode, but drifts away after it. Where y does not settle, G is what a unit
    of r~ moves it by in an episode, and the prefilter is the r~ under which it stays.
    """
    key_static, key_episodes = jax.random.split(key)
    identified = dc_gain(plant, params, key_static)
    _, base = prefilter(plant, identified)
    per_gain = float(base.r)
    if identified.unsettled is not None:
        base = affine(0.0, identified.still)
        per_gain = 1.0 / (identified.rate * plant.episode_steps)
    episodes = learners_episodes(plant, params, key_episodes)
    policy, time = PI(plant.r_tilde_bounds, plant.control_step), plant.episode_steps * plant.control_step
    spent, each = steady_state.LEVELS * plant.episode_steps, episodes.r.size
    most = (budget - spent) // each
    best: list[tuple[float, PIParams]] = []

    def gains(x: np.ndarray) -> PIParams:
        scaled = np.sinh(x) * per_gain / np.array([1.0, time])
        return PIParams(base, *(jnp.asarray(gain, float) for gain in scaled))

    def loss(x: np.ndarray) -> float:
        tried = gains(x)
        best.append((score(policy, tried, episodes), tried))
        report(f"{len(best)} of at most {most} gains", len(best) / most)
        return -best[-1][0] / plant.error_scale if np.isfinite(best[-1][0]) else 1e6

    bounds = [(0.0, 5.0), (0.01, 6.0)]
    options = {"maxfev": most, "initial_tr_radius": 0.5, "final_tr_radius": 1e-3}
    scipy.optimize.minimize(loss, [0.5, 0.2], method="COBYQA", bounds=bounds, options=options)
    _, found = max(best, key=lambda tried: tried[0])
    settings = {
        "kp": float(found.kp),
        "ki": float(found.ki),
        "slope": float(base.r),
        "offset": float(base.offset),
    }
    return Tuned(settings, {}, spent + len(best) * each)


def build(plant: Plant, tuned: Tuned) -> tuple[PI, PIParams]:
    """The policy from what `tune` found."""
    slope, offset, kp, ki = (jnp.asarray(tuned.settings[name], float) for name in ("slope", "offset", "kp", "ki"))
    return PI(plant.r_tilde_bounds, plant.control_step), PIParams(affine(slope, offset), kp, ki)
