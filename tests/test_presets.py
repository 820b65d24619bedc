"""The default presets reach what they promise (slow: each trains for a minute or two)."""

from dataclasses import replace
from unittest.mock import patch

import pytest

import jaxouter
from jaxouter import plants
from jaxouter.evaluation import policies, scenarios
from jaxouter.evaluation.metrics import FiguresOfMerit, held, mae
from jaxouter.evaluation.rollout import rollout
from jaxouter.loop import sensor
from jaxouter.plants import registry
from tests.load import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def learned(plant: str, folder) -> dict[str, FiguresOfMerit]:
    return jaxouter.learn(plant, out=folder / "run").summary.results[0].scenarios


def test_default_pitch_beats_the_static_prefilter_and_the_paper(tmp_path):
    figures = learned("pitch", tmp_path)["pitch/paper"]
    assert figures.mae < 3.00  # static prefilter 3.404, the paper's DRL 3.90
    assert figures.violation_time == 0.0


def test_default_heaters_beat_the_paper_in_comfort(tmp_path):
    scenarios = learned("heaters", tmp_path)
    assert scenarios["heaters/paper-4"].mae <= 0.90  # the paper 1.17
    assert scenarios["heaters/paper-1000"].mae <= 0.80  # the paper 1.31
    assert scenarios["heaters/paper-1000"].violation_time == 0.0


def test_default_on_a_plant_of_ones_own_beats_static_and_pi_on_every_family(tmp_path):
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        figures = learned(f"{ROOT}/scripts/examples/tanks.py:Tanks", tmp_path)
        for baseline in (policies.baseline(name, "Tanks") for name in ("static", "pi")):
            for identifier, (_, of_baseline) in policies.evaluate_on(baseline, map(scenarios.get, figures)).items():
                assert figures[identifier].mae < 0.5 * of_baseline.mae


SHARES = {"paper": 0.95, "delay-0.57": 0.95, "delay-5.7": 0.75, "delay-swapped": 0.95, "uncertainty": 0.4}


@pytest.mark.parametrize("name", SHARES)
def test_robust_pitch_holds_every_plant_of_the_paper(name, robust):
    """From rest, also with sensor noise of 0.1 crad; and this share of the starts drawn as in training."""
    alone, starts = scenarios.get(f"pitch/{name}"), scenarios.perturbed(f"pitch/{name}")
    noisy = replace(scenarios.get(f"pitch/{name}", 8), sensor=sensor.params(noise=0.1))
    for scenario in (alone, noisy):
        assert mae(rollout(*robust, scenario)) < 10.0
    assert held(rollout(*robust, starts), starts.plant) >= SHARES[name]


@pytest.fixture(scope="module")
def robust(tmp_path_factory):
    """Policy and its parameters, after a seventh of the preset's gradient steps."""
    out = tmp_path_factory.mktemp("robust") / "run"
    run = jaxouter.learn("pitch", "robust", out=out, pretraining={"gradient_steps": 1_500})
    return run.policy.policy, run.policy.params


def test_robust_heaters_serves_local_laws_between_slow_and_fast(tmp_path):
    """`riccati` has a local law that no law of the bank is made for; after a sixth of the gradient steps."""
    run = jaxouter.learn("heaters", "robust", out=tmp_path / "run", pretraining={"gradient_steps": 500})
    found = {name: run.evaluate(name)[f"heaters/{name}"].figures for name in ("riccati", "paper-1000")}
    assert found["riccati"].mae <= 1.0
    assert found["paper-1000"].mae <= 0.35
    assert found["paper-1000"].violation_time <= 0.005
