import chex
import jax
import jax.numpy as jnp
import optax
import pytest

from jaxouter.agents.adam import adam


@pytest.mark.parametrize("rate", [1e-2, optax.cosine_decay_schedule(1e-2, 20)], ids=["constant", "falling"])
def test_steps_are_those_of_optax(rate):
    params = {"kernel": jnp.ones((3, 2)), "bias": jnp.zeros(2)}
    ours, theirs = adam(rate), optax.adam(rate)
    state, expected_state = ours.init(params), theirs.init(params)
    for i in range(10):
        gradient = jax.tree.map(lambda x, i=i: jax.random.normal(jax.random.key(i), x.shape) * 10.0 ** (i - 8), params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes types
            step, state = ours.update(gradient, state, params)
            expected, expected_state = theirs.update(gradient, expected_state, params)
        chex.assert_trees_all_close(step, expected, rtol=1e-4, atol=1e-9)
