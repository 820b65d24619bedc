"""The two simplest policies."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop import policy
from jaxouter.loop.policy import Affine, AffineParams
from jaxouter.plants.heaters import HEATERS
from jaxouter.plants.pitch import PITCH


def chosen(actor: Affine, params: AffineParams, r: float, y: float = 1.0) -> float:
    r_, y_ = jnp.asarray(r, float), jnp.asarray(y, float)
    carry, r_tilde = actor.act(params, actor.init(params, r_, y_), r_, y_)
    assert carry == ()
    return float(r_tilde)


@pytest.mark.parametrize("r", [-16.0, 0.0, 14.66])
def test_none_shows_the_reference_itself(r: float) -> None:
    assert chosen(*policy.none(PITCH), r) == np.float32(r)


@pytest.mark.parametrize(("r", "shown"), [(-1.0, 0.0), (0.0, 0.0), (40.0, 40.0), (45.0, 40.0)])
def test_bounds_are_kept(r: float, shown: float) -> None:
    assert chosen(*policy.none(HEATERS), r) == shown


def test_affine_has_slope_and_offset() -> None:
    params = AffineParams(jnp.asarray(3.0, float), jnp.asarray(-0.5, float))
    assert chosen(Affine(PITCH.r_tilde_bounds), params, 4.0) == pytest.approx(11.5)
    assert chosen(Affine(PITCH.r_tilde_bounds), params, 25.0) == 60.0


def test_output_is_not_used() -> None:
    actor, params = policy.none(PITCH)
    assert chosen(actor, params, 5.0, y=-40.0) == chosen(actor, params, 5.0, y=40.0)


def test_it_is_static_and_its_parameters_are_traced() -> None:
    act = jax.jit(Affine.act, static_argnums=0)
    actor, params = policy.none(PITCH)
    again, _ = policy.none(PITCH)
    assert actor == again
    assert hash(actor) == hash(again)
    references = jnp.array([1.0, 2.0])
    slopes = AffineParams(jnp.array([1.0, 3.0]), jnp.array([0.0, 0.5]))
    _, lanes = jax.vmap(lambda p, r: act(actor, p, (), r, r))(slopes, references)
    np.testing.assert_allclose(lanes, [1.0, 6.5])
    assert not actor.host
    assert float(act(actor, params, (), references[1], references[0])[1]) == 2.0
