from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.agents.agent import Transitions
from jaxouter.agents.ddpg import DDPG, DDPGConfig, td_target
from jaxouter.agents.networks import act
from jaxouter.agents.returns import n_step_return
from jaxouter.agents.whitening import prepared

SMALL = DDPGConfig(hidden=(16, 16), batch_size=8, actor_rate=1e-3, critic_l2=0.0)


def random_batch(seed: int, size: int = 8, obs_size: int = 3) -> Transitions:
    keys = jax.random.split(jax.random.key(seed), 5)
    return Transitions(
        obs=jax.random.normal(keys[0], (size, obs_size)),
        action=jax.random.uniform(keys[1], (size, 1), minval=-1.0),
        reward=jax.random.normal(keys[2], (size,)),
        discount=jnp.where(jax.random.uniform(keys[3], (size,)) < 0.3, 0.0, 0.99),
        next_obs=jax.random.normal(keys[4], (size, obs_size)),
    )


@pytest.mark.parametrize(
    ("terminated", "truncated", "expected"),
    [
        (False, False, 2.0 + 0.9 * 5.0),  # running
        (True, False, 2.0),  # terminated: nothing follows
        (False, True, 2.0 + 0.9 * 5.0),  # truncated: bootstrapped from the final observation
        (True, True, 2.0),  # both
    ],
)
def test_td_target_by_hand(terminated, truncated, expected):
    reward, discount, used = n_step_return(jnp.array([2.0]), jnp.array([terminated]), jnp.array([truncated]), 0.9)
    assert int(used) == 0
    assert float(td_target(reward, discount, jnp.array([5.0]))) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("terminated", "truncated", "total", "discount", "used"),
    [
        ([0, 0, 0], [0, 0, 0], 1 + 0.5 * 2 + 0.25 * 4, 0.125, 2),
        ([0, 1, 0], [0, 0, 0], 1 + 0.5 * 2, 0.0, 1),
        ([0, 0, 0], [0, 1, 0], 1 + 0.5 * 2, 0.25, 1),
        ([1, 0, 0], [1, 0, 0], 1, 0.0, 0),
        ([0, 0, 1], [0, 0, 0], 1 + 0.5 * 2 + 0.25 * 4, 0.0, 2),
    ],
)
def test_n_step_return_by_hand(terminated, truncated, total, discount, used):
    out = n_step_return(jnp.array([1.0, 2.0, 4.0]), jnp.array(terminated) > 0, jnp.array(truncated) > 0, 0.5)
    np.testing.assert_allclose([float(x) for x in out], [total, discount, used])


def test_target_takes_the_least_of_two_critics():
    assert float(td_target(jnp.array(1.0), jnp.array(0.5), jnp.array([4.0, 2.0]))) == 2.0


def test_one_update_equals_ddpg_written_out():
    cfg = replace(SMALL, critic_l2=0.1, polyak=0.1)
    learner, batch = DDPG(cfg, 3), random_batch(0)
    state = learner.init(jax.random.key(0))
    after, _ = learner.update(state, batch, jax.random.key(1))

    def q(critic, obs, action):
        return learner.critic.apply(critic, obs, action)

    target = batch.reward + batch.discount * q(
        state.target_critics[0], batch.next_obs, learner.act(state.target_actor, batch.next_obs)
    )

    def critic_loss(critic):
        l2 = sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(critic) if leaf.ndim > 1)
        return jnp.mean((target - q(critic, batch.obs, batch.action)) ** 2) + 0.5 * cfg.critic_l2 * l2

    def adam(rate, gradient, params):
        """First step of Adam: bias correction makes it the gradient over its own size."""
        return jax.tree.map(lambda p, g: p - rate * g / (jnp.abs(g) + 1e-8), params, gradient)

    critic = adam(cfg.critic_rate, jax.grad(critic_loss)(state.critics[0]), state.critics[0])
    chex.assert_trees_all_close(after.critics[0], critic, atol=2e-5)
    gradient = jax.grad(lambda a: -jnp.mean(q(after.critics[0], batch.obs, learner.act(a, batch.obs))))(state.actor)
    chex.assert_trees_all_close(after.actor, adam(cfg.actor_rate, gradient, state.actor), atol=2e-5)
    soft = jax.tree.map(lambda new, old: 0.1 * new + 0.9 * old, after.actor, state.target_actor)
    chex.assert_trees_all_close(after.target_actor, soft, atol=1e-6)


