"""What `test_devices` runs in a process of four devices."""

from dataclasses import replace

import chex
import jax
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.agents import AGENTS
from jaxouter.agents.ppo import PPOConfig
from jaxouter.agents.sac import SACConfig
from jaxouter.agents.trpo import TRPOConfig
from jaxouter.training.config import PretrainingConfig
from jaxouter.training.devices import Fleet, spread
from jaxouter.training.epochs import train
from jaxouter.training.off_policy import FIELDS
from jaxouter.training.pretraining import DifferentiableRollout
from jaxouter.training.run import RunFolder
from tests import lag
from tests.additions.reinforce import Reinforce
from tests.training.small import small

SHORT = dict(steps=1_280, epoch=320, noise_sigma=(1e-4, 0.5))  # two epochs


@pytest.fixture(scope="module")
def spanning(tmp_path_factory):
    """A run of one learner on four devices, stopped after its first epoch."""
    run = RunFolder.create(small(devices=4, **SHORT), tmp_path_factory.mktemp("spanning") / "run")
    assert train(run, stop=lambda: True) is None
    return run


def test_seeds_on_devices_of_their_own_equal_single_runs(tmp_path):
    together = train(RunFolder.create(small(seeds=4, devices=2, **SHORT), tmp_path / "together"))
    assert together is not None
    for seed in (1, 2):  # one on each device, of different rounds
        alone = train(RunFolder.create(small(seed=seed, **SHORT), tmp_path / f"alone-{seed}"))
        assert alone is not None
        chex.assert_trees_all_close(together[seed].agent, alone[seed].agent, rtol=1e-5, atol=1e-6)
        chex.assert_trees_all_close(together[seed].data, alone[seed].data, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("seeds", "shards"), [(1, 4), (2, 2)])
def test_a_learner_is_the_same_on_all_devices_that_it_spans(seeds, shards):
    config = small(seeds=seeds, devices=4, **SHORT)
    fleet = Fleet.of(config)
    assert dict(fleet.mesh.shape) == {"seeds": seeds, "environments": shards}
    trainer, params = RunFolder(None, config).trainer
    state = fleet.prefill(fleet.put([trainer.start(seed, params) for seed in range(seeds)]), params)
    before = fleet.take(state)
    state, metrics = fleet.epoch(state, params, 320)
    after = fleet.take(state)
    for leaf in jax.tree.leaves((state.agent, metrics)):
        by_seed = {}
        for shard in leaf.addressable_shards:
            np.testing.assert_array_equal(shard.data, by_seed.setdefault(shard.index[0].start, shard.data))
        assert len(by_seed) == seeds
    for i in range(seeds):
        assert int(after[i].steps) == 960
        assert int(after[i].agent.updates) == 40
        assert not np.array_equal(*(jax.tree.leaves(states[i].agent.actor)[0] for states in (before, after)))
        written = after[i].data.rows[:, trainer.driver.replay.mirror :][:, :120]
        action = written[..., FIELDS.index("action")]
        assert len(np.unique(action[:, 0])) == 8  # no two environments draw alike
        assert np.all(np.diff(np.std(np.diff(action[:, 80:]), 1)[::2]) > 0)  # the ladder goes on from shard to shard


TINY = dict(hidden=(8, 8), hold=True, whiten=0.1)
ON_POLICY = TINY | dict(unroll=20, epochs=2, minibatches=2, prefill=160)


@pytest.mark.parametrize(
    ("agent", "seeds", "shards"),
    [
        (Reinforce(rate=1e-3, sigma=0.1), 1, 4),
        (Reinforce(rate=1e-3, sigma=0.1), 2, 2),
        (PPOConfig(**ON_POLICY), 2, 2),
        (TRPOConfig(**ON_POLICY), 2, 2),
        (SACConfig(**TINY, batch_size=32, prefill=160, replay=1_600), 2, 2),
    ],
)
def test_a_learner_of_another_kind_is_the_same_on_all_devices_that_it_spans(agent, seeds, shards, monkeypatch):
    monkeypatch.setitem(AGENTS, "reinforce", Reinforce)
    steps = 1_280 + agent.data.before
    config = replace(small(seeds=seeds, devices=4, steps=steps, epoch=640), agent=agent)
    fleet = Fleet.of(config)
    assert fleet.trainer.environments.shards == shards
    trainer, params = RunFolder(None, config).trainer
    state = fleet.prefill(fleet.put([trainer.start(seed, params) for seed in range(seeds)]), params)
    before = fleet.take(state)
    state, metrics = fleet.epoch(state, params, 640)
    after = fleet.take(state)
    assert [int(each.steps) for each in after] == [640 + agent.data.before] * seeds
    for leaf in jax.tree.leaves((state.agent, metrics)):
        by_seed = {}
        for shard in leaf.addressable_shards:
            np.testing.assert_array_equal(shard.data, by_seed.setdefault(shard.index[0].start, shard.data))
    for i in range(seeds):
        assert not np.array_equal(*(jax.tree.leaves(states[i].agent)[0] for states in (before, after)))
        assert len(np.unique(after[i].obs[:, 0])) == 8  # no two environments are alike


