"""The default presets reach what they promise (slow: each trains for a minute or two)."""

import json

import pytest

from jaxouter import train
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.metrics import held
from jaxouter.evaluation.rollout import rollout
from jaxouter.training.run import Run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


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


@pytest.mark.parametrize("name", ["delay-0.57", "delay-swapped"])
def test_robust_pitch_holds_delayed_plants_of_which_one_is_unstable_alone(name, robust):
    scenario = scenarios.perturbed(f"pitch/{name}")
    assert held(rollout(*robust, scenario), scenario.plant) >= 0.95


@pytest.fixture(scope="module")
def robust(tmp_path_factory):
    """Policy and its parameters."""
    folder = tmp_path_factory.mktemp("robust") / "run"
    train.main(["pitch", "--preset", "robust", "--out", str(folder)])
    run = Run.open(folder)
    return run.trainer[0].policy, run.trainer[0].policy_params(run.load(0)[0])
