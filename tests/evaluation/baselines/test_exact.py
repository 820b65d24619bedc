"""Policies that are made from the true plant, on the lag."""

import jax
import pytest

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.baselines import BASELINES, exact, lq, mpc
from jaxouter.evaluation.baselines.tuning import training_episodes
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.policies import baseline, evaluate, evaluate_on
from jaxouter.evaluation.rollout import rollout
from tests import lag

KEY = jax.random.key(0)
RECORD = 16  # episodes


@pytest.fixture(scope="module", autouse=True)
def small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exact, "RECORD", RECORD)
        yield


def error(policy, params) -> float:
    """On training episodes that none has seen."""
    return mae(rollout(policy, params, training_episodes(*lag.make(), jax.random.key(1))))


@pytest.mark.slow
def test_the_exact_law_is_no_worse_than_that_of_a_record():
    plant, params = lag.make()
    found, history = exact.law(plant, params, KEY)
    assert found.settings is not None
    assert history == plant.history
    tuned = exact.tune_lq(plant, params, KEY, 0, lambda text, share: None)
    of_record = lq.tune("mae", plant, params, KEY, 0, lambda text, share: None)
    assert error(*lq.build(plant, tuned)) < 1.005 * error(*lq.build(plant, of_record))


@pytest.mark.slow
def test_exact_mpc_is_no_worse_than_that_of_a_record():
    plant, params = lag.make()
    tuned = [make(plant, params, KEY, 40_000, lambda text, share: None) for make in (exact.tune_mpc, mpc.tune)]
    ours, theirs = (error(*mpc.build(plant, each)) for each in tuned)
    assert ours < 1.005 * theirs


@pytest.mark.slow
def test_in_a_scenario_of_another_plant_it_is_made_from_that_plant():
    own = evaluate("lq-exact", "pitch", "delay-0.57", progress=False)["pitch/delay-0.57"].figures.mae
    nominal = evaluate_on(baseline("lq-exact", "pitch"), [scenarios.get("pitch/delay-0.57")])
    assert own is not None
    assert own < 0.9 * (nominal["pitch/delay-0.57"].figures.mae or 0.0)


def test_they_are_limits():
    assert {BASELINES[name].kind for name in ("lq-exact", "mpc-exact", "oracle")} == {"limit"}
