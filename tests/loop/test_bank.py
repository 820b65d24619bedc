"""A bank of base laws: by hand, and on plants that its models predict."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop import bank
from jaxouter.loop.bank import FORGETTING, HYSTERESIS, RATE, Bank
from jaxouter.loop.policy import Past, affine

GAINS = (0.5, 2.0)  # of y_k = 0.5 y_(k-1) + 0.5 gain r~_(k-1)
HALF = 10.0  # of the set-point range


class Seen(NamedTuple):
    """What a bank says of a plant; (T, ...)."""

    mean_error: np.ndarray
    performance: np.ndarray
    active: np.ndarray


def made(gains=GAINS) -> Bank:
    laws = [affine(1.0 / gain, 0.0, 2) for gain in gains]
    a, b = ([[0.5, 0.0]] * len(gains), [[0.5 * gain, 0.0] for gain in gains])
    return bank.of(laws, a, b, HALF)


def judged(gain: float, load: float = 0.0, steps: int = 60, y0: float = 0.0, gains=GAINS) -> Seen:
    """Evidence over some steps of random r~ on a plant of this gain."""
    it, evidence = made(gains), made(gains).begin()
    past, y, found = Past.of(jnp.asarray(y0), 2, (-50.0, 50.0)), y0, []
    for r_tilde in np.random.default_rng(0).uniform(-5.0, 5.0, steps):
        evidence = it.judge(evidence, past, jnp.asarray(y, float))
        past = past.then(jnp.asarray(y, float), jnp.asarray(r_tilde, float))
        y = 0.5 * y + 0.5 * gain * (r_tilde + load)
        found.append(evidence)
    return Seen(*map(np.asarray, zip(*found, strict=True)))


def test_index_mean_and_floor_are_as_computed_by_hand():
    it, past = made(), Past(jnp.array([2.0, 0.0]), jnp.array([4.0, 0.0]))
    evidence = it.begin()._replace(
        active=jnp.int32(0), mean_error=jnp.array([0.5, 0.0]), performance=jnp.array([1.0, 2.0])
    )
    found = it.judge(evidence, past, jnp.array(3.0))
    error = np.array([3.0 - (1.0 + 1.0) - 0.5, 3.0 - (1.0 + 4.0)])
    np.testing.assert_allclose(found.mean_error, [0.5, 0.0] + RATE * error, rtol=1e-6)
    np.testing.assert_allclose(found.performance, FORGETTING * np.array([1.0, 2.0]) + error**2 / 1.25, rtol=1e-6)
    assert it.floor == pytest.approx((0.003 * HALF) ** 2)


@pytest.mark.parametrize("which", [0, 1])
def test_the_law_of_the_plant_acts(which):
    seen = judged(GAINS[which])
    assert (seen.active[0], seen.active[-1]) == (0, which)
    assert (seen.active[5:] == which).all()
    assert seen.performance[-1, which] < 1e-6
    law = made().law(bank.Evidence(*(jnp.asarray(each[-1]) for each in seen)))
    assert law.r == pytest.approx(1.0 / GAINS[which])


@pytest.mark.parametrize("which", [0, 1])
def test_neither_a_load_nor_a_start_away_from_rest_hides_it(which):
    assert judged(GAINS[which], load=3.0).active[-1] == which
    assert judged(GAINS[which], y0=8.0).active[-1] == which


def test_a_law_takes_over_only_where_its_index_is_lower_by_more_than_the_hysteresis():
    it, past = made(), Past(jnp.zeros(2), jnp.zeros(2))  # both predict 0
    for factor, active in ((0.99, 0), (1.01, 1)):
        floor = float(it.floor)
        other = (1.0 + floor) / (HYSTERESIS * factor) - floor
        before = it.begin()._replace(active=jnp.int32(0), performance=jnp.array([1.0, other]) / FORGETTING)
        assert it.judge(before, past, jnp.array(0.0)).active == active


def test_alike_models_never_switch():
    assert (judged(0.7, gains=(0.5, 0.5)).active == 0).all()


def test_without_switching_the_first_law_goes_on_to_act():
    evidence = made().begin()
    assert evidence.active == -1
    for y in (0.0, 5.0, -5.0):
        evidence = made().without_switching().judge(evidence, Past(jnp.zeros(2), 3.0 * jnp.ones(2)), jnp.array(y))
    assert evidence.active == 0


def test_a_bank_of_one_law_throughout():
    it = made().all_of(affine(3.0, 1.0))
    jax.tree.map(
        np.testing.assert_array_equal, it.laws, jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), affine(3.0, 1.0, 2))
    )


def test_it_is_not_differentiated():
    def index(y):
        evidence = made().begin()
        for _ in range(2):
            evidence = made().judge(evidence, Past(y * jnp.ones(2), jnp.zeros(2)), y)
        return jnp.sum(evidence.performance + evidence.mean_error)

    assert jax.grad(index)(jnp.array(2.0)) == 0.0
