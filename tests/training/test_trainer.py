from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.references import Still
from jaxouter.loop.rewards import RewardConfig
from jaxouter.training.devices import Fleet
from jaxouter.training.environments import EPISODES
from jaxouter.training.off_policy import FIELDS
from jaxouter.training.trainer import DIAGNOSIS, build
from tests.precision import X64, makes_nan
from tests.training.small import small

SMALL = small(replay=640, reward_scale=0.5)  # full after the prefill


@pytest.fixture(scope="module")
def filled():
    """Trainer, parameters and a state after the prefill."""
    trainer, params = build(SMALL)
    return trainer, params, trainer.prefill(trainer.start(0, params), params)


def copy(state):
    return jax.tree.map(jnp.copy, state)


def test_prefill_fills_and_does_not_learn(filled):
    trainer, params, state = filled
    assert int(state.steps) == 640
    assert int(state.data.written) == 640 // 8
    assert int(state.agent.updates) == 0
    chex.assert_trees_all_equal(state.agent, trainer.start(0, params).agent)


@pytest.mark.parametrize("n_step", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_batches_hold_the_observations_that_the_environment_gave(n_step):
    """Windows of signals rebuild exactly what was seen, across resets, truncation and the ring's end included."""
    trainer, params = build(small(n_step=n_step, epoch=800, steps=1_600, replay=960))
    state = trainer.start(0, params)
    step, write = jax.jit(trainer.environments.step), jax.jit(trainer.driver.replay.write)

    @jax.jit
    def without_reset(state, action, keys):
        env = state.env
        of_each = jax.vmap(trainer.policy.r_tilde, (None, 0, 0, 0, 0))
        r_tilde = of_each(state.base, env.memory, env.r, env.y_seen, action)
        return jax.vmap(trainer.env.step_env, (0, 0, 0, None))(keys, state.env, r_tilde, params)

    seen = []  # (obs, action, reward, terminated, truncated, final observation) of each step
    for t in range(215):
        key = jax.random.key(t)
        action, keys = jax.random.uniform(key, (8,), minval=-1.0), jax.random.split(key, 8)
        before = state.obs
        final = without_reset(state, action, keys)
        state, taken = step(state, params, action, keys)
        state = state._replace(data=write(state.data, trainer.driver.row(taken)))
        seen.append((before, action, taken.plant_reward, final[3], final[4], final[5]["final_observation"]))
    assert any(bool(ended.any()) for *_, ended, _ in seen)
    obs, action, reward, terminated, truncated, final = (np.asarray(jnp.stack(x)) for x in zip(*seen, strict=True))
    gamma = trainer.config.agent.discount

    bits = jax.random.bits(jax.random.key(0), (trainer.config.agent.batch_size, 2), jnp.uint32)
    batch = trainer.driver.batch(state, params, bits)
    rows, _ = trainer.driver.replay.sample(state.data, bits)
    for i, row in enumerate(np.asarray(rows)):
        match = np.argwhere(
            np.isclose(np.float32(action), row[trainer.driver.replay.lead, FIELDS.index("action")], rtol=0, atol=0)
        )
        t, e = match[0]
        total, k = reward[t, e], 0
        while k < n_step - 1 and not (terminated | truncated)[t + k, e]:
            k += 1
            total += gamma**k * reward[t + k, e]
        np.testing.assert_allclose(batch.obs[i], obs[t, e], atol=1e-5)
        np.testing.assert_allclose(batch.next_obs[i], final[t + k, e], atol=1e-5)
        np.testing.assert_allclose(batch.reward[i], total * trainer.config.reward_scale, rtol=1e-4)
        assert float(batch.discount[i]) == pytest.approx(0.0 if terminated[t + k, e] else gamma ** (k + 1))


@pytest.mark.parametrize("relabel", [0.0, 1.0])
def test_held_transitions_are_what_the_environment_gives_where_r_stays(relabel):
    """With a noisy sensor, limits, a price at rest and set-points that are often redrawn."""
    config = small(
        hold=True, relabel=relabel, n_step=4, redraws=(30.0, 60.0), disturbances=Disturbances(0.5, 0.3),
        reward=RewardConfig(huber=0.01, rest=0.1, rest_after=2), base="static", epoch=800, steps=1_600, replay=960,
    )  # fmt: skip
    trainer, params = build(config)
    state, lead = trainer.start(0, params), trainer.driver.replay.lead
    step, write = jax.jit(trainer.environments.step), jax.jit(trainer.driver.replay.write)
    still = replace(trainer.env, goal=Still())

    @jax.jit
    def held(env, r, r_tilde, keys):
        """Rewards and the observation after each of the steps, the set-point r in all."""
        memory = env.memory._replace(integral=env.memory.integral + (r - env.r) / trainer.env.observer.integral_steps)
        env = env._replace(goal=r, r=r, memory=memory)

        def one(env, xs):
            obs, env, reward, *_ = still.step_env(xs[1], env, xs[0], params)
            return env, (obs, reward)

        return trainer.env.observer.features(memory, r, env.y_seen), jax.lax.scan(one, env, (r_tilde, keys))[1]

    envs, taken_keys, r_tildes = [], [], []
    for t in range(100):
        key = jax.random.key(t)
        keys, action = jax.random.split(key, 8), jax.random.uniform(key, (8,), minval=-0.3, maxval=0.3)
        envs.append(state.env)
        state, taken = step(state, params, action, keys)
        taken_keys.append(keys)
        r_tildes.append(taken.signals.r_tilde)
        state = state._replace(data=write(state.data, trainer.driver.row(taken)))
    r_tildes, span = np.asarray(jnp.stack(r_tildes)), np.ptp(trainer.env.plant.setpoint_range)
    bits = jax.random.bits(jax.random.key(0), (64, trainer.driver.data.bits), jnp.uint32)
    batch = trainer.driver.batch(state, params, bits)
    rows, _ = trainer.driver.replay.sample(state.data, bits)
    cut = 0
    for i, row in enumerate(np.asarray(rows)):
        t, e = np.argwhere(np.float32(r_tildes) == row[lead, FIELDS.index("r_tilde")])[0]
        r = batch.obs[i, 0] * trainer.env.observer.y_scale + trainer.env.observer.y_middle
        assert relabel or float(r) == pytest.approx(float(envs[t].r[e]), rel=1e-5)
        n = 1
        while n < 4 and abs(float(envs[t + n].r[e]) - float(r)) <= 0.02 * span and int(envs[t + n].k[e]) > 0:
            n += 1
        cut += n < 4
        env = jax.tree.map(lambda leaf, e=e: leaf[e], envs[t])
        steps = [jnp.stack([each[min(t + k, 99)][e] for k in range(4)]) for each in (jnp.asarray(r_tildes), taken_keys)]
        obs, (after, reward) = held(env, r, *steps)
        np.testing.assert_allclose(batch.obs[i], obs, atol=1e-4)
        np.testing.assert_allclose(batch.next_obs[i], after[n - 1], atol=1e-4)
        total = np.asarray(reward)[:n] @ config.agent.discount ** np.arange(n) * trainer.environments.reward_scale
        np.testing.assert_allclose(batch.reward[i], total, rtol=1e-3, atol=1e-4)
        assert float(batch.discount[i]) == pytest.approx(config.agent.discount**n)
        applied = trainer.policy.r_tilde(state.base, env.memory, r, env.y_seen, batch.action[i, 0])
        np.testing.assert_allclose(applied, r_tildes[t, e], atol=1e-3)
    assert cut > 10


def test_scan_equals_a_python_loop(filled):
    """One epoch of 10 steps equals 10 epochs of one step."""
    trainer, params, state = filled
    scanned, _ = trainer.epoch(copy(state), params, 80)
    looped = copy(state)
    for _ in range(10):
        looped, _ = trainer.epoch(looped, params, 8)
    chex.assert_trees_all_close(scanned.agent, looped.agent, atol=1e-6)
    chex.assert_trees_all_close(scanned.data, looped.data, atol=1e-5)
    chex.assert_trees_all_equal(scanned.steps, looped.steps)


def test_epochs_of_one_length_are_compiled_once(filled):
    trainer, params, state = filled
    with jax.log_compiles(False):
        state, _ = trainer.epoch(copy(state), params, 80)
        before = trainer.epoch._cache_size()
        for seed in (1, 2):
            state, _ = trainer.epoch(state, params, 80)
            fresh = trainer.prefill(trainer.start(seed, params), params)
            trainer.epoch(fresh, params, 80)
    assert trainer.epoch._cache_size() == before


@pytest.mark.parametrize(
    "config", [SMALL, pytest.param(small(name="paper"), marks=pytest.mark.slow)], ids=["default", "paper"]
)
def test_same_seed_twice_is_bit_equal_and_another_seed_is_not(config):
    trainer, params = build(config)
    first, second, other = (
        trainer.epoch(trainer.prefill(trainer.start(seed, params), params), params, 80)[0] for seed in (0, 0, 1)
    )
    chex.assert_trees_all_equal(first.agent, second.agent)
    chex.assert_trees_all_equal(first.data, second.data)
    assert not np.array_equal(jax.tree.leaves(first.agent.actor)[0], jax.tree.leaves(other.agent.actor)[0])


@pytest.mark.slow
def test_vmapped_seeds_equal_single_runs():
    trainer, params = build(small())
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    fresh = jax.jit(trainer.fresh)
    states = jax.vmap(fresh, (0, None))(keys, params)
    both = jax.vmap(lambda s: trainer.epoch(trainer.prefill(s, params), params, 80)[0])(states)
    for i in range(2):
        one = fresh(keys[i], params)
        one, _ = trainer.epoch(trainer.prefill(one, params), params, 80)
        lane = jax.tree.map(lambda leaf, i=i: leaf[i], both.agent)
        chex.assert_trees_all_close(lane, one.agent, atol=1e-4)


@pytest.mark.skipif(X64, reason="the replay is single precision, for a learner that is")
def test_compiled_epoch_copies_no_replay_inside_its_loop(filled):
    _, params, state = filled
    fleet = Fleet.of(SMALL)
    text = fleet.epoch.lower(fleet.put([state]), params, 80).compile().as_text()
    shape = ",".join(map(str, state.data.rows.shape))
    lines = [line for line in text.splitlines() if f"f32[{shape}]" in line or f"f32[1,{shape}]" in line]
    assert lines
    assert sum(" copy(" in line for line in lines) <= 1  # where the loop begins, once an epoch


def test_an_epoch_of_a_fleet_is_one_of_its_trainer(filled):
    """The options with which it is compiled on a CPU change no result."""
    trainer, params, state = filled
    fleet = Fleet.of(SMALL)
    found, _ = fleet.epoch(fleet.put([copy(state)]), params, 80)
    expected, _ = trainer.epoch(copy(state), params, 80)
    chex.assert_trees_all_close(jax.tree.map(lambda leaf: leaf[0], found.agent), expected.agent, atol=1e-6)


def test_exploration_stays_within_the_bounds_of_r_tilde():
    loud, params = build(small(noise_sigma=(3.0, 3.0)))
    state, taken = loud.start(0, params), []
    explore, step = jax.jit(loud.environments.explore), jax.jit(loud.environments.step)
    for key in jax.random.split(jax.random.key(0), 30):
        action, noise, *_ = explore(state, jax.random.normal(key, (8,)))
        state, found = step(state._replace(noise=noise), params, action, jax.random.split(key, 8))
        taken.append(found.signals.r_tilde)
    assert float(jnp.stack(taken).min()) == 0.0
    assert float(jnp.stack(taken).max()) == 40.0


def test_a_plant_that_diverges_never_poisons_the_replay():
    """With its actuator the wrong way round the pitch loop leaves its bounds within tens of steps."""
    trainer, params = build(small("pitch", randomise=(("gain", -5.0, -1.0),)))
    state, metrics = trainer.epoch(trainer.prefill(trainer.start(0, params), params), params, 960)
    assert float(metrics["diverged"]) > 0.02
    assert float(metrics["skipped"]) == float(metrics["no_action"]) == 0.0
    low, high = trainer.env.plant.divergence_bounds
    y = np.asarray(state.data.rows[..., FIELDS.index("y_next")])
    assert ((y == low) | (y == high)).any()
    assert ((y >= low) & (y <= high)).all()
    chex.assert_tree_all_finite((state.data.rows, state.agent, state.obs, metrics))


@makes_nan
def test_actions_that_are_not_finite_become_zero_and_are_counted(filled):
    trainer, params, state = filled
    state = copy(state)
    actor = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), state.agent.actor)
    state, metrics = trainer.epoch(state._replace(agent=state.agent._replace(actor=actor)), params, 80)
    assert float(metrics["no_action"]) == float(metrics["skipped"]) == 1.0
    chex.assert_tree_all_finite((state.data.rows, state.obs, state.env.y, state.agent.critics))


