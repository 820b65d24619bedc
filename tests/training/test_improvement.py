"""Rounds of improvement by pairs, and the gate."""

import sys
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.agents.pairs import PairsConfig
from jaxouter.loop.disturbances import Disturbances
from jaxouter.plants.registry import add
from jaxouter.training.config import PretrainingConfig
from jaxouter.training.epochs import train
from jaxouter.training.gate import compare, judge
from jaxouter.training.run import RunFolder
from jaxouter.training.trainer import build
from tests import kinds
from tests.training.small import small

PAIRS = PairsConfig(rounds=3, states=1024, environments=16, horizon=20, change=0.1, updates=100, batch_size=128)
LEARNING = dict(pairs=PAIRS, compared=128, disturbances=Disturbances(0.02, 0.2), redraws=(1.0, 20.0))
CONFIG = small(name="scratch", base="static", correction=0.5, **LEARNING)  # one, as most of the time is compilation
KEY = jax.random.key(5)


@pytest.fixture(scope="module")
def started():
    trainer, params = build(CONFIG)
    return trainer, params, trainer.start(0, params)


def improved(trainer, params, state):
    rows = []
    for _ in range(PAIRS.rounds):
        state, metrics = trainer.improve(jax.tree.map(jnp.copy, state), params)
        rows.append({name: float(value) for name, value in metrics.items()})
    return state, rows


def gained(trainer, params, base, before, after):
    one = jax.tree.map(lambda leaf: leaf[None], after)
    found = jax.jit(compare, static_argnums=(0, 1, 7))(trainer.env, trainer.policy, before, one, base, params, KEY, 256)
    return {name: float(value[0]) for name, value in found._asdict().items()}


def test_rounds_make_a_static_prefilter_better_and_report_it(started):
    trainer, params, state = started
    after, rows = improved(trainer, params, state)
    assert any(row["kept"] > 0.0 for row in rows)
    assert all(0.0 <= row["kept"] <= 1.0 for row in rows)
    assert all((row["kept"] > 0.0) == (row["gain"] > 0.0 and row["worst"] > -1.0) for row in rows)
    found = gained(trainer, params, state.base, trainer.policy_params(state).actor, trainer.policy_params(after).actor)
    assert found["gain"] > 5 * found["error"]
    again, _ = improved(trainer, params, state)
    chex.assert_trees_all_equal(again, after)


def test_steps_and_updates_count_those_of_pairs():
    config = replace(CONFIG, steps=0)
    length = build(config)[0].env.plant.episode_steps
    steps = 16 * length + 2 * 1024 * 20 + 4 * 128 * length
    assert [config.done_by(epoch, length) for epoch in range(3)] == [(0, 0), (steps, 200), (2 * steps, 400)]
    assert config.environment_steps == 3 * steps + 2 * 128 * length + config.identification_steps
    assert config.total_updates == 600


def test_the_gain_of_no_change_is_nothing_and_pairs_are_paired(started):
    trainer, params, state = started
    found = jax.jit(trainer.improvement.pairs)(trainer.policy_params(state).actor, state.base, params, KEY)
    np.testing.assert_allclose(np.abs(found.change).max(), PAIRS.change, rtol=0.05)
    assert np.abs(found.change).min() >= 0.2 * PAIRS.change * 0.99
    pair = jax.jit(trainer.improvement.pair)
    one = jax.tree.map(lambda leaf: leaf[0], state.env)
    unchanged = pair(trainer.policy_params(state).actor, state.base, params, one, jnp.zeros(()), KEY)
    np.testing.assert_array_equal(unchanged.gain, 0.0)


def test_a_perfect_actor_stays_as_good_as_it_is():
    perfect = dict(base="none", correction=0.5, **LEARNING | dict(disturbances=Disturbances()))
    trainer, params = build(small(add(kinds.AtOnce), **perfect))
    state = trainer.start(0, params)
    after, _ = improved(trainer, params, state)
    found = gained(trainer, params, state.base, trainer.policy_params(state).actor, trainer.policy_params(after).actor)
    assert found["gain"] > -1e-3  # of half the range of set-points, per step


def test_in_the_end_the_base_law_remains_where_what_was_learned_is_worse(started):
    trainer, params, state = started
    good, _ = improved(trainer, params, state)
    layers = trainer.policy_params(good).actor["params"]
    last = max(layers)  # which is linear: the opposite corrections
    bad = {"params": layers | {last: jax.tree.map(jnp.negative, layers[last])}}
    for actor, kept in ((trainer.policy_params(good).actor, 1.0), (bad, 0.0)):
        before = trainer.with_actor(good, actor)
        after, found = trainer.check(jax.tree.map(jnp.copy, before), params)
        assert float(found["kept"]) == kept
        chex.assert_trees_all_equal(
            trainer.policy_params(after).actor, jax.tree.map(lambda leaf, kept=kept: kept * leaf, actor)
        )


