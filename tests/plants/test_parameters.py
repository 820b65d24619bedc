"""Plants by names that set parameters."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jaxouter import cli, plants
from jaxouter.evaluation import scenarios, sweeps
from jaxouter.plants import make, with_parameters


def test_a_name_makes_the_plant_with_its_parameters():
    name = with_parameters("pitch", {"W": np.array([0.1, 0.0, -0.5]), "tau": np.float32(0.7)})
    assert name == "pitch(tau=0.7, W=(0.1, 0.0, -0.5))"
    plant, params = make(name)
    assert plant.name == name
    np.testing.assert_allclose([params.tau, *params.W], [0.7, 0.1, 0.0, -0.5], rtol=1e-6)
    assert make(name)[0] is plant  # so that it is compiled once
    assert float(make(name, tau=0.2)[1].tau) == pytest.approx(0.2)
    assert plants.base(name) == "pitch"
    assert plants.parameters(name) == {"tau": 0.7, "W": (0.1, 0.0, -0.5)}
    assert plants.slug(name) == "pitch-tau-0.7-W-0.1-0.0--0.5"


def test_parameters_add_to_those_of_the_name():
    assert with_parameters("pitch(tau=0.7)", {"d1": 1}) == "pitch(tau=0.7, d1=1)"
    assert with_parameters("pitch(tau=0.7)", {"tau": 0.2}) == "pitch(tau=0.2)"
    assert with_parameters("pitch", {}) == "pitch"


@pytest.mark.parametrize(
    ("name", "settings", "text"),
    [
        ("boat", {"tau": 1.0}, "there is no plant 'boat'"),
        ("pitch", {"tou": 1.0}, "plant 'pitch' has no parameter tou; it has: tau, d1, d2, W, "),
        ("pitch", {"W": [1.0]}, r"W has shape \(1,\); it must be an array of shape \(3,\)"),
        ("pitch", {"tau": float("nan")}, "tau is nan; it must be a finite number"),
        ("pitch", {"max_delay": 0.1}, r"tau is 0.5 s; a delay must lie in"),
        ("pitch(0.7)", {"d1": 1.0}, r"'pitch\(0.7\)' is not a plant's name with parameters"),
        ("pitch(tau=", {"d1": 1.0}, "is not a plant's name with parameters"),
        ("heaters", {"Pi": (1.0, 2.0)}, "Pi"),
    ],
)
def test_what_there_is_not_is_refused(name, settings, text):
    with pytest.raises(ValueError, match=text):
        with_parameters(name, settings)


def test_scenarios_keep_what_makes_them_and_delays_fit():
    plant = with_parameters("pitch", {"tau": 6.5, "d1": 0.3})
    own = scenarios.get(f"{plant}/delay-0.57")
    assert float(own.params.d1[0]) == pytest.approx(0.57)
    assert float(own.params.tau[0]) == pytest.approx(6.5)
    assert own.params.max_delay >= 6.5
    assert own.paper is None
    assert scenarios.get("pitch/delay-0.57").paper is not None
    swept = sweeps.get(f"{plant}/pilot-delay")
    assert swept.axes[0].nominal == 6.5
    assert swept.scenario.params.max_delay >= 6.5
    assert sweeps.get(f"{plant}/controller-delays", coarse=True).axes[0].nominal == 0.3
    key = jax.random.key(0)
    for scenario in (own, swept.scenario):
        params = jax.tree.map(lambda leaf: leaf[-1], scenario.params)
        y = plants.simulate(scenario.plant, params, [5.0] * 20, key)
        assert np.isfinite(y).all()


def test_ids_may_lack_the_plant_or_its_parameters():
    plant = "pitch(tau=0.7)"
    assert scenarios.identifiers(plant, ["paper", "pitch/noise", f"{plant}/paper"]) == [
        f"{plant}/paper",
        f"{plant}/noise",
    ]
    with pytest.raises(ValueError, match=r"the plant is pitch\(tau=0.7\); heaters/cold is another plant's"):
        scenarios.identifiers(plant, ["heaters/cold"])


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ((("tau", "0.7"),), {"tau": 0.7}),
        ((("d1", "5.7", "d2", "0.57"),), {"d1": 5.7, "d2": 0.57}),
        ((("W", "0.1", "-3e-3", "-.01"), ("n", "100")), {"W": (0.1, -3e-3, -0.01), "n": 100}),
        ((("randomise", "True"), ("max_delay", "None")), {"randomise": True, "max_delay": None}),
    ],
)
def test_words_of_the_command_line(words, found):
    assert cli.settings(words) == found


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((("0.7",),), "--set 0.7: 0.7 has no name; write --set NAME VALUE"),
        ((("tau",),), "--set tau: there is no value"),
        ((("tau", "fast"),), "--set tau: there is no value, or it is not a number"),
    ],
)
def test_words_that_are_no_parameters(words, text):
    with pytest.raises(ValueError, match=text):
        cli.settings(words)
