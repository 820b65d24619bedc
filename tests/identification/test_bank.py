"""A bank of base laws from records of several plants."""

import jax
import numpy as np
import pytest

from jaxouter.identification import bank
from jaxouter.loop import bank as loop_bank
from tests import kinds, lag

GAINS = (0.5, 2.0)
MEMBERS = tuple((0.1, (("K", gain),)) for gain in GAINS)


@pytest.fixture(scope="module")
def found():
    plant, params = lag.make(d=0.2)
    return bank.identify(plant, params, MEMBERS, jax.random.key(0), 6, 8, 6)


def test_models_and_laws_are_those_of_the_plants(found):
    it = found.base
    assert it.a.shape == it.b.shape == it.laws.y_past.shape == (2, 6)
    np.testing.assert_allclose(np.sum(it.b, 1) / (1.0 - np.sum(it.a, 1)), GAINS, rtol=0.02)
    # At rest in the middle of the range y = r, whatever the gain.
    np.testing.assert_allclose(it.laws.r + it.laws.y, 0.0, atol=1e-5)
    np.testing.assert_allclose(np.sum(it.laws.r_tilde_past, 1), 1.0, atol=1e-4)
    assert it.floor == pytest.approx((loop_bank.FLOOR * np.ptp(lag.LAG.setpoint_range) / 2) ** 2)


def test_every_episode_is_replayed_by_the_model_of_its_plant(found):
    params, plant = found.params, lag.LAG
    assert params.y.shape == (2 * 14, plant.episode_steps + 1)
    np.testing.assert_array_equal(params.a, np.repeat(found.base.a, 14, 0))
    assert np.isfinite(params.y).all()


def test_starts_that_no_r_tilde_brings_back_are_left_out():
    """The second member grows: |y| beyond 0.04 x 4 / (1.4 - 1) = 0.4 can't be brought back; starts are up to 0.5."""
    plant, params = kinds.kind([0.9], [0.04], divergence_bounds=(-12.0, 12.0))()
    members = ((0.1, (("a[0]", 0.9),)), (1.0, (("a[0]", 1.4),)))
    params = bank.identify(plant, params, members, jax.random.key(0), 3, 16, 8).params
    grows = params.a.sum(1) > 1.0
    assert (~grows).sum() == 24  # 16 under random r~ and 8 in closed loop
    assert 8 < grows.sum() < 24
    assert np.abs(params.y[grows, 0]).max() < 0.41
    assert np.isfinite(params.y).all()


def test_ranges_are_those_of_the_members_and_the_nominal_plant():
    params = lag.make(K=1.0)[1]
    assert bank.ranges(params, MEMBERS) == (("K", 0.5, 2.0),)
    assert bank.ranges(params, MEMBERS[:1]) == (("K", 0.5, 1.0),)
    with pytest.raises(ValueError, match="a plant of the bank sets 'gain'; the numbers are: K, T, d"):
        bank.ranges(params, ((0.1, (("gain", 2.0),)),))


def test_an_episode_is_on_one_of_the_members():
    plant, params = bank.drawing(*lag.make(K=1.0, d=0.2), MEMBERS)
    drawn = jax.vmap(plant.draw, (0, None))(jax.random.split(jax.random.key(0), 32), params)
    assert set(np.asarray(drawn.K).tolist()) == set(GAINS)
    np.testing.assert_allclose(drawn.T, params.T[0])


def test_a_member_that_no_r_tilde_holds_is_refused():
    plant, params = kinds.kind([0.9], [0.01], divergence_bounds=(-12.0, 12.0), r_tilde_bounds=(-0.01, 0.01))()
    text = r"brings back none of the 16 recorded starts of a plant of the bank: a\[0\] 1\.2"
    with pytest.raises(ValueError, match=text):
        bank.identify(plant, params, ((0.1, (("a[0]", 1.2),)),), jax.random.key(4), 5, 16, 0)