@pytest.mark.parametrize("delay", [1, 2])
def test_an_update_whose_loss_is_not_finite_is_skipped_and_counted(delay):
    learner = DDPG(replace(SMALL, policy_delay=delay), 3)
    state, batch = learner.init(jax.random.key(0)), random_batch(1)
    for key in jax.random.split(jax.random.key(1), 4):  # so that the optimisers have momentum
        state, _ = learner.update(state, batch, key)
    broken = batch._replace(reward=batch.reward.at[0].set(jnp.inf))
    after, metrics = learner.update(state, broken, jax.random.key(2))
    chex.assert_trees_all_equal(after._replace(updates=state.updates), state)
    assert {name: float(metrics[name]) for name in ("skipped", "critic_loss")} == {"skipped": 1.0, "critic_loss": 0.0}
    chex.assert_tree_all_finite((after, metrics))
    again, metrics = learner.update(after, batch, jax.random.key(3))
    assert int(again.updates) == 6
    assert float(metrics["skipped"]) == 0.0
    assert not np.array_equal(jax.tree.leaves(again.critics)[1], jax.tree.leaves(state.critics)[1])


def test_td3_with_its_tricks_off_is_ddpg():
    ddpg, td3 = DDPG(SMALL, 3), DDPG(replace(SMALL, critics=2, policy_delay=1, target_noise=0.0), 3)
    one = ddpg.init(jax.random.key(0))
    twins = (one.critics[0], one.critics[0])  # the second critic adds nothing while it equals the first
    two = td3.init(jax.random.key(0))._replace(
        actor=one.actor, target_actor=one.target_actor, critics=twins, target_critics=twins
    )
    for seed in range(5):
        one, _ = ddpg.update(one, random_batch(seed), jax.random.key(seed))
        two, _ = td3.update(two, random_batch(seed), jax.random.key(seed))
    chex.assert_trees_all_close((one.actor, one.critics[0]), (two.actor, two.critics[1]), atol=1e-6)


def test_policy_delay_moves_actor_and_targets_at_every_second_update():
    learner = DDPG(replace(SMALL, policy_delay=2), 3)
    state = learner.init(jax.random.key(0))
    first, _ = learner.update(state, random_batch(0), jax.random.key(0))
    second, _ = learner.update(first, random_batch(1), jax.random.key(0))
    chex.assert_trees_all_equal((first.actor, first.target_critics), (state.actor, state.target_critics))
    for before, after in ((first.actor, second.actor), (first.target_critics, second.target_critics)):
        assert not np.array_equal(jax.tree.leaves(before)[-1], jax.tree.leaves(after)[-1])


def test_target_noise_depends_on_the_key_and_only_then():
    for noise, differs in ((0.2, True), (0.0, False)):
        learner = DDPG(replace(SMALL, target_noise=noise), 3)
        state = learner.init(jax.random.key(0))
        losses = [float(learner.update(state, random_batch(0), jax.random.key(k))[1]["critic_loss"]) for k in (1, 2)]
        assert (losses[0] != losses[1]) == differs


def test_saturation_penalty_pulls_the_action_back():
    batch = random_batch(0)
    outputs = []
    for penalty in (0.0, 1.0):
        learner = DDPG(replace(SMALL, saturation_penalty=penalty, actor_rate=1e-2), 3)
        update, state = jax.jit(learner.update), learner.init(jax.random.key(0))
        for _ in range(100):
            state, _ = update(state, batch, jax.random.key(0))
        outputs.append(float(jnp.mean(learner.before_tanh(state.actor, batch.obs) ** 2)))
    assert outputs[1] < 0.1 * outputs[0]


