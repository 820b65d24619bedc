import jax
import jax.numpy as jnp
import pytest

from jaxouter.agents.noise import ornstein_uhlenbeck


@pytest.mark.parametrize(("theta", "sigma"), [(0.15, 0.2), (0.5, 0.1), (1.0, 0.3)])
def test_stationary_variance_and_correlation_are_those_of_the_process(theta, sigma):
    normals = jax.random.normal(jax.random.key(0), (400, 2000))

    def step(x, normal):
        x = ornstein_uhlenbeck(x, normal, theta, sigma)
        return x, x

    _, x = jax.lax.scan(step, jnp.zeros(2000), normals)
    late, before = x[-1], x[-2]
    variance = sigma**2 / (1 - (1 - theta) ** 2)
    assert float(jnp.mean(x[-50:] ** 2)) == pytest.approx(variance, rel=0.05)
    assert float(jnp.mean(late * before)) == pytest.approx((1 - theta) * variance, abs=0.1 * variance)


def test_one_step_by_hand():
    assert float(ornstein_uhlenbeck(jnp.array(2.0), jnp.array(-1.0), 0.25, 0.5)) == pytest.approx(2.0 - 0.5 - 0.5)
