"""The paper's Boeing 747: presets, scenarios (the paper's and others), sweeps."""

from __future__ import annotations

from typing import Any

import jax

from jaxouter.plants import pitch
from jaxouter.plants.pitch import W_PRINTED
from jaxouter.tasks.task import Axis, Scenario, Sweep, Task

SETPOINT = 14.66  # crad; the amplitude that gives the paper's baseline of 10.91
MAX_DELAY = 5.7  # s; one length of the delay lines for all scenarios with delays of u, so that they compile once
NOISE_SEEDS = 32
DELAYED = (10.13, 2.46)  # the paper's only delayed case; no reading of it gives 10.13 exactly

# The linear law is nearly the best there is: small corrections, for which moves of r~ cost nothing.
RECORD = {"correction": 0.1, "reward.beta_h": 0.0}
DEFAULT = {
    **RECORD,
    "reward.rest": 0.02,
    "disturbances.noise": 0.015,
    "pretraining.gradient_steps": 0,
    "pairs.rounds": 30,
}
SCRATCH = {"disturbances.load": 0.15}
# A law holds delays within 0.15 s of its own; none of the five plants of the paper is in the bank. Where the plant is
# unstable alone moves have a high price: such a law is at the bounds of r~ less often.
BANK = (
    (150.0, (("W[1]", 0.31), ("W[2]", -0.31))),
    (150.0, (("W[1]", 0.27), ("W[2]", -0.27))),
    (150.0, (("W[1]", 0.33), ("W[2]", -0.28))),
    (0.1, (("W[1]", 0.02), ("W[2]", -0.02))),
    (0.1, (("d1", 0.45), ("d2", 0.45))),
    (0.1, (("d1", 0.65), ("d2", 0.65))),
    (10.0, (("d1", 0.5), ("d2", 5.5))),
    (10.0, (("d1", 0.6), ("d2", 5.65))),
    (10.0, (("d1", 0.6), ("d2", 5.9))),
    (100.0, (("d1", 5.4), ("d2", 0.5))),
    (100.0, (("d1", 5.65), ("d2", 0.6))),
    (100.0, (("d1", 5.9), ("d2", 0.6))),
)
ROBUST = {
    "base": "bank",
    "bank": BANK,
    "correction": 1.0,
    "pairs.rounds": 0,
    "compared": 0,
    "history": 80,  # longer than the longest delay
    "integral_steps": 50.0,
    "reward.beta_h": 0.0,
    "reward.rest": 0.02,
    "reward.huber": 0.0,
    "disturbances.noise": 0.0125,
    "disturbances.load": 0.0,
    "pretraining.gradient_steps": 10_000,
    "pretraining.closed_loop": 128,
    "pretraining.lags": 100,
    "pretraining.episode_steps": 400,
    "pretraining.log_above": 1.0,
}


def _delayed(d1: float, d2: float, **rest: Any) -> Scenario:
    def long_enough(params: Any) -> Any:
        return params.replace(max_delay=max(params.max_delay, MAX_DELAY))

    return Scenario((SETPOINT,), {"d1": d1, "d2": d2}, paper=DELAYED, adapt=long_enough, **rest)


def _vary(*names: str, longest: float | None = None) -> Any:
    """Vary these parameters, of which delays are at most `longest` (s)."""

    def vary(params: Any, repeats: int, *values: jax.Array) -> Any:
        del repeats
        lines = {} if longest is None else {"max_delay": max(params.max_delay, longest), "late": None}
        return params.replace(**dict(zip(names, values, strict=True)), **lines)

    return vary


# The longest delay sets the length of the delay lines, and with it the cost of a step: keep it short.
PITCH = Task(
    make=pitch.make,
    presets={"default": DEFAULT, "scratch": SCRATCH, "record": RECORD, "robust": ROBUST, "paper": {}},
    scenarios={
        "paper": Scenario((SETPOINT,), paper=(10.91, 3.90)),
        "delay-0.57": _delayed(0.57, 0.57),
        "delay-5.7": _delayed(5.7, 0.57, stable_alone=False),
        "delay-swapped": _delayed(0.57, 5.7, stable_alone=False),
        "uncertainty": Scenario((SETPOINT,), {"W": W_PRINTED}, stable_alone=False),
        "load": Scenario((SETPOINT,), change={"disturbance": 2.0}),
        "noise": Scenario((SETPOINT,), episodes=NOISE_SEEDS, noise=0.2),
    },
    reported=("paper", "delay-5.7", "delay-0.57", "delay-swapped"),
    stability=("paper", "delay-0.57", "delay-5.7", "delay-swapped", "uncertainty"),
    sweeps={
        "pilot-delay": Sweep("paper", (Axis.linear("tau", "s", 0.0, 2.0, 21, 0.5),), _vary("tau", longest=2.0)),
        "controller-delays": Sweep(
            "paper",
            (Axis.linear("d1", "s", 0.0, 6.0, 25, 0.0), Axis.linear("d2", "s", 0.0, 6.0, 25, 0.0)),
            _vary("d1", "d2", longest=6.0),
            stride=6,
        ),
        "gain": Sweep("paper", (Axis.linear("gain", "1", 0.5, 1.5, 21, 1.0),), _vary("gain")),
        "sensor-noise": Sweep("paper", (Axis.linear("noise", "crad", 0.0, 1.0, 21, 0.0),), repeats=8),
    },
)
