"""The policies that the learned one is compared with: what an engineer would do in its place, and the limits.

Each is identified and tuned on the training distribution, through r~ and y alone, by the same figure that the learner
maximises; `oracle`, `lq-exact`, `mpc-exact` and `clairvoyant` know more and say what is possible at all.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache as cache_of_functions
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import chex
import jax

from jaxouter.evaluation import cache
from jaxouter.evaluation.baselines import deepc, exact, inverse, lq, mpc, oracle, pi
from jaxouter.evaluation.baselines.tuning import Report
from jaxouter.evaluation.cache import Tuned
from jaxouter.evaluation.scenarios import Known
from jaxouter.identification import steady_state
from jaxouter.loop.policy import Linear, Policy, affine
from jaxouter.plants import Plant, make
from jaxouter.plants.registry import attribute

Kind = Literal["baseline", "limit", "preview", "learned", "user"]
CLAIRVOYANT = "clairvoyant"
OWN = "a policy of your own"


class Baseline(NamedTuple):
    """How a policy comes about."""

    kind: Kind
    tune: Callable[..., Tuned]
    """`tune(plant, params, key, budget, report)`; of a limit, unless it is your own, also `noise`, see `Known`."""
    build: Callable[[Plant, Tuned], tuple[Policy, Any]]
    note: str


def _none(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    return Tuned({"slope": 1.0, "offset": 0.0}, {}, 0)


def _static(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    identified = steady_state.dc_gain(plant, params, key)
    _, found = steady_state.prefilter(plant, identified)
    settings = {"slope": float(found.r), "offset": float(found.offset), "unsettled": identified.unsettled}
    return Tuned(settings, {}, steady_state.LEVELS * plant.episode_steps)


def _affine(plant: Plant, tuned: Tuned) -> tuple[Policy, Any]:
    steady_state.warn_unsettled(tuned.settings.get("unsettled"))
    return Linear(plant.r_tilde_bounds), affine(*(tuned.settings[name] for name in ("slope", "offset")))


BASELINES: dict[str, Baseline] = {
    "none": Baseline("baseline", _none, _affine, "The inner loop alone: r~ = r."),
    "static": Baseline(
        "baseline", _static, _affine, "Inverse of the affine DC gain, from 8 constant-r~ episodes; r~ = r without one."
    ),
    "lq": Baseline(
        "baseline", partial(lq.tune, "mae"), lq.build, "Linear-quadratic law of an ARX model, from a record."
    ),
    "lq-return": Baseline(
        "baseline", partial(lq.tune, "return"), lq.build, "The same, chosen by the return instead of the MAE."
    ),
    "pi": Baseline("baseline", pi.tune, pi.build, "Static prefilter and PI with anti-windup, gains by COBYQA."),
    "mpc": Baseline(
        "baseline",
        mpc.tune,
        mpc.build,
        "ARX model with dead time, observer with input disturbance, QP over r~ and its moves.",
    ),
    "deepc": Baseline(
        "baseline", deepc.tune, deepc.build, "Data-enabled predictive control on a record, without a model."
    ),
    "inverse": Baseline(
        "baseline", inverse.tune, inverse.build, "Network that learned r~ from past and future y, without preview."
    ),
    "oracle": Baseline(
        "limit",
        oracle.tune,
        oracle.build,
        "A correction of lq-exact by the learner's network, trained by back-propagation through the simulator.",
    ),
    "lq-exact": Baseline("limit", exact.tune_lq, lq.build, "LQ law of the true plant."),
    "mpc-exact": Baseline("limit", exact.tune_mpc, mpc.build, "MPC of the true plant."),
}
NAMES = (*BASELINES, CLAIRVOYANT)
BUDGET = 128_000  # environment steps that identification and tuning of a baseline may take
LIMITS = tuple(name for name, known in BASELINES.items() if known.kind == "limit")
SIMPLE = ("none", "static")  # what costs next to nothing


def identified(name: str, of: Known, report: Report = lambda text, share: None) -> Tuned:
    """What identification and tuning of a baseline found on a plant, once for all: it is kept in the cache.

    Args:
        name: of the baseline.
        of: the plant, and what more a limit knows of its scenario.
        report: called where it is not in the cache, at the beginning first.

    Raises:
        ValueError: there is no such plant or baseline, or the identification failed.
    """
    known, file = resolve(name), _file(name)
    plant, params = make(of.plant)
    sensor = {"noise": of.noise} if of.noise and file is None else {}

    def tune() -> Tuned:
        report("", 0.0)
        own = plant.noise_free(params) if of.smooth else params
        return known.tune(plant, own, jax.random.key(0), BUDGET, report, **sensor)

    key: dict[str, Any] = {"budget": BUDGET, **(of._asdict() if of.noise else {})}
    if file is not None:
        key |= {"name": name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    return cache.cached(f"{of.plant}-{name.rpartition(':')[2]}", key, tune)


@cache_of_functions
def resolve(name: str) -> Baseline:
    """The baseline of that name, or that of one's own which FILE.py:NAME is.

    Raises:
        ValueError: there is no such baseline.
    """
    file = _file(name)
    if file is None:
        if name not in BASELINES:
            raise ValueError(f"there is no policy {name!r}; the policies are: {', '.join(BASELINES)}, and FILE.py:NAME")
        return BASELINES[name]
    found = attribute(file, name.rpartition(":")[2], OWN)
    if not isinstance(found, Baseline):
        raise ValueError(f"{name} is {found!r}; it must be a jaxouter.evaluation.baselines.Baseline")
    return found


def _file(name: str) -> Path | None:
    file, colon, _ = name.rpartition(":")
    return Path(file) if colon and file.endswith(".py") else None
