"""PPO and TRPO against what is known in closed form, and on probes whose answer is known."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxouter.agents.agent import Experience
from jaxouter.agents.gaussian import GaussianPolicy, Sample, divergence, log_probability, normalised
from jaxouter.agents.ppo import PPO, PPOConfig, surrogate
from jaxouter.agents.trpo import TRPO, TRPOConfig, conjugate_gradients
from tests.agents import linear_quadratic

SMALL = dict(hidden=(16, 16), epochs=4, minibatches=1, critic_rate=1e-2)
PPO_SMALL = PPOConfig(**SMALL, actor_rate=1e-2, rate_decay="constant", kl=0.0)
TRPO_SMALL = TRPOConfig(**SMALL, fisher_every=1)
KEY = jax.random.key(0)


def drawn(learner, state, obs, reward, key) -> Experience:
    """One step from each obs (N, n); reward(obs, action) -> (N,)."""
    explore = jax.vmap(learner.explore, (None, None, 0, 0, None, None))
    action, _, sample = explore(state, (), obs, jax.random.normal(key, (len(obs), 1), float), False, 0.0)
    came = reward(obs, action)
    return Experience(obs, action, sample, came - learner.value(state, obs), came)


def learned(learner, reward, steps: int, states: int = 256):
    """A training on single steps from random states."""

    def step(state, key):
        key_obs, key_act, key_update = jax.random.split(key, 3)
        obs = jax.random.uniform(key_obs, (states, 1), float, -1.0, 1.0)
        batch = drawn(learner, state, obs, reward, key_act)
        for each in jax.random.split(key_update, learner.data.epochs):
            state, metrics = learner.update(state, batch, each)
        return state, metrics

    return jax.jit(lambda state: jax.lax.scan(step, state, jax.random.split(KEY, steps)))(learner.init(KEY))


def test_densities_are_those_of_normal_distributions():
    u, mu, log_sigma = jnp.array([0.3, -1.0]), jnp.array([0.1, 0.5]), jnp.log(jnp.array([0.5, 2.0]))
    expected = sum(
        -0.5 * ((x - m) / s) ** 2 - np.log(s * np.sqrt(2 * np.pi)) for x, m, s in ((0.3, 0.1, 0.5), (-1.0, 0.5, 2.0))
    )
    assert float(log_probability(u, mu, log_sigma)) == pytest.approx(expected, rel=1e-5)


def test_the_divergence_is_the_mean_ratio_of_densities():
    mu, log_sigma, other, log_other = 0.2, np.log(0.5), -0.1, np.log(0.8)
    u = jnp.linspace(-6.0, 6.0, 20_001)[:, None]
    of = [log_probability(u, jnp.full_like(u, m), jnp.full(1, s)) for m, s in ((mu, log_sigma), (other, log_other))]
    expected = float(jnp.sum(jnp.exp(of[0]) * (of[0] - of[1])) * (u[1, 0] - u[0, 0]))
    found = divergence(*(jnp.full(1, x) for x in (mu, log_sigma, other, log_other)))
    assert float(found) == pytest.approx(expected, rel=1e-3)


def test_advantages_are_normalised_over_all_parts_of_the_batch():
    advantage = jnp.arange(8.0) ** 2
    whole = normalised(advantage, None)
    parts = jax.vmap(lambda part: normalised(part, "parts"), axis_name="parts")(advantage.reshape(2, 4))
    np.testing.assert_allclose(parts.reshape(-1), whole, rtol=1e-5)
    np.testing.assert_allclose([jnp.mean(whole), jnp.std(whole)], [0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"), [(1.5, 2.0, 2.4), (1.5, -2.0, -3.0), (0.5, 2.0, 1.0), (0.5, -2.0, -1.6)]
)
def test_the_surrogate_is_clipped_where_that_is_worse(ratio, advantage, expected):
    assert float(surrogate(jnp.log(jnp.array(ratio)), jnp.array(advantage), 0.2)) == pytest.approx(expected)


@pytest.mark.slow
def test_first_policy_gradients_are_exact_on_a_linear_quadratic_task():
    ppo = PPO(PPOConfig(hidden=linear_quadratic.HIDDEN), 1)
    linear_quadratic.check(lambda policy, batch: jax.grad(lambda p: -ppo.policy_loss(p, batch)[0])(policy))
    trpo = TRPO(TRPOConfig(hidden=linear_quadratic.HIDDEN), 1)
    linear_quadratic.check(jax.grad(trpo.surrogate))


def random_batch(policy: GaussianPolicy, learner, size: int = 64, seed: int = 0) -> Experience:
    keys = jax.random.split(jax.random.key(seed), 4)
    obs = jax.random.normal(keys[0], (size, learner.obs_size), float)
    act = jax.vmap(learner.explore, (None, None, 0, 0, None, None))
    state = learner.init(KEY)._replace(policy=policy)
    action, _, sample = act(state, (), obs, jax.random.normal(keys[1], (size, 1), float), False, 0.0)
    advantage, target = jax.random.normal(keys[2], (2, size), float)
    return Experience(obs, action, sample, advantage, target)


def test_the_fisher_product_is_the_dense_matrix_times_a_vector():
    learner = TRPO(replace(TRPO_SMALL, hidden=(4,), sigma=0.5), 3)
    policy = learner.init(KEY).policy
    obs = jax.random.normal(jax.random.key(1), (20, 3), float)
    flat, unravel = ravel_pytree(policy)

    def means(flat):
        return jax.vmap(lambda one: _mean(learner, unravel(flat), one))(obs)

    slopes = jax.jacobian(means)(flat)[:, 0]  # (20, p)
    dense = slopes.T @ slopes / (20 * 0.5**2)
    dense = dense.at[-1, -1].add(2.0)  # of log sigma
    found = jax.vmap(lambda vector: learner.fisher_product(policy, obs, vector))(jnp.eye(len(flat)))
    np.testing.assert_allclose(found, dense, atol=1e-5)


def _mean(learner, policy, obs):
    return learner.explore(learner.init(KEY)._replace(policy=policy), (), obs, jnp.zeros(1), False, 0.0)[2].u


def test_conjugate_gradients_solve():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    matrix, b = jnp.asarray(root @ root.T + np.eye(6), float), jnp.asarray(rng.normal(size=6), float)
    x = conjugate_gradients(lambda vector: matrix @ vector, b, 6)
    np.testing.assert_allclose(matrix @ x, b, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_is_better_and_keeps_to_the_trust_region(seed):
    learner = TRPO(TRPO_SMALL, 3)
    policy = learner.init(jax.random.key(seed)).policy
    batch = random_batch(policy, learner, seed=seed)
    after, search, gain = jax.jit(learner.step)(policy, batch)
    kl = float(learner.divergence(policy, after, batch.obs))
    assert float(gain) > 0.0
    assert float(search.kl) == pytest.approx(kl, abs=1e-5)
    assert 0.2 * learner.config.kl < kl <= learner.config.kl


def test_a_step_that_gains_nothing_is_not_taken():
    learner = TRPO(TRPO_SMALL, 3)
    policy = learner.init(KEY).policy
    batch = random_batch(policy, learner)
    after, search, gain = jax.jit(learner.step)(policy, batch._replace(advantage=jnp.zeros(64)))
    assert int(search.tries) == 1 + learner.config.backtracks
    chex.assert_trees_all_equal(after, policy)
    assert (float(search.share), float(gain)) == (0.0, 0.0)


def test_the_policy_rests_beyond_the_kl_until_the_next_unroll():
    learner = PPO(replace(PPO_SMALL, kl=1e-9, minibatches=1, epochs=3), 3)
    state = learner.init(KEY)
    batch = random_batch(state.policy, learner)
    seen, update = [], jax.jit(learner.update)
    for _ in range(4):
        before = state
        state, metrics = update(state, batch, KEY)
        moved = any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (state.policy, before.policy)), strict=True))
        seen.append((moved, float(metrics["kl"]) > 1e-9))
        assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (state.critic, before.critic)), strict=True))
    assert seen == [(True, False), (False, True), (False, True), (False, True)]
    fresh = batch._replace(extras=Sample(batch.extras.u, _log_probability(learner, state, batch)))
    state = state._replace(updates=jnp.asarray(3, jnp.int32))  # the first of an unroll
    assert not bool(update(state, fresh, KEY)[0].rests)


def _log_probability(learner, state, batch):
    mu = jax.vmap(lambda obs: _mean(learner, state.policy, obs))(batch.obs)
    return log_probability(batch.extras.u, mu, state.policy.log_sigma)


@pytest.mark.parametrize("clip", [0.0, 0.1])
def test_the_critic_gains_nothing_beyond_the_value_clip(clip):
    learner = PPO(replace(PPO_SMALL, value_clip=clip), 3)
    state = learner.init(KEY)
    batch = random_batch(state.policy, learner)
    batch = batch._replace(value_target=learner.value(state, batch.obs) + 1.0, advantage=jnp.ones(64) * 1.5)
    # The value is 0.5 above what it was: with the clip only the part within it counts.
    expected = 1.0 if clip == 0.0 else 1.4**2
    assert float(learner.critic_loss(state.critic, batch)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("config", [PPO_SMALL, TRPO_SMALL])
def test_what_is_not_finite_is_skipped_and_counted(config):
    learner = config.build(3)
    state = learner.init(KEY)
    batch = random_batch(state.policy, learner)
    state, metrics = learner.update(state, batch, KEY)
    assert float(metrics["skipped"]) == 0.0
    broken = batch._replace(advantage=batch.advantage.at[0].set(jnp.inf))
    after, metrics = learner.update(state, broken, KEY)
    assert float(metrics["skipped"]) == 1.0
    chex.assert_tree_all_finite((after, metrics))
    chex.assert_trees_all_equal((after.policy, after.critic), (state.policy, state.critic))


@pytest.mark.parametrize("config", [replace(PPO_SMALL, sigma=0.3), replace(TRPO_SMALL, sigma=0.3, kl=0.05)])
def test_probe_the_best_action_depends_on_the_observation(config):
    learner = config.build(1)
    state, _ = learned(learner, lambda obs, action: -((action - 0.5 * obs)[:, 0] ** 2), 150)
    for obs in (-1.0, 0.0, 1.0):
        found = jnp.tanh(_mean(learner, state.policy, jnp.array([obs])))
        assert float(found[0]) == pytest.approx(0.5 * obs, abs=0.1)
    assert float(jnp.exp(state.policy.log_sigma[0])) < 0.3  # less exploration is better here


@pytest.mark.parametrize("config", [PPO_SMALL, TRPO_SMALL])
def test_probe_the_value_is_the_expected_reward(config):
    learner = config.build(1)
    state, _ = learned(learner, lambda obs, action: 2.0 * obs[:, 0] + 0.0 * action[:, 0], 150)
    for obs in (-1.0, 0.0, 1.0):
        assert float(learner.value(state, jnp.array([obs]))) == pytest.approx(2.0 * obs, abs=0.15)


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (replace(PPOConfig(), clip=0.0), "agent.clip is 0.0; it must be positive"),
        (replace(PPOConfig(), whiten=0.1), "agent.whiten is 0.1 and agent.prefill is 0; both must be positive, or 0"),
        (replace(TRPOConfig(), kl=0.0), "agent.kl is 0.0; it must be positive"),
        (replace(TRPOConfig(), discount=1.0), r"agent.discount is 1.0 and agent.gae_lambda is 0.97"),
        (replace(TRPOConfig(), hidden=()), "positive widths"),
    ],
)
def test_settings_that_make_no_sense_are_refused(config, text):
    with pytest.raises(ValueError, match=text):
        config.check()
