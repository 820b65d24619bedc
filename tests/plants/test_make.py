"""Making plants by name, what is said about wrong values, and running a plant alone."""

from __future__ import annotations

import re
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.plants import REGISTRY, make, resolve, simulate
from jaxouter.plants.base import Plant
from jaxouter.plants.heaters import HEATERS
from jaxouter.plants.pitch import PITCH
from tests.precision import FLOAT

KEY = jax.random.key(0)


def test_name_gives_plant_and_parameters() -> None:
    plant, params = make("pitch", d1=0.57)
    assert plant is PITCH
    assert float(params.d1) == pytest.approx(0.57)


def test_each_plant_has_the_name_it_is_registered_under() -> None:
    assert {name: make(name)[0].name for name in REGISTRY} == {name: name for name in REGISTRY}


@pytest.mark.parametrize("name", REGISTRY)
def test_plants_are_hashable(name: str) -> None:
    assert hash(make(name)[0]) == hash(make(name)[0])


@pytest.mark.parametrize("function", [resolve, make])
def test_unknown_plant_is_named_with_those_that_exist(function: Any) -> None:
    with pytest.raises(ValueError, match=r"'pich'.*pitch, heaters"):
        function("pich")


def test_unknown_override_is_named_with_those_that_exist() -> None:
    with pytest.raises(ValueError, match=r"'pitch'.*no parameter delay;.*tau, d1, d2"):
        make("pitch", delay=0.5)


@pytest.mark.parametrize(
    ("name", "overrides", "words"),
    [
        ("pitch", {"W": (0.1, 0.3)}, ["W", "(2,)", "(3,)"]),
        ("pitch", {"A": np.eye(3), "K1": np.zeros(4), "K2": 0.0}, ["A", "(3, 3)", "(4, 4)"]),
        ("pitch", {"A": np.eye(3)}, ["A", "(3, 3)", "(4, 4)"]),
        ("pitch", {"B": (1.0, 2.0, 3.0)}, ["B", "(3,)", "(4,)"]),
        ("pitch", {"Q": (1.0, 2.0)}, ["Q", "(2,)", "(5,)"]),
        ("pitch", {"R": 0.0}, ["R is 0.0", "positive"]),
        ("pitch", {"tau": [0.5, 0.5]}, ["tau", "(2,)", "a number"]),
        ("pitch", {"tau": float("nan")}, ["tau", "nan", "max_delay"]),
        ("pitch", {"tau": float("inf")}, ["tau", "inf", "max_delay"]),
        ("pitch", {"max_delay": -1.0}, ["max_delay is -1", "at least 0"]),
        ("heaters", {"n": 2.5}, ["n is 2.5", "at least 1"]),
        ("heaters", {"sigma": -1.0}, ["sigma is -1.0", "negative"]),
        ("heaters", {"Ca": 0.0}, ["Ca is 0.0", "positive"]),
        ("heaters", {"weights": [0.0] * 4}, ["weights", "positive"]),
        ("pitch", {"tau": -0.1}, ["tau", "-0.1", "[0, 0]"]),
        ("pitch", {"d1": -0.2}, ["d1", "-0.2", "[0, 0.5]"]),
        ("pitch", {"d2": 0.57, "max_delay": 0.5}, ["d2", "0.57", "max_delay", "[0, 0.5]"]),
        ("pitch", {"substeps": 5}, ["substeps", "5", "at least 10"]),
        ("heaters", {"n": 0}, ["n is 0", "at least 1"]),
        ("heaters", {"substeps": 0}, ["substeps is 0", "at least 1"]),
        ("heaters", {"Ca": [10.0, 11.0]}, ["Ca", "(2,)", "a number", "(4,)"]),
        ("heaters", {"x0_mean": np.zeros((4, 1))}, ["x0_mean", "(4, 1)", "a number", "(4,)"]),
        ("heaters", {"weights": [1.0]}, ["weights", "(1,)", "(4,)"]),
        ("heaters", {"u_free": "real"}, ["u_free", "'real'", "printed, physical"]),
        ("heaters", {"u_free": "physical"}, ["u_free", "Pi", "17.186", "0.4"]),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_message_names_field_value_and_what_is_allowed(name: str, overrides: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ValueError, match=re.escape(words[0])) as caught:
        make(name, **overrides)
    assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize("field", ["r_tilde_bounds", "setpoint_range", "evaluation_range", "divergence_bounds"])
def test_declared_ranges_must_be_ordered(field: str) -> None:
    with pytest.raises(ValueError, match=rf"'pitch'.*{field} is \(2, 1\)"):
        Plant(**{**vars(PITCH), field: (2, 1)})


@pytest.mark.parametrize("field", ["control_step", "episode_steps"])
def test_declared_times_must_be_positive(field: str) -> None:
    with pytest.raises(ValueError, match=f"'heaters'.*{field}"):
        Plant(**{**vars(HEATERS), field: 0})


def test_shortest_lines_that_serve_are_the_default() -> None:
    assert make("pitch", d1=5.7)[1].max_delay == pytest.approx(5.7)
    assert make("pitch", tau=0.537)[1].max_delay == pytest.approx(0.6)
    assert make("pitch")[1].max_delay == pytest.approx(0.5)


@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_simulate_wants_one_sequence(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=rf"r_tilde has shape {re.escape(str(shape))}.*\(T,\)"):
        simulate(*make("heaters"), np.ones(shape), KEY)


def test_simulate_takes_plain_numbers() -> None:
    y = simulate(*make("heaters"), [20, 21, 22], KEY)
    chex.assert_shape(y, (3,))
    chex.assert_type(y, FLOAT)


@pytest.mark.parametrize(
    ("name", "overrides"),
    [("pitch", {"tau": 0.537, "d1": 0.123, "d2": 0.3, "max_delay": 8.0}), ("heaters", {"sigma": 0.0})],
    ids=["pitch", "heaters"],
)
def test_simulate_continues_from_a_state(name: str, overrides: dict[str, float]) -> None:
    plant, params = make(name, **overrides)
    r_tilde = jnp.linspace(15.0, 25.0, 200)
    whole = simulate(plant, params, r_tilde, KEY)
    state, step = plant.init(jax.random.split(KEY)[0], params), jax.jit(plant.step)
    first = []
    for value in r_tilde[:30]:
        state = step(params, state, value, KEY)
        first.append(plant.output(params, state))
    rest = simulate(plant, params, jnp.roll(r_tilde, -30), KEY, state)[:170]
    chex.assert_trees_all_close(jnp.concatenate([jnp.stack(first), rest]), whole, atol=1e-5)
    from_rest = simulate(plant, params, jnp.roll(r_tilde, -30), KEY)[:170]
    assert float(jnp.abs(from_rest - rest).max()) > 0.1


def test_key_decides_the_noise() -> None:
    plant, params = make("heaters")
    r_tilde = np.full(200, 20.0)
    once, again, other = (simulate(plant, params, r_tilde, jax.random.key(seed)) for seed in (0, 0, 1))
    chex.assert_trees_all_equal(once, again)
    assert float(jnp.abs(once - other).max()) > 0.01
