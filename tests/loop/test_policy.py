"""Policies that are linear."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop import policy
from jaxouter.loop.policy import Linear, LinearLaw, affine
from jaxouter.plants.heaters import HEATERS
from jaxouter.plants.pitch import PITCH


def chosen(actor: Linear, params: LinearLaw, r: float, y: float = 1.0) -> float:
    r_, y_ = jnp.asarray(r, float), jnp.asarray(y, float)
    carry, r_tilde = actor.act(params, actor.init(params, r_, y_), r_, y_)
    assert carry.y_past.shape == (0,)
    return float(r_tilde)


@pytest.mark.parametrize("r", [-16.0, 0.0, 14.66])
def test_none_shows_the_reference_itself(r: float) -> None:
    assert chosen(*policy.none(PITCH), r) == np.float32(r)


@pytest.mark.parametrize(("r", "shown"), [(-1.0, 0.0), (0.0, 0.0), (40.0, 40.0), (45.0, 40.0)])
def test_bounds_are_kept(r: float, shown: float) -> None:
    assert chosen(*policy.none(HEATERS), r) == shown


def test_affine_has_slope_and_offset() -> None:
    params = affine(3.0, -0.5)
    assert chosen(Linear(PITCH.r_tilde_bounds), params, 4.0) == pytest.approx(11.5)
    assert chosen(Linear(PITCH.r_tilde_bounds), params, 25.0) == 60.0


def test_output_is_not_used() -> None:
    actor, params = policy.none(PITCH)
    assert chosen(actor, params, 5.0, y=-40.0) == chosen(actor, params, 5.0, y=40.0)


def test_it_is_static_and_its_parameters_are_traced() -> None:
    act = jax.jit(Linear.act, static_argnums=0)
    actor, params = policy.none(PITCH)
    again, _ = policy.none(PITCH)
    assert actor == again
    assert hash(actor) == hash(again)
    references = jnp.array([1.0, 2.0])
    slopes = jax.vmap(affine)(jnp.array([1.0, 3.0]), jnp.array([0.0, 0.5]))
    _, lanes = jax.vmap(lambda p, r: act(actor, p, actor.init(p, r, r), r, r))(slopes, references)
    np.testing.assert_allclose(lanes, [1.0, 6.5])
    assert not actor.host
    assert float(act(actor, params, actor.init(params, *references), references[1], references[0])[1]) == 2.0


def test_a_law_with_lags_is_its_formula_and_its_past_holds_what_was_applied() -> None:
    rng = np.random.default_rng(0)
    law = LinearLaw(*(jnp.asarray(each, float) for each in (0.3, 0.7, -0.7, rng.normal(size=3), rng.normal(size=3))))
    actor, r, y = Linear((-2.0, 2.0)), rng.normal(size=12), rng.normal(size=12)
    carry = actor.init(law, jnp.asarray(r[0], float), jnp.asarray(y[0], float))
    before_y, before_r_tilde = np.full(3, y[0]), np.full(3, np.clip(y[0], -2.0, 2.0))
    clipped = 0
    for r_k, y_k in zip(r, y, strict=True):
        carry, r_tilde = actor.act(law, carry, jnp.asarray(r_k, float), jnp.asarray(y_k, float))
        of_past = np.asarray(law.y_past) @ (before_y - y_k) + np.asarray(law.r_tilde_past) @ before_r_tilde
        wanted = 0.3 + 0.7 * (r_k - y_k) + of_past
        clipped += int(abs(wanted) > 2.0)
        assert float(r_tilde) == pytest.approx(np.clip(wanted, -2.0, 2.0), rel=1e-4, abs=1e-5)
        before_y, before_r_tilde = np.append(y_k, before_y[:2]), np.append(r_tilde, before_r_tilde[:2])
    assert 0 < clipped < 12


def test_further_lags_of_zero_change_nothing() -> None:
    law = LinearLaw(*(jnp.asarray(each, float) for each in (0.3, 0.7, -0.7, [0.5, -0.2], [1.2, -0.2])))
    past = policy.Past(jnp.arange(5.0), jnp.arange(5.0, 10.0))
    r, y = jnp.asarray(1.0, float), jnp.asarray(2.0, float)
    longer = policy.padded(law, 5)
    assert longer.y_past.shape == (5,)
    assert float(policy.unclipped(longer, past, r, y)) == pytest.approx(float(policy.unclipped(law, past, r, y)))
