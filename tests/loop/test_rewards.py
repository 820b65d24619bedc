"""The reward at, just below and above each of its thresholds."""

from __future__ import annotations

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop import rewards
from jaxouter.plants import Plant
from jaxouter.plants.heaters import HEATERS
from jaxouter.plants.pitch import PITCH
from tests.precision import FLOAT


def below(value: float) -> float:
    """The single-precision number before `value`."""
    return float(np.nextafter(np.float32(value), np.float32(0.0)))


def reward(plant: Plant, **signals: float) -> float:
    """At r = y = y_before = r_tilde = r_tilde_before = 0, but for what is given."""
    names = ("r", "y", "y_before", "r_tilde", "r_tilde_before")
    assert set(signals) <= set(names)
    return float(rewards.reward(rewards.params(plant), *(jnp.asarray(signals.get(name, 0.0), float) for name in names)))


@pytest.mark.parametrize("plant", [PITCH, HEATERS], ids=lambda plant: plant.name)
@pytest.mark.parametrize(("r", "expected"), [(0.0, 0.0), (0.5, -0.15), (2.0, -0.6), (-10.0, -3.0)])
def test_error_is_priced_linearly(plant: Plant, r: float, expected: float) -> None:
    assert reward(plant, r=r) == pytest.approx(expected)


def test_error_is_that_of_the_output_after_the_step() -> None:
    assert reward(PITCH, r=3.0, y=1.0, y_before=3.0) == pytest.approx(-0.6)


@pytest.mark.parametrize(
    ("plant", "move", "expected"),
    [
        (PITCH, below(3.5), 0.0),
        (PITCH, 3.5, -0.35),
        (PITCH, 4.0, -0.4),
        (HEATERS, below(1.0), 0.0),
        (HEATERS, 1.0, -0.1),
        (HEATERS, 1.5, -0.15),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_moves_of_the_modified_reference_are_charged_from_the_threshold_on(
    plant: Plant, move: float, expected: float, sign: float
) -> None:
    assert reward(plant, r_tilde=sign * move) == pytest.approx(expected)
    assert reward(plant, r_tilde_before=sign * move) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("plant", "move", "expected"),
    [
        (PITCH, below(3.5), 0.0),
        (PITCH, 3.5, -0.35),
        (PITCH, 4.0, -0.4),
        (HEATERS, below(1.0), 0.0),
        (HEATERS, 1.0, -0.1),
        (HEATERS, 1.5, -0.15 - 0.5),
        (HEATERS, 4.0, -0.4 - 3.0),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_moves_of_the_output_are_charged_from_the_threshold_on(
    plant: Plant, move: float, expected: float, sign: float
) -> None:
    assert reward(plant, y_before=sign * move) == pytest.approx(expected)
    assert reward(plant, r=sign * move, y=sign * move) == pytest.approx(expected)


@pytest.mark.parametrize(("y", "expected"), [(17.5, 0.0), (18.0, 0.0), (18.5, -0.5), (20.0, -2.0), (-19.0, -1.0)])
def test_pitch_beyond_18_crad_is_always_charged(y: float, expected: float) -> None:
    assert reward(PITCH, r=y, y=y, y_before=y) == pytest.approx(expected)


def test_temperature_has_no_limit() -> None:
    assert reward(HEATERS, r=59.0, y=59.0, y_before=59.0) == 0.0


def test_rate_of_pitch_has_no_limit_beside_the_charge_for_moves() -> None:
    assert reward(PITCH, r=17.0, y=17.0, y_before=-17.0) == pytest.approx(-3.4)


def test_parts_add_up() -> None:
    # G: e = 4; H: 5 crad; B: 6 crad, and 2 beyond the limit.
    assert reward(PITCH, r=16.0, y=20.0, y_before=14.0, r_tilde=25.0, r_tilde_before=30.0) == pytest.approx(
        -1.2 - 0.5 - 0.6 - 2.0
    )
    # G: e = 3; H: 2 degC; B: 1.5 degC, half a degree beyond the limit.
    assert reward(HEATERS, r=20.0, y=17.0, y_before=18.5, r_tilde=30.0, r_tilde_before=28.0) == pytest.approx(
        -0.9 - 0.2 - 0.15 - 0.5
    )


def test_plant_without_thresholds_and_limits_pays_for_the_error_only() -> None:
    plant = dataclasses.replace(PITCH, output_limit=None, rate_limit=None, move_threshold=math.inf)
    assert reward(plant, r=2.0, y=1e3, y_before=-1e3, r_tilde=50.0) == pytest.approx(-0.3 * 998)


def test_divergence_is_configurable_and_costs_50_by_default() -> None:
    assert float(rewards.params(PITCH).divergence) == -50.0
    assert float(rewards.params(PITCH, rewards.RewardConfig(divergence=-7.0)).divergence) == -7.0


def test_constants_are_swept_under_vmap() -> None:
    p = rewards.params(PITCH)
    prices = jnp.array([0.3, 0.6, 0.9])
    r, zero = jnp.asarray(2.0, float), jnp.zeros(())

    def lane(price: jax.Array) -> jax.Array:
        return rewards.reward(dataclasses.replace(p, alpha_g=price), r, zero, zero, zero, zero)

    swept = jax.vmap(lane)(prices)
    chex.assert_trees_all_close(swept, -2.0 * prices)
    chex.assert_type(swept, FLOAT)


@pytest.mark.parametrize(
    ("e", "expected"), [(0.0, 0.0), (0.05, -0.00375), (0.1, -0.015), (0.3, -0.075), (-2.0, -0.585)]
)
def test_error_is_rounded_at_zero_where_asked(e: float, expected: float) -> None:
    """By hand: 0.3 e^2 / (2 * 0.1) below 0.1, and 0.3 (e - 0.05) above."""
    price = rewards.params(PITCH, rewards.RewardConfig(huber=0.1 / 34.0))
    zero = jnp.zeros(())
    found = rewards.reward(price, jnp.asarray(e, float), zero, zero, zero, zero)
    assert float(found) == pytest.approx(expected, rel=1e-5)
    slope = jax.grad(lambda r: rewards.reward(price, r, zero, zero, zero, zero))(jnp.asarray(e, float))
    assert float(slope) == pytest.approx(-0.3 * np.clip(e / 0.1, -1.0, 1.0), abs=1e-6)


@pytest.mark.parametrize(("move", "held", "expected"), [
    (1.75, 30.0, -0.175), (1.75, 29.0, 0.0), (-1.75, 31.0, -0.175), (3.5, 30.0, -0.7), (3.5, 29.0, -0.35),
    (0.0, 30.0, 0.0)
])  # fmt: skip
def test_moves_have_a_least_price_where_r_rests(move: float, held: float, expected: float) -> None:
    """By hand: 0.2 * 1.75^2 / 3.5; from 3.5 on 0.2 instead of 0.1 of the move."""
    zero = jnp.zeros(())
    price = rewards.params(PITCH, rewards.RewardConfig(rest=0.2))
    found = rewards.reward(price, zero, zero, zero, jnp.asarray(move, float), zero, held=held)
    assert float(found) == pytest.approx(expected)


def test_where_moves_cost_more_anyway_rest_adds_nothing() -> None:
    price = rewards.params(PITCH, rewards.RewardConfig(rest=0.05, rho_h=0.0))
    zero = jnp.zeros(())
    found = rewards.reward(price, zero, zero, zero, jnp.asarray(2.0, float), zero, held=50.0)
    assert float(found) == pytest.approx(-0.2)
