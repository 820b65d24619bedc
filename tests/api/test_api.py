"""The library: what `import jaxouter` offers does what the commands do."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import jax
import numpy as np
import pytest
from rich.console import Console

import jaxouter
from jaxouter import plants, train
from jaxouter.api import Stopped, learning
from jaxouter.evaluation import compare, evaluate, jobs
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.plants import registry
from jaxouter.progress import Progress
from jaxouter.training.choice import Choice
from jaxouter.training.config import preset
from jaxouter.training.pretraining import DifferentiableRollout
from jaxouter.training.run import RunFolder
from tests.additions import room

ROOM = str(Path(__file__).parents[1] / "additions" / "room.py") + ":Room"
TERM = str(Path(__file__).parents[1] / "additions" / "gentle.py") + ":Gentle"


HEARD: list[tuple[int, dict]] = []  # of the epochs of the run


@pytest.fixture(scope="module", autouse=True)
def own_plants():
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "room"
    return jaxouter.learn(
        ROOM, "quick", out=path, progress=False, set={"tau": 4}, on_epoch=lambda *each: HEARD.append(each)
    )


def parameters(path: Path) -> list[np.ndarray]:
    with np.load(max(path.glob("seed-0/checkpoint-*.npz"))) as arrays:
        return [arrays[name] for name in arrays.files if np.issubdtype(arrays[name].dtype, np.number)]


def test_what_there_is():
    assert {"Agent", "Plant", "Policy", "Run", "learn", "load", "make", "resume"} < set(dir(jaxouter))
    for name in dir(jaxouter):
        assert getattr(jaxouter, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'teach'"):
        jaxouter.teach  # noqa: B018
    assert (Path(jaxouter.__file__).parent / "py.typed").exists()


@pytest.mark.parametrize(
    "begin", ["import jaxouter; jaxouter.make", "import jaxouter.runtime.gymnasium", "import jaxouter.runtime.gymnax"]
)
def test_recorded_data_is_a_plant_for_whoever_imports_no_more_than_this(begin):
    code = f"{begin}; from jaxouter.plants.registry import KINDS; print(*KINDS)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "gym fmu log\n", done.stderr


def test_what_does_not_suit_the_plant_is_said_before_anything_is_learned(monkeypatch):
    found = Choice(preset("pitch"), "identified: dead time 40", ("the dead time does not fit",))
    monkeypatch.setattr(learning, "choose", lambda config: found)
    out = io.StringIO()
    with pytest.warns(learning.ChoiceWarning, match="the dead time does not fit"):
        learning.chosen(preset("pitch"), Progress(Console(file=out)))
    assert out.getvalue() == "pitch: identified: dead time 40\n"


def test_a_run_is_that_of_the_command_to_the_last_bit(run, tmp_path, capsys):
    train.main([ROOM, "--preset", "quick", "--set", "tau", "4", "--out", str(tmp_path / "run")])
    capsys.readouterr()
    one, other = (json.loads((path / "config.json").read_text()) for path in (run.path, tmp_path / "run"))
    assert one == other
    for a, b in zip(parameters(run.path), parameters(tmp_path / "run"), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_bank_of_laws_is_learned_on_told_and_exported(tmp_path):
    of_two = tuple((0.1, (("tau", tau),)) for tau in (3.0, 6.0))
    start = {"gradient_steps": 2, "episodes": 8, "closed_loop": 4, "batch_size": 4}
    found = jaxouter.learn(
        ROOM, "record", out=tmp_path / "run", progress=False, base="bank", bank=of_two, compared=0, pretraining=start
    )
    assert [each.policy for each in found.summary.results] == ["learned", "none", "static", "bank"]
    assert set(found.summary.places.values()) <= {"inside", "edge", "outside"}
    assert (found.policy.spec.laws, found.policy.policy.observer.laws) == (2, 2)
    assert "verified" in found.export(tmp_path / "controller.npz", force=True)


def test_its_path_config_metrics_and_summary(run):
    assert run.config.plant == "Room(tau=4)"
    assert (run.seed, run.seeds) == (0, (0,))
    row = run.metrics[-1]
    (learned, *_) = run.summary.results
    assert row["mae"] == pytest.approx(learned.scenarios["Room(tau=4)/day"].mae)
    assert "Room(tau=4)" in repr(run)
    assert repr(run.policy) == "<RunPolicy learned for Room(tau=4)>"
    assert run.of_seed(0).policy.spec.plant == "Room(tau=4)"
    with pytest.raises(ValueError, match=r"seed is 7; .* has: 0"):
        run.of_seed(7)


def test_each_epoch_was_told_with_its_row_of_the_metrics(run):
    assert [(seed, row["epoch"]) for seed, row in HEARD] == [(0, row["epoch"]) for row in run.metrics]
    assert [row["mae"] for _, row in HEARD] == [row["mae"] for row in run.metrics]


def test_the_policy_and_its_controller_agree(run):
    loaded = jaxouter.load(run.path, plant=ROOM).policy
    controller, carry, y = loaded.controller(), loaded.init(20.0, 18.0), 18.0
    for _ in range(5):
        carry, r_tilde = loaded.act(carry, 20.0, y)
        assert controller.step(20.0, y) == pytest.approx(float(r_tilde), abs=1e-4)
        y += (0.8 * float(r_tilde) - y) / 4.0


def test_it_is_evaluated_drawn_and_exported(run, tmp_path):
    found = run.evaluate(progress=False)
    assert list(found) == [f"Room(tau=4)/{name}" for name in ("day", "frost", "steps", "rest", "rest-noise")]
    assert found["Room(tau=4)/day"].figures.mae == pytest.approx(run.metrics[-1]["mae"])
    slower = run.evaluate("day", set={"tau": 6.0}, progress=False)
    assert list(slower) == ["Room(tau=6.0)/day"]
    assert run.plot(path=tmp_path / "day.png")._repr_png_().startswith(b"\x89PNG")
    assert (tmp_path / "day.png").exists()
    assert run.export(tmp_path / "controller.npz", force=True, progress=False).startswith("verified: ")
    with pytest.raises(ValueError, match=r"controller.npz exists; remove it"):
        run.export(tmp_path / "controller.npz", force=True)
    with pytest.raises(ValueError, match=r"a.exe must end in the name of a format; the formats are: onnx, npz"):
        run.export(tmp_path / "a.exe")


def test_it_is_compared_on_its_plant_with_other_parameters(run, tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    own = {"set": {"outside": 5.0}, "out": tmp_path / "out", "progress": False}
    found = compare(ROOM, run.path, "static", "day", ["Room/tau"], **own)
    assert found.plant == "Room(tau=4, outside=5.0)"
    assert [row.policy for row in found.rows] == ["learned", "none", "static"]
    (axis,) = found.sweeps["Room(tau=4, outside=5.0)/tau"].axes
    assert (axis.nominal, axis.values) == (4, (2.0, 3.0, 4, 6.0))
    assert {path.name for path in Path(found.folder).iterdir()} > {"report.html", "comparison.json"}
    assert repr(found).startswith("<Comparison of learned, none, static on Room(tau=4, outside=5.0): ")


def test_a_policy_of_ones_own_and_baselines_are_evaluated_alike(run):
    class Offset:
        host = True

        def init(self, params, r0, y0):
            return ()

        def act(self, params, carry, r, y, key=None):
            return carry, 1.25 * r

    ours = evaluate(Offset(), run.config.plant, "day", progress=False)["Room(tau=4)/day"].figures.mae
    none = evaluate("none", run.config.plant, ["Room/day"], progress=False)["Room(tau=4)/day"].figures.mae
    assert ours < none
    with pytest.raises(ValueError, match="clairvoyant is a bound"):
        evaluate("clairvoyant", run.config.plant, progress=False)


def test_in_a_thread_and_silent(tmp_path, capsys):
    found = []
    thread = threading.Thread(
        target=lambda: found.append(jaxouter.learn(ROOM, "quick", out=tmp_path / "run", progress=False, set={"tau": 4}))
    )
    thread.start()
    thread.join()
    assert found[0].path == tmp_path / "run"
    assert capsys.readouterr() == ("", "")


MISTAKES = [
    (dict(plant="boat"), "there is no plant 'boat'"),
    (dict(preset="best"), "there is no preset 'best' for pitch; the presets are: default, scratch, record, robust,"),
    (dict(steps=-1), "steps is -1; it must be positive"),
    (dict(pretraining={"gradient_step": 1}), "there is no option 'pretraining.gradient_step'; there are: "),
    (dict(pretraining=5), "pretraining is 5; it has settings of its own, such as pretraining.gradient_steps"),
    (dict(pretraining={"gradient_steps": "5"}), "pretraining.gradient_steps is of type str; it must be int"),
    (dict(agent={"discounts": 0.9}), "there is no option 'agent.discounts'; there are: agent."),
    (dict(agent={"name": "sarsa"}), "there is no agent 'sarsa'"),
    (dict(stops=1), "there is no option 'stops'; there are: agent, seed"),
    (dict(episodes=0), "--episodes is 0; it must be at least 1"),
    (dict(reward={"alpha_g": -1.0}), "reward.alpha_g is -1.0; it must not be negative"),
    (dict(set={"tou": 1.0}), "plant 'pitch' has no parameter tou; it has: tau, d1, d2, W, "),
    (dict(set={"W": (0.1, 0.2)}), "W has shape (2,); it must be an array of shape (3,)"),
    (dict(set={"tau": "slow"}), "tau is 'slow'; it must be a number"),
    (dict(set={"tau": -1.0}), "tau is -1 s; a delay must lie in "),
    (dict(agent="sarsa"), "there is no agent 'sarsa'"),
]


@pytest.mark.parametrize(("given", "text"), MISTAKES, ids=[text[:24] for _, text in MISTAKES])
def test_mistakes_are_value_errors_that_say_what_is_allowed(given, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as error:
        jaxouter.learn(progress=False, **given)
    assert text in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_reward_term_of_ones_own_is_trained_on_and_told_apart(tmp_path):
    run = jaxouter.learn(TERM, "quick", out=tmp_path / "run", progress=False, reward={"alpha_g": 0.6})
    row, reward = run.metrics[-1], run.summary.reward
    assert row["reward_gentle"] < 0.0
    assert (reward.trained["alpha_g"], reward.reported["alpha_g"], reward.terms) == (0.6, 0.3, ["gentle"])
    learned, none, *_ = run.summary.results
    for each in (learned, none):
        figures = each.scenarios["Gentle/day"]
        assert each.trained_return["Gentle/day"] < figures.episode_return - 0.3 * figures.mae * 40
    trainer, params = RunFolder(run.path, run.config).trainer
    terms = []
    for weight in (0.0, 1.0):
        price = replace(run.config.reward, terms=weight)
        episodes = TrainingEpisodes(trainer.env.plant, reward=price)
        rollout = DifferentiableRollout.of(run.config.pretraining, episodes, trainer.policy, 1)
        terms.append(rollout.mean_reward(run.policy.params, params.plant, jax.random.key(0)))
    assert terms[1] < terms[0]


def test_a_stopped_run_says_how_to_go_on_and_does(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "_trained", lambda *_: None)
    with pytest.raises(Stopped, match=f"saved; resume with: python -m jaxouter.train --resume {tmp_path}/run"):
        jaxouter.learn(ROOM, "quick", out=tmp_path / "run", progress=False, set={"tau": 4})
    monkeypatch.undo()
    stopped = jaxouter.load(tmp_path / "run", plant=ROOM)
    assert stopped.summary is None
    assert "Room(tau=4)/day" in jaxouter.resume(stopped.path, progress=False).summary.results[0].scenarios


@pytest.mark.slow
def test_a_plant_may_be_a_function_or_task_of_this_process(tmp_path):
    """Named nowhere but here; in its place may come another one of its name."""

    def cellar(outside=5.0):
        return room.make(outside=outside)

    settings = dict(base="static", pretraining={"gradient_steps": 2, "episodes": 2}, progress=False)
    run = jaxouter.learn(cellar, "record", out=tmp_path / "run", set={"outside": 2.0}, **settings)
    assert run.config.plant == "cellar(outside=2.0)"
    assert "a Python object cellar" in (run.path / "config.json").read_text()
    assert jaxouter.load(run.path, plant=cellar).policy.plant == "cellar(outside=2.0)"
    work = [jobs.Job("identify", jobs.Entrant(name, "baseline"), "cellar") for name in ("none", "static")]
    done = jobs.spread(work, lambda: None, lambda *_: None)  # which other processes could not be given
    assert [each.found.settings["slope"] for each in done] == pytest.approx([1.0, 1.25], rel=1e-4)
    assert jaxouter.make(cellar)[0].plant.name == "cellar"
    assert registry.add(room.Room) == "Room"
    assert registry.add(cellar) == "cellar"
    for wrong in (lambda: 1, lambda: 1 / 0):
        with pytest.raises(ValueError, match="the plant <function"):
            jaxouter.learn(wrong)


def test_a_controller_imports_no_jax():
    code = "import sys, jaxouter; from jaxouter.runtime import Controller; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
