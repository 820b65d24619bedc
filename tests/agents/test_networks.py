import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.agents.networks import Actor, AdvantageCritic, Critic, QuadraticCritic


def test_layers_are_those_of_the_paper():
    obs, action = jnp.zeros(33), jnp.zeros(1)
    actor = Actor((400, 300), 1).init(jax.random.key(0), obs)["params"]
    critic = Critic((400, 300), False).init(jax.random.key(0), obs, action)["params"]
    chex.assert_shape([actor[f"Dense_{i}"]["kernel"] for i in range(3)], [(33, 400), (400, 300), (300, 1)])
    chex.assert_shape([critic[f"Dense_{i}"]["kernel"] for i in range(3)], [(33, 400), (400, 300), (300, 1)])
    chex.assert_shape(critic["action"]["kernel"], (1, 300))  # the 401st row of the second layer
    bounds = [float(jnp.abs(critic[name]["kernel"]).max()) for name in ("Dense_1", "action")]
    np.testing.assert_allclose(bounds, 401**-0.5, rtol=0.05)


def test_initial_weights_are_uniform_in_fan_in_and_small_at_the_end():
    params = Actor((400, 300), 1).init(jax.random.key(1), jnp.zeros(33))["params"]
    for i, bound in enumerate((33**-0.5, 400**-0.5, 3e-3)):
        kernel = np.asarray(params[f"Dense_{i}"]["kernel"])
        assert np.abs(kernel).max() <= bound
        assert np.abs(kernel).max() > 0.95 * bound


def test_first_critic_layer_does_not_see_the_action():
    critic = Critic((8, 8), False)
    obs, action = jnp.ones(3), jnp.ones(1)
    params = critic.init(jax.random.key(0), obs, action)
    blind = jax.tree.map(jnp.copy, params)
    blind["params"]["action"] = jax.tree.map(jnp.zeros_like, blind["params"]["action"])
    assert critic.apply(params, obs, action) != critic.apply(params, obs, -action)
    assert critic.apply(blind, obs, action) == critic.apply(blind, obs, -action)


def test_layer_norm_makes_the_critic_independent_of_the_scale_of_its_first_layer():
    critic = Critic((8, 8), True)
    obs, action = jnp.array([1.0, -2.0, 0.5]), jnp.ones(1)
    params = critic.init(jax.random.key(0), obs, action)
    scaled = jax.tree.map(jnp.copy, params)
    scaled["params"]["Dense_0"] = jax.tree.map(lambda leaf: 10.0 * leaf, scaled["params"]["Dense_0"])
    chex.assert_trees_all_close(critic.apply(params, obs, action), critic.apply(scaled, obs, action), atol=1e-5)


def test_quadratic_critics_are_concave_in_the_action_and_gain_nothing_without_a_change():
    obs, actions = jnp.array([1.0, -2.0, 0.5]), jnp.linspace(-1.0, 1.0, 21)
    for critic, of in ((QuadraticCritic((8, 8)), lambda a: a[None]), (AdvantageCritic((8, 8)), lambda a: a)):
        params = critic.init(jax.random.key(0), obs, of(actions[0]))
        values = np.array([critic.apply(params, obs, of(a)) for a in actions])
        curvature = np.diff(values, 2)
        assert (curvature < 0.0).all()
        np.testing.assert_allclose(curvature, curvature[0], rtol=1e-2)
    assert critic.apply(params, obs, jnp.zeros(())) == 0.0
