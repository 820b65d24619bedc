"""Pretraining in small, and the runs that begin with it."""

from dataclasses import replace

import chex
import jax
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.agents.whitening import Whitening
from jaxouter.evaluation.baselines.tuning import score, training_episodes
from jaxouter.identification import counterfactual, records, steady_state
from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.training import pretraining
from jaxouter.training.config import PretrainingConfig
from jaxouter.training.epochs import train
from jaxouter.training.pretraining import ADAM, DifferentiableRollout
from jaxouter.training.run import RunFolder, RunWarning
from jaxouter.training.trainer import build
from tests import lag
from tests.training.small import small, with_agent

KEY = jax.random.key(0)
START = PretrainingConfig(gradient_steps=100, episodes=8, lags=4, batch_size=16)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)


@pytest.fixture
def config():
    return small("lag", pretraining=START, base="static", steps=0)


def test_an_actor_from_a_record_alone_beats_the_static_prefilter(config):
    trainer, params = build(config)
    heard = []
    begun, actors = [], []

    def report(at, so_far):
        heard.append(int(at.done))
        actors.append(so_far().agent.actor)

    state = trainer.start(0, params, report, say=lambda *what: begun.append(what))
    assert heard == [50, 100]
    assert list(dict.fromkeys(what for what, _, _ in begun)) == ["compiling", "recording"]
    jax.tree.map(np.testing.assert_array_equal, actors[-1], state.agent.actor)
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, actors), strict=True))
    plant, of_plant = lag.make()
    episodes = training_episodes(plant, of_plant, jax.random.key(1))
    reached = score(trainer.policy, trainer.policy_params(state), episodes)
    assert reached > 0.95 * score(*steady_state.static(plant, of_plant, jax.random.key(0)), episodes)  # both negative
    jax.tree.map(np.testing.assert_array_equal, state.agent.actor, state.agent.target_actor)


def test_the_same_seed_gives_the_same_actor(config):
    trainer, params = build(config)
    jax.tree.map(
        np.testing.assert_array_equal, trainer.start(3, params).agent.actor, trainer.start(3, params).agent.actor
    )


@pytest.mark.slow
def test_an_actor_for_many_plants_beats_the_static_prefilter_on_them(config):
    drawn = dict(randomise=(("K", 0.3, 0.7), ("T", 0.2, 0.4)), disturbances=Disturbances(noise=0.02, load=0.05))
    trainer, params = build(replace(config, pretraining=replace(START, episodes=32, plants=8), **drawn))
    state = trainer.start(0, params)
    episodes = training_episodes(trainer.env.plant, params.plant, jax.random.key(1), 64)
    assert float(np.ptp(episodes.params.K)) > 0.3
    reached = score(trainer.policy, trainer.policy_params(state), episodes)
    alone = score(*steady_state.static(*lag.make(), jax.random.key(0)), episodes)
    assert reached > 0.8 * alone  # both negative


@pytest.mark.slow
def test_episodes_longer_than_the_plants_are_recorded_and_pretrained_on_last(config, monkeypatch):
    lengths, learn = [], DifferentiableRollout.train
    monkeypatch.setattr(
        DifferentiableRollout,
        "train",
        lambda self, *given: lengths.append(self.plant.episode_steps) or learn(self, *given),
    )
    start = replace(START, gradient_steps=150, episode_steps=80, log_above=0.1)
    config = replace(config, pretraining=start)
    assert config.identification_steps == 8 * 80 + steady_state.LEVELS * 50
    trainer, params = build(config)
    policy = trainer.policy_params(trainer.start(0, params))
    assert lengths == [50, 80, 80]
    plant, of_plant = lag.make()
    episodes = training_episodes(plant, of_plant, jax.random.key(1))
    assert score(trainer.policy, policy, episodes) > 0.9 * score(*steady_state.static(plant, of_plant, KEY), episodes)


def test_where_the_loop_collapses_training_goes_back_and_on_at_half_the_rate(config, monkeypatch):
    """At a rate at which it must; where it does not, the share grows again."""
    trainer, params = build(config)
    with monkeypatch.context() as greater:
        greater.setattr(pretraining, "RATE", 100.0)
        heard = []
        trainer.start(0, params, lambda at, state: heard.append(at))
    assert [float(at.rate_scale) for at in heard] == [0.5, 0.25]
    chex.assert_trees_all_equal(*(x for at in heard for x in (at.before, at.now)))
    trainer.start(0, params, lambda at, state: heard.append(at), heard[0])
    assert float(heard[-1].rate_scale) == 0.5 * 1.25
    chex.assert_trees_all_equal(heard[-1].before, heard[0].now)


def test_costs_count_by_their_logarithm_where_asked(config):
    """The reward with which a step on one episode begins."""
    trainer, _ = build(config)
    model = counterfactual.fit(records.record(*lag.make(), KEY, 8), 4)
    of_record, base = counterfactual.plant(trainer.env.plant, 4), steady_state.static(*lag.make(), KEY)[1]
    actors = jax.tree.map(lambda leaf: leaf[None], trainer.agent.init(KEY).actor)
    white = Whitening(np.zeros(trainer.env.observer.size), np.eye(trainer.env.observer.size))

    def cost(log_above):
        rollout = DifferentiableRollout(TrainingEpisodes(of_record), trainer.policy, 1, log_above)
        return -float(
            rollout.train((actors, jax.vmap(ADAM.init)(actors)), white, base, model, np.zeros(1), KEY)[1][0, 0]
        )

    assert cost(0.1) == pytest.approx(0.1 * np.log1p(cost(0.0) / 0.1), rel=1e-4)


