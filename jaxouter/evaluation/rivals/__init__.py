"""The policies that the learned one is compared with: what an engineer would do in its place, and the limits.

Each is identified and tuned on the training distribution, through r~ and y alone, by the same figure that the learner
maximises, the return; `oracle` and `clairvoyant` know more and say what is possible at all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.evaluation import cache
from jaxouter.evaluation.cache import Tuned
from jaxouter.evaluation.rivals import deepc, inverse, mpc, oracle, pi
from jaxouter.evaluation.rivals.tuning import Report
from jaxouter.loop import identify
from jaxouter.loop.policy import Affine, AffineParams, Policy
from jaxouter.plants import Plant, make

Kind = Literal["rival", "limit", "preview", "learned", "user"]
CLAIRVOYANT = "clairvoyant"


class Rival(NamedTuple):
    """How a policy comes about."""

    kind: Kind
    tune: Callable[[Plant, Any, chex.PRNGKey, int, Report], Tuned]
    build: Callable[[Plant, Tuned], tuple[Policy, Any]]
    note: str


def _none(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    return Tuned({"slope": 1.0, "offset": 0.0}, {}, 0)


def _static(plant: Plant, params: Any, key: chex.PRNGKey, budget: int, report: Report) -> Tuned:
    identified = identify.dc_gain(plant, params, key)
    _, found = identify.prefilter(plant, identified)
    settings = {"slope": float(found.slope), "offset": float(found.offset), "unsettled": identified.unsettled}
    return Tuned(settings, {}, identify.LEVELS * plant.episode_steps)


def _affine(plant: Plant, tuned: Tuned) -> tuple[Policy, Any]:
    identify.warn_unsettled(tuned.settings.get("unsettled"))
    slope, offset = (jnp.asarray(tuned.settings[name], float) for name in ("slope", "offset"))
    return Affine(plant.r_tilde_bounds), AffineParams(slope, offset)


RIVALS: dict[str, Rival] = {
    "none": Rival("rival", _none, _affine, "The inner loop alone: r~ = r."),
    "static": Rival(
        "rival", _static, _affine, "Inverse of the affine DC gain, from 8 constant-r~ episodes; r~ = r without one."
    ),
    "pi": Rival("rival", pi.tune, pi.build, "Static prefilter and PI with anti-windup, gains by COBYQA."),
    "mpc": Rival(
        "rival",
        mpc.tune,
        mpc.build,
        "ARX model with dead time, observer with input disturbance, QP over r~ and its moves.",
    ),
    "deepc": Rival("rival", deepc.tune, deepc.build, "Data-enabled predictive control on a record, without a model."),
    "inverse": Rival(
        "rival", inverse.tune, inverse.build, "Network that learned r~ from past and future y, without preview."
    ),
    "oracle": Rival(
        "limit", oracle.tune, oracle.build, "The learner's actor, trained by back-propagation through the simulator."
    ),
}
NAMES = (*RIVALS, CLAIRVOYANT)
BUDGET = 128_000  # environment steps that identification and tuning of a rival may take
SIMPLE = ("none", "static")  # what costs next to nothing


def identified(name: str, plant_name: str, report: Report = lambda text: None) -> Tuned:
    """What identification and tuning of a rival found on the nominal plant, once for all: it is kept in the cache.

    Raises:
        ValueError: there is no such plant or rival, or the identification failed.
    """
    if name not in RIVALS:
        raise ValueError(f"there is no policy {name!r}; the policies are: {', '.join(RIVALS)}")
    plant, params = make(plant_name)

    def tune() -> Tuned:
        return RIVALS[name].tune(plant, params, jax.random.key(0), BUDGET, report)

    return cache.cached(f"{plant_name}-{name}", {"budget": BUDGET}, tune)
