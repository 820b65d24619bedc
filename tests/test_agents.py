"""Every learner of the library: from training to resuming, export, stability analysis and comparison."""

from dataclasses import fields

import chex
import numpy as np
import pytest

import jaxouter
from jaxouter import compare, plants
from jaxouter.agents import AGENTS
from jaxouter.api.learning import configured
from jaxouter.evaluation import stability
from jaxouter.tasks.presets import LEARNERS as OWN
from jaxouter.training import epochs
from jaxouter.training.run import RunFolder

SMALL = dict(hidden=(16, 16), batch_size=32, prefill=160, replay=800, updates=1, unroll=10, epochs=2, minibatches=2)
QUICK = {"epoch": 1_280, "agent.unroll": 20, "agent.epochs": 1, "agent.hidden": (8, 8), "compared": 8}
PLAN = dict(environments=8, epoch=160, steps=480, history=5, compared=8, pairs={"rounds": 0})
LEARNERS = [name for name in AGENTS if ".py:" not in name]


def settings(name):
    known = {field.name for field in fields(AGENTS[name])}
    return {"name": name, **{field: value for field, value in SMALL.items() if field in known}}


@pytest.fixture(scope="module", params=LEARNERS)
def run(request, tmp_path_factory):
    path = tmp_path_factory.mktemp(request.param) / "run"
    return jaxouter.learn("pitch", "scratch", agent=settings(request.param), out=path, progress=False, **PLAN)


def test_it_learns_and_says_what(run):
    rows = run.metrics
    compared = 2 * 8 * 200
    assert [row["steps"] for row in rows[:2]] == [320 + compared, 480 + 2 * compared]
    assert rows[1]["updates"] > rows[0]["updates"] > 0
    assert all(np.isfinite(value) for row in rows[:2] for value in row.values())
    assert {"skipped", "q_start", "return_start", "reward", "mae"} <= set(rows[0])
    assert all("kept" in row for row in rows)  # the last one compares with the base law alone


def test_a_training_goes_on_where_it_was_stopped(run, tmp_path):
    again = RunFolder.create(run.config, tmp_path / "stopped")
    assert epochs.train(again, stop=lambda: True) is None
    assert epochs.train(again) is not None
    chex.assert_trees_all_equal(jaxouter.load(again.path).policy.params, run.policy.params)


def test_its_policy_is_exported_to_c_and_onnx(run, tmp_path):
    for suffix in ("c", "onnx"):
        assert "in closed loop" in run.export(tmp_path / f"controller.{suffix}", force=True, progress=False)


def test_its_policy_is_analysed_at_an_equilibrium(run):
    plant, params = plants.make("pitch")
    (found,) = stability.analyse(run.policy.policy, run.policy.params, plant, params, [0.0])
    assert found.spectral_radius is not None
    assert 0.0 < found.spectral_radius < 1.5


@pytest.mark.parametrize("name", [name for name in LEARNERS if name != "ddpg"])
def test_another_agent_learns_from_scratch_with_the_settings_that_it_shares(name):
    config = configured("pitch", "default", name, None, {})
    assert (config.preset, config.base, config.pairs.rounds, config.agent.hold) == ("scratch", "static", 0, True)
    assert configured("heaters", "default", name, None, {}).agent.discount == 0.95  # as the plant's preset has it
    assert configured("pitch", "paper", name, None, {}).base == "absolute"


@pytest.mark.slow
def test_agents_are_compared_side_by_side_and_trained_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(OWN, "ppo", {**OWN["ppo"], **QUICK})
    asked = ["pitch", "--agent", "ppo", "--steps", "14500", "--scenario", "paper", "--policy", "static", "--sweep"]
    compare.main(asked)
    assert "learned" in capsys.readouterr().out
    run = jaxouter.load("runs/pitch-scratch-ppo")
    assert run.config.steps == 12_800 + 1_280  # what is left of whole unrolls is not used
    made = (run.path / "summary.json").stat().st_mtime_ns
    compare.main(asked)
    assert (run.path / "summary.json").stat().st_mtime_ns == made
    for wrong, text in ((["--seeds", "2"], "holds a run with other settings, steps or seeds"),):
        with pytest.raises(SystemExit) as ended:
            compare.main([*asked, *wrong])
        assert ended.value.code == 2
        assert text in capsys.readouterr().err
    with pytest.raises(SystemExit):
        compare.main(["pitch", "--seeds", "2"])
    assert "name them by --agent" in capsys.readouterr().err
