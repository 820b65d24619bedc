"""How long plants outside JAX take, and in what groups their episodes go."""

import json
import re
from unittest.mock import patch

import jax
import numpy as np
import pytest

from jaxouter import evaluate, plants, train
from jaxouter.api import learning
from jaxouter.evaluation import comparison, pace, scenarios
from jaxouter.evaluation.policies import baseline
from jaxouter.evaluation.policies import evaluate_on as evaluated
from jaxouter.evaluation.rollout import rollout
from jaxouter.identification import records, steady_state
from jaxouter.loop.policy import none
from jaxouter.plants import host
from jaxouter.progress import showing
from jaxouter.training.run import RunFolder
from tests.training.small import TINY, small

NAMES = ["mine/steps", "mine/staircase", "mine/ramps"]
DECLARED = dict(y_unit="cm", time_unit="s", control_step=0.1, episode_steps=20, family_steps=20)
DECLARED |= dict(r_tilde_bounds=(-2.0, 2.0), setpoint_range=(-0.5, 0.5), history=3)


class Lag:
    """A simulator that fails in its `broken`-th control step of all."""

    made, steps, broken = 0, 0, None

    def __init__(self):
        Lag.made += 1

    def reset(self, seed):
        self.y = np.random.default_rng(seed).uniform(-0.5, 0.5)
        return self.y

    def step(self, r_tilde):
        Lag.steps += 1
        if Lag.steps == Lag.broken:
            raise RuntimeError("no licence any more")
        self.y += 0.2 * (0.5 * r_tilde - self.y)
        return self.y


@pytest.fixture
def mine(monkeypatch):
    """A plant of which two episodes go side by side, in the registry."""
    for name, value in (("made", 0), ("steps", 0), ("broken", None)):
        monkeypatch.setattr(Lag, name, value)
    made = host.plant(Lag, name="mine", side_by_side=2, **DECLARED)
    with patch.dict(plants.REGISTRY, mine=lambda: made):
        yield made


@pytest.fixture
def slow(mine, monkeypatch):
    """As if a control step took 7 ms."""
    monkeypatch.setattr(host, "step_seconds", lambda plant: None if host.of(plant) is None else 7e-3)
    return mine


@pytest.mark.usefixtures("slow")
def test_episodes_take_no_longer_than_the_time_there_is():
    each = 7e-3 * 3 * 20  # s, of an episode on each scenario
    assert pace.seconds(NAMES, None, 2) == pytest.approx(2 * 64 * each)
    assert pace.seconds(["pitch/paper"], None, 2) == 0.0
    found = [pace.affordable(NAMES, 2, factor * 2 * each) for factor in (0.1, 1.1, 7.9, 8.1, 63.0, 1e6)]
    assert found == [1, 1, 4, 8, 32, 64]
    assert pace.affordable(["pitch/paper"], 2, 1.0) is None
    assert pace.told(NAMES, None, 2) == "3 scenarios of 64 episodes: about 54 s, at 7 ms a control step"
    assert [pace.duration(s) for s in (42.0, 120.0, 9000.0)] == ["42 s", "2 min", "2.5 h"]


def test_episodes_go_in_groups_of_as_many_as_may_be_side_by_side(mine):
    """With the same result, without going through any twice, and with no more simulators than needed."""
    plant, _ = mine
    scenario = scenarios.get("mine/steps", 5)
    grouped = rollout(*none(plant), scenario)
    assert (Lag.steps, Lag.made) == (100, 4)
    with patch.object(host.of(plant), "side_by_side", 64):
        whole = rollout(*none(plant), scenario)
    jax.tree.map(np.testing.assert_array_equal, grouped, whole)
    before = Lag.steps
    assert records.record(*mine, jax.random.key(0), 5).y.shape == (5, 21)
    assert (Lag.steps - before, Lag.made) == (100, 10)


def test_what_is_known_of_the_inner_loop_is_not_run_again(mine):
    alone = evaluated(baseline("none", "mine"), [scenarios.get("mine/steps", 4)])
    before = Lag.steps
    found = evaluated(baseline("static", "mine"), [scenarios.get("mine/steps", 4)], alone=alone)
    assert Lag.steps - before <= 4 * 20 + steady_state.LEVELS * 20
    again = evaluated(baseline("static", "mine"), [scenarios.get("mine/steps", 4)])
    assert found["mine/steps"][1] == again["mine/steps"][1]


@pytest.mark.usefixtures("slow")
def test_evaluation_and_comparison_say_how_long_they_take(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pace, "SAID", 5.0)
    evaluate.main(["--policy", "none", "--plant", "mine", "--scenario", "mine/steps"])
    assert "1 scenario of 64 episodes: about 9 s, at 7 ms a control step; --episodes N" in capsys.readouterr().out
    evaluate.main(["--policy", "none", "--plant", "mine", "--scenario", "mine/steps", "--episodes", "2"])
    assert "about" not in capsys.readouterr().out
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    selected = comparison.select("mine", policies=["none", "mpc"], out=tmp_path / "out")
    assert re.match(
        r"the plant takes 7 ms a control step: up to \d+ min, where nothing of it is", comparison.told(selected)
    )


@pytest.mark.usefixtures("mine")
def test_a_run_that_learned_nothing_leaves_no_folder(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Lag, "broken", 8 * 20 + 7)  # in the record
    with pytest.raises(SystemExit) as end:
        train.main(["mine", *TINY])
    assert end.value.code == 2
    assert re.search(r"error: plant mine, control step \d of the episode with seed \d+, r~ = ", capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("slow")
def test_after_the_training_of_a_slow_plant_there_are_few_episodes(capsys, tmp_path, monkeypatch):
    """As many as are asked for, or as take no longer than learning did."""
    run = RunFolder.create(small("mine"), tmp_path / "run")
    trainer, params = run.trainer
    finals = {0: trainer.fresh(jax.random.key(0), params)}
    monkeypatch.setattr(learning, "draw", lambda *_: None)
    for seconds, asked, episodes in ((4.5, None, 4), (4.5, 2, 2)):
        rows = [{"seconds": 3 * 3 * 20 * 7e-3 * seconds}]  # of three policies on three scenarios
        monkeypatch.setattr(RunFolder, "rows", lambda run, seed, rows=rows: rows)
        with showing(True) as progress:
            learning.report(run, finals, progress, asked)
        text = "evaluation: 3 scenarios of 4 episodes: about 5 s, at 7 ms a control step, as long as learning took"
        assert (text in capsys.readouterr().out) == (episodes == 4)
        assert set(json.loads((run.path / "summary.json").read_text())["episodes"].values()) == {episodes}
    assert train.parse(["--resume", str(run.path), "--episodes", "2"]).episodes == 2
    with pytest.raises(SystemExit):
        train.main(["mine", "--episodes", "0"])
    assert "--episodes is 0; it must be at least 1" in capsys.readouterr().err