def test_cosine_decay_ends_at_zero():
    learner = DDPG(replace(SMALL, rate_decay="cosine"), 3, total_updates=3)
    state = learner.init(jax.random.key(0))
    for _ in range(3):
        state, _ = learner.update(state, random_batch(0), jax.random.key(0))
    after, _ = learner.update(state, random_batch(0), jax.random.key(0))
    chex.assert_trees_all_equal(after.actor, state.actor)


def test_update_is_the_same_with_and_without_jit():
    learner, batch = DDPG(SMALL, 3), random_batch(0)
    state = learner.init(jax.random.key(0))
    plain, _ = learner.update(state, batch, jax.random.key(1))
    jitted, _ = jax.jit(learner.update)(state, batch, jax.random.key(1))
    chex.assert_trees_all_close(plain.actor, jitted.actor, atol=1e-6)
    chex.assert_trees_all_close(plain.critics, jitted.critics, atol=1e-6)


# Probe environments: one question each, with an answer known by hand.


def learn(batch: Transitions, updates: int):
    cfg = DDPGConfig(
        hidden=(32, 32), actor_rate=3e-3, critic_rate=3e-3, rate_decay="cosine", critic_l2=0.0, polyak=0.05
    )
    learner = DDPG(cfg, batch.obs.shape[1], total_updates=updates)

    def step(state, key):
        return learner.update(state, batch, key)[0], None

    state = learner.init(jax.random.key(0))
    state, _ = jax.jit(lambda s: jax.lax.scan(step, s, jax.random.split(jax.random.key(1), updates)))(state)
    return learner, state


def probe(obs, action, reward, discount, next_obs) -> Transitions:
    column = [jnp.asarray(x, float).reshape(-1, 1) for x in (obs, action, next_obs)]
    return Transitions(column[0], column[1], jnp.asarray(reward, float), jnp.asarray(discount, float), column[2])


def q_at(learner, state, obs, action):
    return float(learner.values(state.critics, jnp.array([[float(obs)]]), jnp.array([[float(action)]]))[0, 0])


def test_probe_constant_reward_at_the_end_of_an_episode():
    actions = np.linspace(-1, 1, 16)
    learner, state = learn(probe(np.zeros(16), actions, np.ones(16), np.zeros(16), np.zeros(16)), 500)
    assert q_at(learner, state, 0, 0.3) == pytest.approx(1.0, abs=0.03)


def test_probe_reward_that_depends_on_the_observation():
    obs = np.tile([-1.0, 1.0], 8)
    learner, state = learn(probe(obs, np.linspace(-1, 1, 16), 2 * obs, np.zeros(16), obs), 500)
    assert [q_at(learner, state, s, 0.0) for s in (-1, 1)] == pytest.approx([-2.0, 2.0], abs=0.1)


def test_probe_reward_that_comes_a_step_later_is_discounted():
    obs = np.tile([0.0, 1.0], 8)  # 0 -> 1 without reward, 1 -> end with reward 1
    discount = np.where(obs == 0, 0.9, 0.0)
    learner, state = learn(probe(obs, np.linspace(-1, 1, 16), obs, discount, np.ones(16)), 1500)
    assert [q_at(learner, state, s, 0.0) for s in (0, 1)] == pytest.approx([0.9, 1.0], abs=0.05)


def test_probe_endless_reward_is_a_geometric_series():
    learner, state = learn(
        probe(np.zeros(16), np.linspace(-1, 1, 16), np.ones(16), np.full(16, 0.8), np.zeros(16)), 2000
    )
    assert q_at(learner, state, 0, 0.0) == pytest.approx(5.0, abs=0.1)