def test_disturbances_of_the_pretraining_are_what_they_are_said_to_be(config):
    trainer, _ = build(config)
    episodes = TrainingEpisodes(trainer.env.plant, Disturbances(0.5, 0.5))
    keys = jax.random.split(jax.random.key(0), 400)
    noise = np.asarray(jax.vmap(lambda key: episodes.noises(key, 50))(keys))
    level = noise.std(1)
    assert np.mean(level == 0) == pytest.approx(0.5, abs=0.08)
    assert 0.45 < np.sort(level)[-5] < 0.65
    load = np.asarray(jax.vmap(lambda key: episodes.loads(key, 50))(keys))
    assert np.mean(np.all(load == 0, 1)) == pytest.approx(0.5, abs=0.08)
    assert 1.9 < np.abs(load).max() <= 2.0
    assert np.all((np.diff(load, axis=1) != 0).sum(1) <= 1)
    assert abs(load[:, -1].mean()) < 0.15


def test_a_run_may_end_with_the_start(config, tmp_path):
    run = RunFolder.create(config, tmp_path / "run")
    finals = train(run, lambda trainer, state: {"mae": 1.0})
    assert finals is not None
    assert config.epochs == 0
    assert [row["epoch"] for row in run.rows(0)] == [0]
    again = train(RunFolder.open(run.path), pretrained=lambda *_: pytest.fail("pretrained again"))
    jax.tree.map(np.testing.assert_array_equal, finals[0].agent.actor, again[0].agent.actor)


@pytest.mark.slow
def test_a_run_that_goes_on_keeps_the_row_of_the_start(config, tmp_path):
    longer = replace(config, steps=2_560)
    run = RunFolder.create(longer, tmp_path / "run")
    asked = iter([False, False, True])  # two chunks of the start, then the first epoch
    assert train(run, stop=lambda: next(asked)) is None
    assert train(run, pretrained=lambda *_: pytest.fail("pretrained again")) is not None
    assert [row["epoch"] for row in run.rows(0)] == [0, 1, 2]


def test_a_start_that_was_stopped_goes_on_where_it_was(config, tmp_path):
    whole, stopped = RunFolder.create(config, tmp_path / "whole"), RunFolder.create(config, tmp_path / "stopped")
    finals, heard = train(whole), []
    assert train(stopped, stop=lambda: True) is None
    assert (stopped.checkpoints(0), stopped.rows(0)) == ({}, [])
    resumed = train(RunFolder.open(stopped.path), pretrained=lambda seed, at, look: heard.append(int(at.done)))
    assert heard == [100]
    chex.assert_trees_all_equal(finals, resumed)
    assert stopped.load_pretraining(0) is None


def test_a_damaged_first_checkpoint_is_made_again(config, tmp_path):
    run = RunFolder.create(config, tmp_path / "run")
    finals = train(run)
    (path,) = run.checkpoints(0).values()
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.warns(RunWarning, match=r"checkpoint-000000\.npz is not a readable checkpoint"):
        resumed = train(RunFolder.open(run.path))
    chex.assert_trees_all_equal(finals, resumed)


def test_a_damaged_start_begins_anew(config, tmp_path):
    run, heard = RunFolder.create(config, tmp_path / "run"), []
    train(run, stop=lambda: True)
    path = run.seed_folder(0) / "pretraining.npz"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.warns(RunWarning, match=r"pretraining\.npz is not a readable checkpoint"):
        train(run, pretrained=lambda seed, at, look: heard.append(int(at.done)))
    assert heard == [50, 100]


@pytest.mark.slow
def test_the_actor_waits_until_the_critic_has_learned():
    config = small("lag", prefill=640, steps=640 + 8 * 20)
    trainer, params = build(with_agent(config, actor_from=10))
    state = trainer.prefill(trainer.start(0, params), params)
    before = jax.tree.map(np.asarray, state.agent.actor)
    state, _ = trainer.epoch(state, params, 80)
    jax.tree.map(np.testing.assert_array_equal, before, state.agent.actor)
    state, _ = trainer.epoch(state, params, 8)
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (before, state.agent.actor)), strict=True))


def test_a_model_longer_than_half_an_episode_is_refused(config):
    with pytest.raises(ValueError, match=r"pretraining.lags is 26; it must be at most half a recorded episode, 25"):
        build(replace(config, pretraining=replace(START, lags=26)))
    build(replace(config, pretraining=replace(START, lags=26, episode_steps=52)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("gradient_steps", -1), ("log_above", -1.0)),
        *(("episodes", 0), ("episode_steps", 0), ("lags", 0), ("batch_size", 0), ("plants", 0)),
    ],
)
def test_what_is_not_allowed_is_named(field, value):
    with pytest.raises(ValueError, match=rf"pretraining.{field} is {value}"):
        small(pretraining=replace(PretrainingConfig(), **{field: value})).check()
