"""The baseline `lq`: on a plant that is unstable alone it has the law that learned policies correct there."""

import jax
import numpy as np
import pytest

from jaxouter.evaluation.baselines import lq
from jaxouter.evaluation.baselines.tuning import training_episodes
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rollout import rollout
from jaxouter.identification import unstable
from jaxouter.loop.policy import none
from tests import kinds

GROWING = kinds.kind([1.08], [0.04], divergence_bounds=(-12.0, 12.0))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxouter.identification.steady_state.IdentificationWarning")
def test_it_holds_a_plant_that_is_unstable_alone(monkeypatch):
    monkeypatch.setattr(lq, "RECORD", 16)
    monkeypatch.setattr(unstable, "CLOSED", 16)
    plant, params = GROWING()
    tuned = lq.tune("mae", plant, params, jax.random.key(0), 0, lambda text, share: None)
    assert tuned.steps > (lq.RECORD + unstable.CLOSED) * 2 * kinds.EPISODE
    episodes = training_episodes(plant, params, jax.random.key(1), 16)
    traces = rollout(*lq.build(plant, tuned), episodes)
    assert np.abs(traces.y).max() < 3.0
    assert mae(traces) < 0.3 < 10.0 < mae(rollout(*none(plant), episodes))