def test_checkpoint_of_four_devices_goes_on_with_one(spanning):
    written, done = spanning.load(0)
    assert (done, written.data.rows.shape[0], len(written.noise.x)) == (1, 8, 8)
    on_one = replace(spanning, config=replace(spanning.config, devices=1))
    chex.assert_trees_all_equal(on_one.fleet.take(on_one.fleet.put([written]))[0], jax.device_get(written))
    finals = train(on_one)
    assert finals is not None
    assert int(finals[0].steps) == 1_280
    assert [row["epoch"] for row in spanning.rows(0)] == [1, 2]


def test_compiled_loop_copies_no_part_of_the_replay(spanning):
    fleet, (trainer, params) = spanning.fleet, spanning.trainer
    state = fleet.put([trainer.start(0, params)])
    text = fleet.epoch.lower(state, params, 320).compile().as_text()
    part = ",".join(map(str, (2, *state.data.rows.shape[2:])))
    lines = [line for line in text.splitlines() if f"f32[{part}]" in line or f"f32[1,{part}]" in line]
    assert lines
    assert sum(" copy(" in line for line in lines) <= 1  # before the loop


def test_an_actor_pretrained_on_four_devices_is_that_of_one(tmp_path, monkeypatch):
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)
    made = []
    of = DifferentiableRollout.of
    monkeypatch.setattr(DifferentiableRollout, "of", lambda *given: made.append(of(*given)) or made[-1])
    start = PretrainingConfig(gradient_steps=3, episodes=8, lags=4, batch_size=16)
    actors = []
    for devices in (1, 4):
        config = small("lag", pretraining=start, base="static", steps=0, devices=devices)
        finals = train(RunFolder.create(config, tmp_path / str(devices)))
        assert finals is not None
        actors.append(finals[0].agent.actor)
    assert [rollout.devices for rollout in made] == [1, 4]
    chex.assert_trees_all_close(*actors, atol=1e-5)


def test_houses_on_four_devices_are_those_of_one():
    n = 4_096
    plant, params = plants.make("heaters", n=n, Ca=np.linspace(8.0, 12.0, n))
    over = spread(params, n, 4)
    assert {len(leaf.sharding.device_set) for leaf in jax.tree.leaves(over)} == {4}
    step = jax.jit(plant.step)
    state, r_tilde, key = plant.init(jax.random.key(0), params), jax.numpy.array(20.0), jax.random.key(1)
    one, four = step(params, state, r_tilde, key), step(over, spread(state, n, 4), r_tilde, key)
    assert four.x.addressable_shards[0].data.shape == (n // 4,)
    np.testing.assert_allclose(one.x, four.x, rtol=1e-6)
    text = step.lower(over, spread(state, n, 4), r_tilde, key).compile().as_text()
    assert f"f32[10,{n // 4}]" in text
    assert f",{n}]" not in text  # no device draws for all


def test_simulation_of_houses_on_four_devices_is_that_of_one():
    n = 64
    plant, params = plants.make("heaters", n=n, Ca=np.linspace(8.0, 12.0, n))
    runs = [plants.simulate(plant, p, [20.0] * 5, jax.random.key(0)) for p in (params, spread(params, n, 4))]
    np.testing.assert_allclose(*runs, rtol=1e-5)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Fleet.of(small(devices=8)), "devices is 8; it must be at most what there is: .*3"),
        (lambda: spread({}, 10, 4), "devices is 4; it must divide the 10 members and be at most 4"),
    ],
)
def test_devices_that_do_not_fit_are_named(make, text):
    with pytest.raises(ValueError, match=text):
        make()
