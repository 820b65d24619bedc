"""Figures of merit, from traces. Times are in the plant's unit (pitch s, heaters h)."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from jaxouter.evaluation.rollout import Traces, excess
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.plants import Plant

BAND = 0.05  # of the step, for the settling time
ROUNDING = 1e-4  # of the error scale, by which a limit that is just met may be exceeded
NO_STEP = 1e-6  # likewise, below which a set-point is where y already is


def significant(value: float, digits: int) -> str:
    """A figure of merit for people, with so many significant digits and all digits before the point up to a million."""
    if 10**digits - 0.5 <= abs(value) < 1e6:
        return f"{value:,.0f}"
    return f"{value:#,.{digits}g}".rstrip(".")


def mae(traces: Traces) -> float:
    """Mean of |r_k - y_(k+1)| over steps and episodes, the paper's measure."""
    return float(np.mean(np.abs(traces.r - traces.y)))


def held(traces: Traces, plant: Plant) -> float:
    """Share of the episodes in the second half of which |y| never exceeds the plant's limit (else: its divergence)."""
    late = np.abs(traces.y[:, traces.y.shape[1] // 2 :])
    bound = plant.output_limit or max(map(abs, plant.divergence_bounds))
    return float(np.mean(np.all(late <= bound, axis=1)))


def figures_of_merit(traces: Traces, scenario: Scenario, inner_mae: float | None = None) -> dict[str, Any]:
    """Every figure of merit of one policy on one scenario; None where it is not defined.

    Over episodes the mean is taken, unless said.

    Args:
        traces: of the policy.
        scenario: what it ran on.
        inner_mae: MAE of the inner loop alone on the same scenario; without it `improvement` is None.

    Returns:
        mae; improvement: of the MAE over the inner loop alone, %, where that is stable;
        iae, ise: integrals of |e| and e^2 over an episode; itae: integral of t |e| over a set-point, t from its start;
        overshoot: beyond the set-point, % of the step; settling_time: until |e| stays within 5 % of the step, where one
        that never does counts as infinite; both the median over set-points, since small steps give any value;
        steady_state_error: |mean of e| over the last tenth of a set-point;
        violation_time: share of steps outside the limits; violation_max: largest excess;
        violation_time_each, violation_max_each: the same over the plant's single outputs (houses);
        r_tilde_tv: total variation of r~ in an episode; return: sum of rewards in an episode.
        A trace that is not finite gives None throughout and `diverged: True`.
    """
    names = ("mae", "improvement", "iae", "ise", "itae", "overshoot", "settling_time", "steady_state_error")
    names += ("violation_time", "violation_max", "violation_time_each", "violation_max_each", "r_tilde_tv", "return")
    if not np.all(np.isfinite(traces.y)):
        return dict.fromkeys(names) | {"diverged": True}
    plant, dt = scenario.plant, scenario.plant.control_step
    e = np.abs(traces.r - traces.y).astype(np.float64)
    values: dict[str, Any] = dict.fromkeys(names)
    values |= {"mae": float(e.mean()), "iae": float(e.sum(1).mean() * dt), "ise": float((e**2).sum(1).mean() * dt)}
    if inner_mae is not None and scenario.stable_alone:
        values["improvement"] = 100.0 * (1.0 - values["mae"] / inner_mae)
    if scenario.segments:
        segments = [_segment(y_start, r, y, dt, NO_STEP * plant.error_scale) for y_start, r, y in _segments(traces)]
        itae, overshoot, settling, steady = (np.array(column) for column in zip(*segments, strict=True))
        values["itae"], values["steady_state_error"] = float(itae.mean()), float(steady.mean())
        steps = np.isfinite(overshoot)  # a set-point at which y already is has no step
        if steps.any():
            values["overshoot"] = float(np.median(overshoot[steps]))
            median = float(np.median(settling[steps]))
            values["settling_time"] = median if np.isfinite(median) else None
    if plant.output_limit is not None or plant.rate_limit is not None:
        over = np.asarray(excess(plant, traces.y, np.concatenate([traces.y0[:, None], traces.y[:, :-1]], 1)))
        values["violation_time"], values["violation_max"] = (
            float((over > ROUNDING * plant.error_scale).mean()),
            float(max(0.0, over.max())),
        )
        if plant.members is not None:
            values["violation_time_each"] = float(traces.each_outside.mean())
            values["violation_max_each"] = float(max(0.0, traces.each_excess.max()))
    before = np.clip(traces.y0, *plant.r_tilde_bounds)[:, None]
    values["r_tilde_tv"] = float(np.abs(np.diff(traces.r_tilde, prepend=before, axis=1)).sum(1).mean())
    values["return"] = float(traces.reward.sum(1).mean())
    return values


def _segments(traces: Traces) -> Iterator[tuple[float, float, np.ndarray]]:
    """Of each held set-point: y at its start, r, and y (n,) after each of its steps."""
    for y0, r, y in zip(traces.y0, traces.r, traces.y, strict=True):
        starts = [0, *(np.flatnonzero(np.diff(r)) + 1), len(r)]
        for a, b in pairwise(starts):
            yield (y0 if a == 0 else y[a - 1]), r[a], y[a:b].astype(np.float64)


def _segment(y_start: float, r: float, y: np.ndarray, dt: float, no_step: float) -> tuple[float, float, float, float]:
    """itae, overshoot (%), settling time and steady-state error of one set-point; nan where there is no step."""
    e, step, t = np.abs(r - y), float(r - y_start), dt * np.arange(1, len(y) + 1)
    itae = float((t * e).sum() * dt)
    steady = float(abs(np.mean(r - y[-max(1, len(y) // 10) :])))
    if abs(step) < no_step:
        return itae, np.nan, np.nan, steady
    overshoot = 100.0 * max(0.0, float(np.max((y - r) * np.sign(step)))) / abs(step)
    outside = np.flatnonzero(e > BAND * abs(step))
    settled = 0.0 if len(outside) == 0 else np.inf if outside[-1] == len(y) - 1 else float(t[outside[-1]])
    return itae, overshoot, settled, steady
