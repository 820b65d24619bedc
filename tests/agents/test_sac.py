from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.agents.sac import SAC, SACConfig
from tests.agents.test_ddpg import probe, random_batch

SMALL = SACConfig(hidden=(32, 32), actor_rate=3e-3, critic_rate=3e-3, temperature_rate=3e-3, polyak=0.05)
KEY = jax.random.key(0)


def learned(config: SACConfig, batch, updates: int):
    learner = SAC(config, batch.obs.shape[1], total_updates=updates)

    def step(state, key):
        return learner.update(state, batch, key)

    run = jax.jit(lambda state: jax.lax.scan(step, state, jax.random.split(jax.random.key(1), updates)))
    state, metrics = run(learner.init(KEY))
    return learner, state, metrics


def q_at(learner, state, obs, action):
    return float(learner.critic.apply(state.critics[0], jnp.full(1, float(obs)), jnp.full(1, float(action))))


def test_densities_of_actions_integrate_to_one():
    learner = SAC(replace(SMALL, sigma=0.8), 3)
    state, obs = learner.init(KEY), jnp.array([0.5, -1.0, 2.0])
    normal = jnp.linspace(-7.0, 7.0, 20_001)[:, None]
    actions, log, _ = jax.vmap(lambda n: learner.draw((state.actor, state.deviation), obs, n))(normal)
    assert float(jnp.trapezoid(jnp.exp(log), actions[:, 0])) == pytest.approx(1.0, abs=1e-3)


def test_one_update_equals_sac_written_out():
    learner, batch = SAC(replace(SMALL, target_entropy=-0.5), 3), random_batch(0)
    state, key = learner.init(KEY), jax.random.key(1)
    after, metrics = learner.update(state, batch, key)
    normal, next_normal = jax.random.normal(key, (2, 8, 1))
    policy, temperature = (state.actor, state.deviation), float(jnp.exp(state.log_temperature))

    def q(critic, obs, action):
        return learner.critic.apply(critic, obs, action)

    action, log, _ = learner.draw(policy, batch.next_obs, next_normal)
    least = jnp.minimum(*(q(critic, batch.next_obs, action) for critic in state.target_critics))
    target = batch.reward + batch.discount * (least - temperature * log)
    loss = sum(jnp.mean((target - q(critic, batch.obs, batch.action)) ** 2) for critic in state.critics)
    assert float(metrics["critic_loss"]) == pytest.approx(float(loss), rel=1e-4)

    def actor_loss(policy):
        action, log, _ = learner.draw(policy, batch.obs, normal)
        return jnp.mean(temperature * log - jnp.minimum(*(q(critic, batch.obs, action) for critic in after.critics)))

    gradient = jax.grad(actor_loss)(policy)
    moved = jax.tree.map(lambda p, g: p - 3e-3 * g / (jnp.abs(g) + 1e-8), policy, gradient)  # Adam's first step
    chex.assert_trees_all_close((after.actor, after.deviation), moved, atol=2e-5)
    direction = np.sign(float(metrics["entropy"]) + 0.5)
    assert float(after.log_temperature - state.log_temperature) == pytest.approx(-3e-3 * direction, rel=1e-3)
    soft = jax.tree.map(lambda new, old: 0.05 * new + 0.95 * old, after.critics, state.target_critics)
    chex.assert_trees_all_close(after.target_critics, soft, atol=1e-6)


def test_the_entropy_meets_its_target():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, 64)
    batch = probe(np.zeros(64), actions, -((actions - 0.3) ** 2), np.zeros(64), np.zeros(64))
    _, _, metrics = learned(replace(SMALL, target_entropy=-1.5, temperature=0.02), batch, 3_000)
    assert float(jnp.mean(metrics["entropy"][-300:])) == pytest.approx(-1.5, abs=0.1)


def test_probe_best_action_depends_on_the_observation():
    rng = np.random.default_rng(1)
    obs, actions = rng.choice([-1.0, 1.0], 128), rng.uniform(-1, 1, 128)
    batch = probe(obs, actions, -((actions - 0.5 * obs) ** 2), np.zeros(128), obs)
    learner, state, _ = learned(replace(SMALL, target_entropy=-2.0, temperature=1e-2), batch, 2_000)
    for at in (-1.0, 1.0):
        assert float(jnp.tanh(learner.network.apply(state.actor, jnp.array([at])))[0]) == pytest.approx(
            0.5 * at, abs=0.1
        )


def test_probe_endless_reward_is_a_geometric_series_of_reward_and_entropy():
    n = 64
    batch = probe(np.zeros(n), np.linspace(-1, 1, n), np.ones(n), 0.5 * np.ones(n), np.zeros(n))
    config = replace(SMALL, temperature=1e-2, temperature_rate=1e-9, rate_decay="cosine")
    learner, state, metrics = learned(config, batch, 2_000)
    bonus = 0.5 * 1e-2 * float(jnp.mean(metrics["entropy"][-200:]))
    assert q_at(learner, state, 0, 0.3) == pytest.approx((1.0 + bonus) / 0.5, abs=0.06)


def test_what_is_not_finite_is_skipped_and_counted():
    learner = SAC(SMALL, 3)
    state, batch = learner.init(KEY), random_batch(1)
    state, metrics = learner.update(state, batch, KEY)
    assert float(metrics["skipped"]) == 0.0
    broken = batch._replace(reward=batch.reward.at[0].set(jnp.inf))
    after, metrics = learner.update(state, broken, KEY)
    assert float(metrics["skipped"]) == 1.0
    chex.assert_trees_all_equal(after, state)
    chex.assert_tree_all_finite(metrics)


def test_diagnosis_tells_the_norms_of_the_gradients():
    learner = SAC(SMALL, 3)
    found = learner.diagnose(learner.init(KEY), random_batch(0), KEY)
    assert set(found) == {"critic_gradient", "actor_gradient"}
    assert all(float(value) > 0.0 for value in found.values())


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("temperature", 0.0, "agent.temperature is 0.0; it must be positive"),
        ("polyak", 2.0, "agent.polyak is 2.0"),
        ("critic", "deep", "agent.critic is 'deep'"),
        ("whiten", -1.0, "must not be negative"),
    ],
)
def test_settings_that_make_no_sense_are_refused(field, value, text):
    with pytest.raises(ValueError, match=text):
        replace(SMALL, **{field: value}).check()
