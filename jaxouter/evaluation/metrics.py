"""Figures of merit, from traces. Times are in the plant's unit (pitch s, heaters h)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import numpy as np
from msgspec import UNSET, Struct, UnsetType, field

from jaxouter.evaluation.rollout import Traces
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.loop import rewards
from jaxouter.loop.references import held as held_of
from jaxouter.loop.rewards import RewardConfig, RewardParams
from jaxouter.plants import Plant
from jaxouter.plants.base import RUN_ONCE, excess

BAND = 0.05  # of the step, for the settling time
ROUNDING = 1e-4  # of the error scale, by which a limit that is just met may be exceeded
NO_STEP = 1e-6  # likewise, below which a set-point is where y already is


class FiguresOfMerit(Struct, frozen=True, kw_only=True):
    """Figures of merit of one policy on one scenario, with their units; None where not defined.

    They are means over episodes, unless said. e_k is |r_k - y_(k+1)|, t the plant's unit of time.
    """

    mae: float | None = None  # y; mean of e
    improvement: float | None = None  # %; of the MAE over the inner loop alone, where that is stable
    iae: float | None = None  # y t; integral of e over an episode
    ise: float | None = None  # y^2 t; integral of e^2 over an episode
    itae: float | None = None  # y t^2; integral of t e over a set-point, t from its start
    overshoot: float | None = None  # %; beyond the set-point, of the step; median over them: small steps give any value
    settling_time: float | None = None  # t; until e stays within 5 % of the step, else infinite; median over set-points
    steady_state_error: float | None = None  # y; |mean of r - y| over the last tenth of a set-point
    violation_time: float | None = None  # share of steps outside the limits of y or of its change
    violation_max: float | None = None  # y; largest excess over the limits
    violation_time_each: float | None = None  # share; the same over the plant's single outputs (houses)
    violation_max_each: float | None = None  # y; likewise
    swing: float | None = None  # y; standard deviation of r~ over the second half of a set-point; the largest of them
    r_tilde_tv: float | None = None  # y; total variation of r~ in an episode
    episode_return: float | None = field(default=None, name="return")  # sum of rewards in an episode
    diverged: bool | UnsetType = UNSET  # only where a trace is not finite


def number(value: float | None, digits: int = 4) -> str:
    """A number for a table, with so many significant digits; a dash for None."""
    return "-" if value is None else significant(value, digits)


def significant(value: float, digits: int) -> str:
    """A figure of merit for people, with so many significant digits and all digits before the point up to a million."""
    if 10**digits - 0.5 <= abs(value) < 1e6:
        return f"{value:,.0f}"
    return f"{value:#,.{digits}g}".rstrip(".")


def mae(traces: Traces) -> float:
    """Mean of |r_k - y_(k+1)| over steps and episodes, the paper's measure."""
    return float(np.mean(np.abs(traces.r - traces.y)))


def trained_return(traces: Traces, plant: Plant, config: RewardConfig) -> float | None:
    """Sum of the rewards that are trained on in an episode, mean over episodes; None where not finite."""
    price = rewards.params(plant, config)
    found = np.asarray(_rewards(plant, price, _moves(traces, plant), jax.vmap(held_of)(traces.r)))
    total = float(found.sum(1).mean())
    return total if np.isfinite(total) else None


def reward_terms(traces: Traces, plant: Plant) -> dict[str, float]:
    """Mean per step of each reward term that the plant declares, as `reward_NAME`."""
    signals = _moves(traces, plant)
    return {f"reward_{term.__name__}": float(np.mean(_over_episodes(term)(*signals))) for term in plant.reward_terms}


def _moves(traces: Traces, plant: Plant) -> tuple[np.ndarray, ...]:
    """r, y, y before, r~ and r~ before of each control step, (episodes, T) each."""
    first = np.clip(traces.y0, *plant.r_tilde_bounds)
    before = (np.concatenate([a[:, None], b[:, :-1]], 1) for a, b in ((traces.y0, traces.y), (first, traces.r_tilde)))
    y_before, r_tilde_before = before
    return traces.r, traces.y, y_before, traces.r_tilde, r_tilde_before


