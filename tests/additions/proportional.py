"""A baseline that is tuned: r~ = r plus a gain on r - y."""

from dataclasses import dataclass

import jax.numpy as jnp

from jaxouter.evaluation.baselines import Baseline, Tuned
from jaxouter.evaluation.baselines.tuning import score, training_episodes


@dataclass(frozen=True)
class P:
    bounds: tuple[float, float]
    host: bool = False

    def init(self, params, r0, y0):
        return ()

    def act(self, params, carry, r, y, key=None):
        return carry, jnp.clip(r + params * (r - y), *self.bounds)


def tune(plant, params, key, budget, report):
    episodes, gains = training_episodes(plant, params, key), (0.0, 0.5, 1.0, 2.0)
    best = max(gains, key=lambda gain: score(P(plant.r_tilde_bounds), jnp.asarray(gain), episodes))
    return Tuned({"gain": best}, {}, len(gains) * episodes.r.size)


def build(plant, tuned):
    return P(plant.r_tilde_bounds), jnp.asarray(tuned.settings["gain"])


Proportional = Baseline("baseline", tune, build, "r~ = r + gain (r - y).")
