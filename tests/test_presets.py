"""The default presets reach what they promise (slow: each trains for a minute or two)."""

import json
from unittest.mock import patch

import pytest

from jaxouter import plants, train
from jaxouter.evaluation import policies, scenarios
from jaxouter.evaluation.metrics import held
from jaxouter.evaluation.rollout import rollout
from jaxouter.plants import registry
from jaxouter.training.run import RunFolder
from tests.load import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def learned(plant: str, folder) -> dict:
    train.main([plant, "--out", str(folder / "run")])
    results = json.loads((folder / "run" / "summary.json").read_text())["results"]
    return next(result["scenarios"] for result in results if result["policy"] == "learned")


def test_default_pitch_beats_the_static_prefilter_and_the_paper(tmp_path):
    figures = learned("pitch", tmp_path)["pitch/paper"]
    assert figures["mae"] < 3.00  # static prefilter 3.404, the paper's DRL 3.90
    assert figures["violation_time"] == 0.0


def test_default_heaters_beat_the_paper_in_comfort(tmp_path):
    scenarios = learned("heaters", tmp_path)
    assert scenarios["heaters/paper-4"]["mae"] <= 0.90  # the paper 1.17
    assert scenarios["heaters/paper-1000"]["mae"] <= 0.80  # the paper 1.31
    assert scenarios["heaters/paper-1000"]["violation_time"] == 0.0


def test_default_on_a_plant_of_ones_own_beats_static_and_pi_on_every_family(tmp_path):
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        figures = learned(f"{ROOT}/scripts/examples/tanks.py:Tanks", tmp_path)
        for baseline in (policies.baseline(name, "Tanks") for name in ("static", "pi")):
            for identifier, (_, of_baseline) in policies.evaluate_on(baseline, map(scenarios.get, figures)).items():
                assert figures[identifier]["mae"] < 0.5 * of_baseline.mae


@pytest.mark.parametrize("name", ["delay-0.57", "delay-swapped"])
def test_robust_pitch_holds_delayed_plants_of_which_one_is_unstable_alone(name, robust):
    scenario = scenarios.perturbed(f"pitch/{name}")
    assert held(rollout(*robust, scenario), scenario.plant) >= 0.95


@pytest.fixture(scope="module")
def robust(tmp_path_factory):
    """Policy and its parameters."""
    folder = tmp_path_factory.mktemp("robust") / "run"
    train.main(["pitch", "--preset", "robust", "--out", str(folder)])
    run = RunFolder.open(folder)
    return run.trainer[0].policy, run.trainer[0].policy_params(run.load(0)[0])