def _over_episodes(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    return jax.vmap(jax.vmap(function))


@partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
def _rewards(plant: Plant, price: RewardParams, signals: Sequence[jax.Array], held: jax.Array) -> jax.Array:
    """Rewards (episodes, T) that are trained on."""

    def reward(held: jax.Array, *signals: jax.Array) -> jax.Array:
        return rewards.reward(price, *signals, terms=plant.reward_terms, held=held.astype(signals[0].dtype))

    return _over_episodes(reward)(held, *signals)


def held(traces: Traces, plant: Plant) -> float:
    """Share of the episodes in the second half of which |y| never exceeds the plant's limit (else: its divergence)."""
    late = np.abs(traces.y[:, traces.y.shape[1] // 2 :])
    bound = plant.output_limit or max(map(abs, plant.divergence_bounds))
    return float(np.mean(np.all(late <= bound, axis=1)))


def figures_of_merit(traces: Traces, scenario: Scenario, inner_mae: float | None = None) -> FiguresOfMerit:
    """Every figure of merit of one policy on one scenario.

    Args:
        traces: of the policy.
        scenario: what it ran on.
        inner_mae: MAE of the inner loop alone on the same scenario; without it `improvement` is None.

    Returns:
        A trace that is not finite gives None throughout and `diverged`.
    """
    if not np.all(np.isfinite(traces.y)):
        return FiguresOfMerit(diverged=True)
    plant, dt = scenario.plant, scenario.plant.control_step
    e = np.abs(traces.r - traces.y).astype(np.float64)
    mean = float(e.mean())
    before = np.clip(traces.y0, *plant.r_tilde_bounds)[:, None]
    return FiguresOfMerit(
        mae=mean,
        improvement=None if inner_mae is None or not scenario.stable_alone else 100.0 * (1.0 - mean / inner_mae),
        iae=float(e.sum(1).mean() * dt),
        ise=float((e**2).sum(1).mean() * dt),
        r_tilde_tv=float(np.abs(np.diff(traces.r_tilde, prepend=before, axis=1)).sum(1).mean()),
        episode_return=float(traces.reward.sum(1).mean()),
        **(_of_set_points(traces, plant) if scenario.segments else {}),
        **_violations(traces, plant),
    )


def _of_set_points(traces: Traces, plant: Plant) -> dict[str, Any]:
    """Figures of the held set-points; a set-point at which y already is has no step."""
    no_step = NO_STEP * plant.error_scale
    segments = [_segment(*each, plant.control_step, no_step) for each in _segments(traces)]
    itae, overshoot, settling, steady, swing = (np.array(column) for column in zip(*segments, strict=True))
    found: dict[str, Any] = {"itae": float(itae.mean()), "steady_state_error": float(steady.mean())}
    found["swing"] = float(swing.max())
    steps = np.isfinite(overshoot)
    if steps.any():
        median = float(np.median(settling[steps]))
        found["overshoot"] = float(np.median(overshoot[steps]))
        found["settling_time"] = median if np.isfinite(median) else None
    return found


def share_outside(traces: Traces, plant: Plant) -> float:
    """Share of the steps in which y or its change is outside the plant's limits."""
    return float(np.mean(_excess(traces, plant) > ROUNDING * plant.error_scale))


def _excess(traces: Traces, plant: Plant) -> np.ndarray:
    return np.asarray(excess(plant, traces.y, np.concatenate([traces.y0[:, None], traces.y[:, :-1]], 1)))


def _violations(traces: Traces, plant: Plant) -> dict[str, Any]:
    """Time and size outside the limits of y or of its change, where there are any."""
    if plant.output_limit is None and plant.rate_limit is None:
        return {}
    found = {
        "violation_time": share_outside(traces, plant),
        "violation_max": float(max(0.0, _excess(traces, plant).max())),
    }
    if plant.members is not None:
        found["violation_time_each"] = float(traces.each_outside.mean())
        found["violation_max_each"] = float(max(0.0, traces.each_excess.max()))
    return found


def _segments(traces: Traces) -> Iterator[tuple[float, float, np.ndarray, np.ndarray]]:
    """Of each held set-point: y at its start, r, and y (n,) after each of its steps and r~ (n,) in them."""
    for y0, r, y, r_tilde in zip(traces.y0, traces.r, traces.y, traces.r_tilde, strict=True):
        starts = [0, *(np.flatnonzero(np.diff(r)) + 1), len(r)]
        for a, b in pairwise(starts):
            yield (y0 if a == 0 else y[a - 1]), r[a], y[a:b].astype(np.float64), r_tilde[a:b].astype(np.float64)


def _segment(
    y_start: float, r: float, y: np.ndarray, r_tilde: np.ndarray, dt: float, no_step: float
) -> tuple[float, float, float, float, float]:
    """itae, overshoot (%), settling time, steady-state error, swing of one set-point; nan where there is no step."""
    e, step, t = np.abs(r - y), float(r - y_start), dt * np.arange(1, len(y) + 1)
    itae = float((t * e).sum() * dt)
    steady, swing = float(abs(np.mean(r - y[-max(1, len(y) // 10) :]))), float(np.std(r_tilde[len(y) // 2 :]))
    if abs(step) < no_step:
        return itae, np.nan, np.nan, steady, swing
    overshoot = 100.0 * max(0.0, float(np.max((y - r) * np.sign(step)))) / abs(step)
    outside = np.flatnonzero(e > BAND * abs(step))
    settled = 0.0 if len(outside) == 0 else np.inf if outside[-1] == len(y) - 1 else float(t[outside[-1]])
    return itae, overshoot, settled, steady, swing