def test_epochs_of_the_agent_keep_the_best_actor_and_learn_on(started):
    trainer, params, state = started
    good, _ = improved(trainer, params, state)
    kept = trainer.policy_params(good).actor
    nothing = jax.tree.map(jnp.zeros_like, kept)
    before = trainer.prefill(jax.tree.map(jnp.copy, trainer.with_actor(good, nothing)), params)
    for best in (kept, nothing):
        state = jax.tree.map(jnp.copy, before._replace(kept=before.kept._replace(best=best)))
        state, _ = trainer.epoch(state, params, trainer.config.epoch)
        after, row = trainer.check(state, params, False)
        assert float(row["kept"]) == (float(row["gain"]) > 0.0)
        wanted = after.kept.average if row["kept"] else best
        chex.assert_trees_all_equal(trainer.policy_params(after).actor, wanted)
        assert best is nothing or not row["kept"]  # an epoch from nothing is no match for rounds of pairs
        newest = jax.tree.map(lambda leaf: 0.3 * leaf, trainer.agent.actor(after.agent))  # and 0.7 of nothing
        chex.assert_trees_all_close(after.kept.average, newest, rtol=1e-5)
        assert int(after.agent.learner.updates) > 0


def test_before_the_rounds_a_pretrained_actor_is_kept_only_where_it_is_better_than_the_base_law(tmp_path):
    start = PretrainingConfig(gradient_steps=2, episodes=2, batch_size=2)
    run = RunFolder.create(replace(CONFIG, steps=0, pretraining=start), tmp_path / "run")
    train(run)
    row = run.rows(0)[0]
    assert row["epoch"] == 0
    assert row["steps"] == 2 * 128 * run.trainer[0].env.plant.episode_steps
    assert row["kept"] == (row["gain"] > row["error"])
    assert row["error"] > 0.0


def test_an_actor_is_not_better_than_itself(started):
    trainer, params, state = started
    found = gained(trainer, params, state.base, trainer.policy_params(state).actor, trainer.policy_params(state).actor)
    # Rounding may differ between the two, as XLA compiles them in one batch.
    assert (found["gain"], found["error"]) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_candidates_that_lose_in_the_mean_or_in_a_stratum_are_refused():
    random = np.random.default_rng(0)
    strata = jnp.asarray(np.arange(400) % 4)
    noise = 0.1 * random.normal(size=400)
    better, worse = noise + 0.1, noise - 0.1
    rotten = np.where(strata == 3, noise - 0.1, noise + 0.2)
    found = judge(jnp.asarray([better, worse, rotten]), strata)
    assert found.better.tolist() == [True, False, False]
    assert float(found.gain[2]) > float(found.gain[0])
    assert float(found.worst[2]) == pytest.approx(-10.0, abs=2.5)  # 0.1 of an error of 0.1 / sqrt(100)
    np.testing.assert_allclose(found.error[0], 0.1 / 20, rtol=0.1)


@pytest.mark.parametrize("unit", [1e-12, 1e-6, 1e5])
def test_the_verdict_on_a_candidate_is_the_same_in_any_unit(unit):
    gains, strata = jnp.asarray(np.random.default_rng(0).normal(size=(2, 64)), float), jnp.arange(64) % 4
    one, other = judge(gains, strata), judge(unit * gains, strata)
    np.testing.assert_allclose(other.gain / unit, one.gain, rtol=1e-4)
    np.testing.assert_allclose(other.error / unit, one.error, rtol=1e-4)
    np.testing.assert_allclose(other.worst, one.worst, rtol=1e-3)


def test_from_scratch_nothing_is_identified_but_the_static_gain(monkeypatch):
    def identifies(*args, **settings):
        raise AssertionError("a model was identified")

    allowed = "jaxouter.identification.steady_state"
    for module in [module for name, module in sys.modules.items() if name.startswith("jaxouter")]:
        for name, value in list(vars(module).items()):
            of = getattr(value, "__module__", None) or ""
            if of.startswith("jaxouter.identification") and of != allowed and not isinstance(value, type):
                monkeypatch.setattr(module, name, identifies)
    trainer, params = build(CONFIG)
    state = trainer.prefill(jax.tree.map(jnp.copy, trainer.start(0, params)), params)
    state, _ = trainer.epoch(state, params, trainer.config.epoch)
    state, metrics = trainer.improve(state, params)
    state, _ = trainer.check(state, params)
    assert int(state.agent.learner.updates) > 0
    assert np.isfinite(metrics["pairs_loss"])
    with pytest.raises(AssertionError, match="identified"):
        build(replace(trainer.config, base="lq"))[0].start(0, params)