def test_a_diagnosis_tells_what_the_learner_expects_and_what_comes(filled):
    trainer, params, state = filled
    state, _ = trainer.epoch(copy(state), params, 80)
    before = copy(state)
    found = trainer.diagnose(state, params)
    chex.assert_trees_all_equal(state, before)
    assert float(found["replay_age"]) == 8 * (80 - 1) / 2  # of 720 steps of 8 environments the replay holds 640
    assert float(found["critic_gradient"]) > 0
    # Of a zero actor and critic the return is that of constant r~, 20 degC.
    actor, critics = (jax.tree.map(jnp.zeros_like, part) for part in (state.agent.actor, state.agent.critics))
    blind = trainer.diagnose(state._replace(agent=state.agent._replace(actor=actor, critics=critics)), params)
    assert float(blind["q_start"]) == 0.0
    key = jax.random.split(jax.random.fold_in(state.key, DIAGNOSIS), 3)[2]

    @jax.jit
    @jax.vmap
    def rewards(key):
        of_reset, of_run = jax.random.split(key)
        _, env = trainer.env.reset(of_reset, params)

        def step(env, of_step):
            _, env, reward, *_ = trainer.env.step_env(of_step, env, jnp.array(20.0), params)
            return env, reward

        return jax.lax.scan(step, env, jax.random.split(of_run, trainer.env.plant.episode_steps))[1]

    each = np.asarray(rewards(jax.random.split(key, EPISODES)))
    returns = 0.5 * each @ trainer.config.agent.discount ** np.arange(each.shape[1])
    assert float(blind["return_start"]) == pytest.approx(np.mean(returns), rel=1e-4)


def test_base_law_is_the_static_prefilter():
    trainer, params = build(small("pitch", base="static"))
    state = trainer.start(0, params)
    assert float(state.base.r) == pytest.approx(3.0, rel=0.02)
    ten, zero = jnp.array(10.0), jnp.array(0.0)
    r_tilde = trainer.policy.r_tilde(state.base, trainer.env.observer.init(ten, zero), ten, zero, zero)
    assert float(r_tilde) == pytest.approx(30.0, rel=0.02)


def test_set_points_are_redrawn_within_an_episode_only_where_asked():
    for redraws, changes in (((0.0, 0.0), False), ((20.0, 100.0), True)):
        trainer, params = build(replace(SMALL, redraws=redraws))
        rows = trainer.prefill(trainer.start(0, params), params).data.rows[:, trainer.driver.replay.mirror :][:, :80]
        r, age = rows[..., FIELDS.index("r")], rows[..., FIELDS.index("age")]
        within = (age[:, 1:] > 0) & (r[:, 1:] != r[:, :-1])
        assert bool(within.any()) == changes
