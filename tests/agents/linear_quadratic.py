"""A linear-quadratic task whose policy gradient is known: x' = a x + b u, u = K x + k + sigma n, from x = 1."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.agents.agent import Experience
from jaxouter.agents.gaussian import GaussianPolicy, draw
from jaxouter.agents.networks import Actor
from jaxouter.agents.returns import generalised_advantage

A, B, PRICE, STEPS = 0.8, 0.5, 0.1, 5
HIDDEN = (1,)  # one ReLU that is always on: u is linear in x


def policy(sigma: float = 0.3) -> GaussianPolicy:
    actor = Actor(HIDDEN, 1).init(jax.random.key(0), jnp.zeros(1))
    leaves = [jnp.asarray(leaf, float) for leaf in ([3.0], [[0.5]], [1.9], [[-0.6]])]  # K -0.3, k 0.1
    return GaussianPolicy(jax.tree.unflatten(jax.tree.structure(actor), leaves), jnp.log(jnp.full(1, sigma)))


def expected_return(params: GaussianPolicy) -> jax.Array:
    """By the recursion of mean and variance."""
    first, last = params.actor["params"]["Dense_0"], params.actor["params"]["Dense_1"]
    gain = (first["kernel"] @ last["kernel"])[0, 0]
    offset = (first["bias"] @ last["kernel"])[0] + last["bias"][0]
    noise, mean, variance, total = jnp.exp(2.0 * params.log_sigma[0]), 1.0, 0.0, 0.0
    for _ in range(STEPS):
        of_u, spread = gain * mean + offset, gain**2 * variance + noise
        mean, variance = (A + B * gain) * mean + B * offset, (A + B * gain) ** 2 * variance + B**2 * noise
        total -= mean**2 + variance + PRICE * (of_u**2 + spread)
    return jnp.asarray(total)


def experience(params: GaussianPolicy, episodes: int, key: jax.Array) -> Experience:
    """What the policy does; (episodes * STEPS, ...), those of an episode side by side."""

    def step(x: jax.Array, normal: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        _, sample = draw(HIDDEN, params, x, normal)
        after = A * x + B * sample.u
        return after, (x, sample, -jnp.sum(after**2) - PRICE * jnp.sum(sample.u**2))

    def episode(normal: jax.Array) -> Experience:
        _, (x, sample, reward) = jax.lax.scan(step, jnp.ones(1), normal)
        ended = np.arange(STEPS) == STEPS - 1
        nothing = jnp.zeros(STEPS)
        advantage = generalised_advantage(reward, nothing, nothing, jnp.asarray(ended), jnp.asarray(ended), 1.0, 1.0)
        return Experience(x, jnp.tanh(sample.u), sample, advantage, advantage)

    found = jax.vmap(episode)(jax.random.normal(key, (episodes, STEPS, 1), float))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def check(gradient, episodes: int = 4_000, parts: int = 25) -> None:
    """That `gradient(policy, batch)`, of the surrogate, is the exact one of the return, within sampling error."""
    params = policy()
    batch = experience(params, parts * episodes, jax.random.key(1))
    mean, spread = jnp.mean(batch.advantage), jnp.std(batch.advantage)
    batch = batch._replace(advantage=(batch.advantage - mean) / spread)
    by_part = jax.tree.map(lambda leaf: leaf.reshape(parts, -1, *leaf.shape[1:]), batch)
    found = jax.jit(jax.vmap(gradient, (None, 0)))(params, by_part)
    exact = jax.tree.map(lambda leaf: leaf / (STEPS * spread), jax.grad(expected_return)(params))
    for of_parts, expected in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
        error = np.std(of_parts, 0) / parts**0.5
        assert np.all(error < 0.1 * np.abs(expected))  # so that the next line says something
        assert np.all(np.abs(np.mean(of_parts, 0) - expected) < 4.0 * error)