def test_probe_best_action_depends_on_the_observation():
    obs = np.repeat([-1.0, 1.0], 32)
    actions = np.tile(np.linspace(-1, 1, 32), 2)
    learner, state = learn(probe(obs, actions, -np.abs(actions - 0.5 * obs), np.zeros(64), obs), 6000)
    best = learner.act(state.actor, jnp.array([[-1.0], [1.0]]))[:, 0]
    np.testing.assert_allclose(best, [-0.5, 0.5], atol=0.08)


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("discount", 1.0, r"agent.discount is 1.0; it must lie in \[0, 1\)"),
        ("polyak", 0.0, "agent.polyak is 0.0"),
        ("batch_size", 0, "agent.batch_size is 0"),
        ("hidden", (5,), "at least two positive widths"),
        ("critics", 3, "1 or 2"),
        ("target_noise", -1.0, "must not be negative"),
    ],
)
def test_settings_that_make_no_sense_are_refused(field, value, text):
    with pytest.raises(ValueError, match=text):
        replace(DDPGConfig(), **{field: value}).check()


def test_defaults_are_the_papers():
    cfg = DDPGConfig()
    assert (cfg.hidden, cfg.actor_rate, cfg.critic_rate, cfg.discount) == ((400, 300), 1e-4, 1e-3, 0.99)
    assert (cfg.polyak, cfg.batch_size, cfg.critics, cfg.policy_delay, cfg.target_noise) == (0.001, 64, 1, 1, 0.0)


def alike(seed: int, size: int) -> jax.Array:
    """Observations whose parts differ little from each other, as consecutive samples do."""
    one, rest = jax.random.normal(jax.random.key(seed), (2, size, 3))
    return one[:, :1] + 0.05 * rest + 1.0


def test_whitening_leaves_the_policy_as_it_is():
    ddpg = replace(SMALL, whiten=1e-2).build(3)
    before, obs = ddpg.init(jax.random.key(0)), alike(1, 500)
    state = ddpg.prepared(before, obs)
    np.testing.assert_allclose(np.cov(state.white(obs).T), np.eye(3), atol=0.1)
    expected = act(SMALL.hidden, ddpg.actor(before), obs)
    np.testing.assert_allclose(act(SMALL.hidden, ddpg.actor(state), obs), expected, atol=1e-5)
    action, *_ = ddpg.explore(state, ddpg.noise(1)._replace(x=0.0, sigma=0.0), obs[0], jnp.zeros(1), False, 0.0)
    np.testing.assert_allclose(action, expected[0], atol=1e-5)
    again = ddpg.with_actor(state, ddpg.actor(state))
    chex.assert_trees_all_close(again.learner.actor, state.learner.actor, atol=1e-4)


def test_a_whitened_learner_learns_what_a_plain_one_learns_on_whitened_observations():
    whitened, plain = replace(SMALL, whiten=1e-2).build(3), DDPG(SMALL, 3)
    batch = random_batch(3)._replace(obs=alike(4, 8), next_obs=alike(5, 8))
    state = whitened.prepared(whitened.init(jax.random.key(0)), alike(1, 500))
    white, other = state.white, state.learner
    of_plain = batch._replace(obs=white(batch.obs), next_obs=white(batch.next_obs))
    update, of_other = jax.jit(whitened.update), jax.jit(plain.update)
    for _ in range(3):
        state, metrics = update(state, batch, jax.random.key(2))
        other, expected = of_other(other, of_plain, jax.random.key(2))
        chex.assert_trees_all_close(metrics, expected, rtol=1e-5)
    chex.assert_trees_all_close(state.learner, other, rtol=1e-5)
    obs = alike(6, 20)
    found = act(SMALL.hidden, whitened.actor(state), obs)
    np.testing.assert_allclose(found, plain.act(other.actor, white(obs)), atol=1e-5)
    np.testing.assert_allclose(whitened.value(state, obs), plain.value(other, white(obs)), atol=1e-5)


def test_without_whitening_nothing_is_prepared():
    ddpg = SMALL.build(3)
    assert isinstance(ddpg, DDPG)
    state = ddpg.init(jax.random.key(0))
    assert prepared(ddpg, state, jnp.ones((5, 3))) is state
