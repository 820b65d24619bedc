"""Domain randomisation: what is drawn, and what is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.plants import make, randomised, simulate

KEY = jax.random.key(4)


def draws(plant, params, n=200):
    return jax.vmap(plant.draw, (0, None))(jax.random.split(KEY, n), params)


@pytest.mark.parametrize(
    ("name", "ranges"),
    [("pitch", (("gain", 0.8, 1.2), ("d1", 0.0, 0.7))), ("heaters", (("Pi", 0.4, 17.2), ("x_out", -15.0, 0.0)))],
)
def test_what_is_named_is_drawn_over_its_range_and_the_rest_stays(name, ranges):
    plant, params = randomised(*make(name), ranges)
    drawn = draws(plant, params)
    found = {path[-1].name: leaf for path, leaf in jax.tree_util.tree_leaves_with_path(drawn)}
    given = {path[-1].name: leaf for path, leaf in jax.tree_util.tree_leaves_with_path(params)}
    for field, low, high in ranges:
        values = np.asarray(found.pop(field))
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    for field, values in found.items():
        np.testing.assert_array_equal(values, np.broadcast_to(given[field], values.shape))


def test_elements_of_a_vector_are_numbers_too():
    plant, params = randomised(*make("pitch"), (("W[1]", -0.02, 0.02), ("W[2]", 0.5, 0.5)))
    W = np.asarray(draws(plant, params).W)
    np.testing.assert_array_equal(W[:, 0], params.W[0])
    assert -0.02 <= W[:, 1].min() < -0.015
    assert 0.015 < W[:, 1].max() <= 0.02
    np.testing.assert_array_equal(W[:, 2], 0.5)


def test_numbers_are_drawn_apart():
    plant, params = randomised(*make("pitch"), (("gain", 0.0, 1.0), ("d1", 0.0, 1.0)))
    drawn = draws(plant, params)
    assert abs(np.corrcoef(drawn.gain, drawn.d1)[0, 1]) < 0.2


def test_a_drawn_delay_acts_as_one_that_was_given():
    plant, params = randomised(*make("pitch"), (("d1", 0.3, 0.9),))
    drawn = plant.draw(KEY, params)
    same, of_same = make("pitch", d1=float(drawn.d1))
    r_tilde = jnp.full(100, 16.0)
    np.testing.assert_allclose(simulate(plant, drawn, r_tilde, KEY), simulate(same, of_same, r_tilde, KEY), atol=1e-3)


@pytest.mark.parametrize(
    ("ranges", "text"),
    [
        ((("d3", 0.0, 1.0),), r"plant 'pitch' has no number 'd3' to draw; it has: A_h, B\[0\], "),
        ((("W", 0.0, 1.0),), "no number 'W'"),
        ((("gain", 1.2, 0.8),), "the range of gain is 1.2 to 0.8; the first must not be above the second"),
        ((("d1", -0.1, 0.5),), "the range of d1 is -0.1 to 0.5 s; a delay must not be negative"),
    ],
)
def test_bad_ranges_are_named(ranges, text):
    with pytest.raises(ValueError, match=text):
        randomised(*make("pitch"), ranges)
