"""The plant made of linear models: by hand, at rest, drawn and undrawn, under vmap and its own inverse."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.evaluation.stability import analyse
from jaxouter.loop.policy import none
from jaxouter.plants import arx
from jaxouter.plants.arx import Model
from jaxouter.plants.base import float_leaves, with_float_leaves

KEY = jax.random.key(0)
DECLARED = dict(
    name="models",
    y_unit="1",
    time_unit="s",
    control_step=0.5,
    episode_steps=100,
    r_tilde_bounds=(-2.0, 2.0),
    setpoint_range=(0.0, 2.0),
    evaluation_range=(0.0, 2.0),
    divergence_bounds=(-9.0, 9.0),
)
NOMINAL = Model(np.array([0.5, 0.2]), np.array([0.0, 0.3]), np.array(0.1), np.array(0.0))
OTHER = Model(np.array([0.5, 0.1]), np.array([0.2, 0.2]), np.array(0.2), np.array(0.1))
PLANT, PARAMS = arx.make(NOMINAL, [NOMINAL, OTHER, OTHER], **DECLARED)


def test_it_does_what_the_equation_says() -> None:
    r_tilde = np.array([1.0, -1.0, 0.5, 2.0])
    y, before = [1.0, 1.0], [float(jnp.mean(PARAMS.held))]
    for r in r_tilde:
        y.append(0.5 * y[-1] + 0.2 * y[-2] + 0.3 * before[-1] + 0.1)
        before.append(r)
    np.testing.assert_allclose(plants.simulate(PLANT, PARAMS, r_tilde, KEY), y[2:], rtol=1e-5)


def test_it_is_at_rest_in_the_middle_of_the_set_points() -> None:
    np.testing.assert_allclose(PARAMS.held, [-1 / 3, 5 / 3], atol=1e-6)  # y = r~ + 1/3 in steady state
    y = plants.simulate(PLANT, PARAMS, jnp.full(50, jnp.mean(PARAMS.held)), KEY)
    np.testing.assert_allclose(y, 1.0, atol=1e-5)


def test_starts_are_at_rest_within_the_set_points() -> None:
    states = jax.vmap(PLANT.training_start, (0, None))(jax.random.split(KEY, 200), PARAMS)
    assert float(states.y.min()) >= -1e-6
    assert float(states.y.max()) <= 2.0 + 1e-6
    assert float(jnp.ptp(states.y)) > 1.9
    np.testing.assert_allclose(states.y[:, 0], states.r_tilde[:, 0] + 1 / 3, atol=1e-5)


def test_each_episode_draws_a_member_and_undrawn_the_nominal_one_acts() -> None:
    assert PLANT.draw is not None
    drawn = jax.vmap(PLANT.draw, (0, None))(jax.random.split(KEY, 300), PARAMS)
    is_other = np.isclose(drawn.model.c, 0.2)
    assert 0.55 < is_other.mean() < 0.78
    np.testing.assert_allclose(drawn.model.b[is_other], np.tile(OTHER.b, (is_other.sum(), 1)), rtol=1e-6)
    np.testing.assert_allclose(PARAMS.model.b, NOMINAL.b, rtol=1e-6)


def test_noise_is_that_of_the_member_and_can_be_switched_off() -> None:
    params = PARAMS._replace(model=jax.tree.map(lambda leaf: leaf[1], PARAMS.ensemble))
    r_tilde = jnp.zeros(4_000)
    noise = plants.simulate(PLANT, params, r_tilde, KEY) - plants.simulate(
        PLANT, PLANT.noise_free(params), r_tilde, KEY
    )
    e = noise[2:] - 0.5 * noise[1:-1] - 0.1 * noise[:-2]
    assert float(jnp.std(e)) == pytest.approx(0.1, rel=0.05)
    assert not np.any(PLANT.noise_free(params).ensemble.sigma)


def test_gradients_pass_through_an_episode() -> None:
    def end(r_tilde: jax.Array) -> jax.Array:
        return plants.simulate(PLANT, PARAMS, jnp.full(60, 1.0) * r_tilde, KEY)[-1]

    assert float(jax.grad(end)(jnp.asarray(1.0, float))) == pytest.approx(1.0, rel=1e-3)  # the DC gain


def test_variables_and_settled_are_inverse() -> None:
    state = PLANT.training_start(KEY, PARAMS)
    again = with_float_leaves(PARAMS, state, float_leaves(PARAMS, state))
    jax.tree.map(np.testing.assert_array_equal, again, state)


def test_a_loop_around_it_is_analysed() -> None:
    """r~ = r leaves the poles of the model: 0.5 and 0.2 of z^2 - 0.5 z - 0.2."""
    (found,) = analyse(*none(PLANT), PLANT, PARAMS, [1.0])
    assert found.spectral_radius == pytest.approx((0.5 + np.sqrt(0.25 + 0.8)) / 2, abs=1e-6)
    assert found.y == pytest.approx(1.0 + 1 / 3, abs=1e-6)


def test_two_of_the_same_declaration_are_one_to_jit() -> None:
    assert hash(PLANT) == hash(arx.make(NOMINAL, [OTHER], **DECLARED)[0])
