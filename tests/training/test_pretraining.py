"""Pretraining in small, and the runs that begin with it."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.evaluation.rivals.tuning import score, training_episodes
from jaxouter.loop import identify
from jaxouter.training.config import PretrainingConfig
from jaxouter.training.run import Run
from jaxouter.training.train import train
from jaxouter.training.trainer import build
from tests import lag
from tests.training.small import small

START = PretrainingConfig(gradient_steps=100, episodes=8, lags=4, batch_size=16)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


@pytest.fixture
def config():
    return small("lag", pretraining=START, residual=True, steps=640)


def test_an_actor_from_a_record_alone_beats_the_static_prefilter(config):
    trainer, params = build(config)
    heard = []
    state = trainer.start(0, params, heard.append)
    assert heard == [50, 100]
    plant, of_plant = lag.make()
    episodes = training_episodes(plant, of_plant, jax.random.key(1))
    reached = score(trainer.policy, trainer.policy_params(state), episodes)
    assert reached > 0.9 * score(*identify.static(plant, of_plant, jax.random.key(0)), episodes)  # both negative
    jax.tree.map(np.testing.assert_array_equal, state.learner.actor, state.learner.target_actor)


def test_the_same_seed_gives_the_same_actor(config):
    trainer, params = build(config)
    jax.tree.map(
        np.testing.assert_array_equal, trainer.start(3, params).learner.actor, trainer.start(3, params).learner.actor
    )


def test_a_run_may_end_with_the_start(config, tmp_path):
    run = Run.create(config, tmp_path / "run")
    finals = train(run, lambda trainer, state: {"mae": 1.0})
    assert finals is not None
    assert config.epochs == 0
    assert [row["epoch"] for row in run.rows(0)] == [0]
    again = train(Run.open(run.path), pretrained=lambda seed, done: pytest.fail("pretrained again"))
    jax.tree.map(np.testing.assert_array_equal, finals[0].learner.actor, again[0].learner.actor)


def test_a_run_that_goes_on_keeps_the_row_of_the_start(config, tmp_path):
    longer = replace(config, steps=2_560)
    run = Run.create(longer, tmp_path / "run")
    asked = iter([False, False, True])  # two chunks of the start, then the first epoch
    assert train(run, stop=lambda: next(asked)) is None
    assert train(run, pretrained=lambda seed, done: pytest.fail("pretrained again")) is not None
    assert [row["epoch"] for row in run.rows(0)] == [0, 1, 2]


def test_it_stops_when_asked(config, tmp_path):
    run = Run.create(config, tmp_path / "run")
    assert train(run, stop=lambda: True) is None
    assert run.checkpoints(0) == {}
    assert run.rows(0) == []


def test_the_actor_waits_until_the_critic_has_learned():
    config = small("lag", prefill=640, steps=640 + 8 * 20)
    trainer, params = build(replace(config, ddpg=replace(config.ddpg, actor_from=10)))
    state = trainer.prefill(trainer.start(0, params), params)
    before = jax.tree.map(np.asarray, state.learner.actor)
    state, _ = trainer.epoch(state, params, 80)
    jax.tree.map(np.testing.assert_array_equal, before, state.learner.actor)
    state, _ = trainer.epoch(state, params, 8)
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (before, state.learner.actor)), strict=True))


def test_a_model_longer_than_half_an_episode_is_refused(config):
    with pytest.raises(ValueError, match=r"pretraining.lags is 26; it must be at most half an episode of lag, 25"):
        build(replace(config, pretraining=replace(START, lags=26)))


@pytest.mark.parametrize(("field", "value"), [("gradient_steps", -1), ("episodes", 0), ("lags", 0), ("batch_size", 0)])
def test_what_is_not_allowed_is_named(field, value):
    with pytest.raises(ValueError, match=rf"pretraining.{field} is {value}"):
        small(pretraining=replace(PretrainingConfig(), **{field: value})).check()
