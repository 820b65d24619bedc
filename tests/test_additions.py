"""A learner, a plant and a baseline of one's own, each in one file, through what the documentation promises alone."""

import json
import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxouter
from jaxouter import agents, evaluate, evaluation, export, live, plants, train
from jaxouter.agents.returns import generalised_advantage
from jaxouter.exports.spec import ControllerSpec
from jaxouter.plants import registry
from jaxouter.training import epochs
from jaxouter.training.config import configured
from jaxouter.training.run import RunFolder
from tests.load import ROOT

HERE = Path(__file__).parent / "additions"
LEARNER, PLANT, BASELINE = (
    f"{HERE}/{name}" for name in ("reinforce.py:Reinforce", "room.py:Room", "proportional.py:Proportional")
)
SETTINGS = dict(environments=16, epoch=6_400, history=2, reward_scale=0.1, steps=64_000)
STEP = "def step(r_tilde):\n    return 0.8 * r_tilde\n"


@pytest.fixture(autouse=True)
def known():
    """What is added here is forgotten."""
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS), patch.dict(agents.AGENTS):
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of the learner on the plant."""
    path = tmp_path_factory.mktemp("additions") / "run"
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS), patch.dict(agents.AGENTS):
        jaxouter.learn(PLANT, "paper", out=path, agent=LEARNER, seeds=2, progress=False, **SETTINGS)
    return path


def opened(folder) -> jaxouter.Run:
    return jaxouter.load(folder, plant=PLANT, agent=LEARNER)


def test_the_learner_learns(folder):
    rows = opened(folder).of_seed(0).metrics
    assert [row["updates"] for row in rows] == [20 * (i + 1) for i in range(10)]
    assert rows[-1]["mae"] < 0.5  # at first 2.1, by the static prefilter 0.42
    assert rows[-1]["reward"] > rows[0]["reward"]
    assert {"loss", "q_start", "return_start", "diverged", "no_action"} <= set(rows[-1])
    assert rows[-1]["q_start"] == 0.0  # of a learner without a value


def test_a_training_goes_on_where_it_was_stopped(folder, tmp_path):
    whole = opened(folder)
    run = RunFolder.create(replace(whole.config, seeds=1), tmp_path / "stopped")
    assert epochs.train(run, stop=lambda: True) is None
    assert epochs.train(run) is not None
    chex.assert_trees_all_equal(opened(run.path).policy.params, whole.of_seed(0).policy.params)


def test_a_run_whose_agent_is_not_named_says_so(folder, capsys):
    with pytest.raises(SystemExit):
        evaluate.main([str(folder), "--plant", PLANT])
    assert "there is no agent" in capsys.readouterr().err


def test_the_commands_know_them_by_their_files(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = ["--plant", PLANT, "--agent", LEARNER]
    evaluate.main([str(folder), *named, "--json", "found.json"])
    assert set(json.loads(Path("found.json").read_text())["scenarios"]) == {
        f"Room/{name}" for name in ("day", "frost", "steps", "rest", "rest-noise")
    }
    export.main([str(folder / "seed-0"), *named, "--format", "npz", "--out", "controller.npz", "--force"])
    assert ControllerSpec.load(Path("controller.npz")).plant == "Room"


@pytest.mark.slow
def test_compared_and_live(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = ["--plant", PLANT, "--agent", LEARNER]
    cases = [PLANT, [folder], [BASELINE, "static"], ["day", "frost"]]
    content = evaluation.compare(*cases, agents=[LEARNER], out="compare", progress=False)
    tuned = content.policies[BASELINE]
    assert (tuned.kind, tuned.note) == ("baseline", "r~ = r + gain (r - y).")
    assert tuned.settings["gain"] > 0
    assert set(content.sweeps) == {"Room/tau"}
    radii = [row.spectral_radius for row in content.stability if row.policy == "learned"]
    assert len(radii) == 2 * 19  # of the stability scenarios, at nineteen set-points each
    assert all(0.0 < radius < 1.0 for radius in radii)
    Path("loop.py").write_text(STEP)
    live.main(["loop.py:step", "--run", str(folder / "seed-0"), *named, "--dt", "0.05", "--steps", "20", "--learn"])
    assert json.loads((folder / "seed-0" / "live" / "summary.json").read_text())["counts"]["trained"] > 0


def test_the_plant_has_presets_scenarios_and_a_sweep_of_its_own(tmp_path):
    run = jaxouter.learn(PLANT, "quick", out=tmp_path / "run", progress=False, set={"tau": 4})  # as in test_api
    assert (run.config.preset, run.config.agent.hidden, run.config.pretraining.gradient_steps) == ("quick", (8, 8), 20)
    assert set(run.summary.results[0].scenarios) == {"Room(tau=4)/day"}


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"pretraining.gradient_step": 1},
            "there is no option 'pretraining.gradient_step'; there are: pretraining.gra",
        ),
        ({"pretraining.gradient_steps": "many"}, "pretraining.gradient_steps is of type str; it must be int"),
        ({"agent.hidden": 8}, "is of type int; it must be array"),
        ({"agent": "dqn"}, "there is no agent 'dqn'"),
    ],
)
def test_a_preset_of_ones_own_that_is_wrong_is_named(options, text):
    with pytest.raises(ValueError, match=f"{re.escape(text)}"):
        configured("Room", "quick", {"agent": "ddpg", **options})


@pytest.mark.parametrize(("terminated", "truncated"), [([], []), ([3], []), ([], [3]), ([1], [4]), ([5], [5])])
def test_advantages_are_the_sum_written_out(terminated, truncated):
    """For running, terminated and truncated episodes."""
    n, discount, decay = 6, 0.9, 0.8
    rng = np.random.default_rng(0)
    reward, value, after = rng.normal(size=(3, n))
    ended, cut = np.isin(np.arange(n), terminated), np.isin(np.arange(n), truncated)
    delta = reward + discount * np.where(ended, 0.0, after) - value
    expected = np.zeros(n)
    for k in range(n):
        for j in range(k, n):
            expected[k] += (discount * decay) ** (j - k) * delta[j]
            if ended[j] or cut[j]:
                break
    given = (jnp.asarray(x, float) for x in (reward, value, after))
    found = generalised_advantage(*given, jnp.asarray(ended), jnp.asarray(ended | cut), discount, decay)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_gradient_is_that_of_the_expected_reward():
    """On a probe of one step whose reward is linear in the action, its gradient in the mean is known."""
    config = registry.attribute(HERE / "reinforce.py", "Reinforce", "")(rate=1.0)
    agent = config.build(3)
    state = agent.init(jax.random.key(0))
    obs = jnp.broadcast_to(jnp.array([0.5, -1.0, 2.0]), (200_000, 3))
    normal = jax.random.normal(jax.random.key(1), (200_000, 1))
    explore = jax.vmap(agent.explore, (None, None, 0, 0, None, None))
    action, _, sample = explore(state, (), obs, normal, jnp.array(False), jnp.array(0.0))
    batch = agents.agent.Experience(obs, action, sample, 2.0 * sample[:, 0], jnp.zeros(200_000))
    after, _ = agent.update(state, batch, jax.random.key(2))
    moved = jax.tree.map(jnp.subtract, after, state)
    expected = jax.grad(lambda actor: 2.0 * agents.networks.act(config.hidden, actor, obs[0])[0])(state)
    for found, wanted in zip(jax.tree.leaves(moved), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=0.02, atol=0.01 * float(jnp.abs(wanted).max()))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--agent", "dqn"], "there is no agent 'dqn'; the agents are: ddpg"),
        (["--agent", f"{HERE}/room.py:ROOM"], "it must be a subclass of jaxouter.agents.AgentConfig"),
        (["--agent", f"{ROOT}/jaxouter/agents/agent.py:AgentConfig"], "does not define build, data"),
        (
            ["--agent", LEARNER, "--environments", "16", "--epoch", "6400", "--steps", "1008"],
            "steps is 1008; it must be a multiple of 320: agent.unroll = 20 steps of 16 env",
        ),
    ],
)
def test_mistakes_are_named(options, text, capsys):
    with pytest.raises(SystemExit):
        train.main([PLANT, *options, "--dry-run"])
    assert text in " ".join(capsys.readouterr().err.split())
