import chex
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Known
from jaxouter.loop.policy import none
from tests.precision import of_single_draws

REST = " rest rest-noise"
PITCH = "paper delay-0.57 delay-5.7 delay-swapped uncertainty load noise steps staircase ramps sines doublets" + REST
HEATERS = "paper-4 paper-1000 riccati cold mixed-stock load noise steps staircase ramps days" + REST


@pytest.mark.parametrize(("plant", "names"), [("pitch", PITCH), ("heaters", HEATERS)])
def test_catalogue_is_the_specifications(plant, names):
    assert set(scenarios.catalogue(plant)) == {f"{plant}/{name}" for name in names.split()}


@pytest.mark.parametrize(
    ("identifier", "expected"),
    [
        ("pitch/paper", 10.907),
        ("pitch/delay-0.57", 10.909),
        ("pitch/delay-5.7", 27.199),
        ("pitch/delay-swapped", 8.837),
        ("pitch/uncertainty", 136.2),
    ],
)
def test_inner_loop_alone_has_the_specified_mae_on_pitch(identifier, expected):
    scenario = scenarios.get(identifier)
    assert mae(rollout(*none(scenario.plant), scenario)) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("identifier", "episodes", "expected"), [("heaters/paper-4", None, 15.6), ("heaters/paper-1000", 4, 15.07)]
)
@of_single_draws
def test_inner_loop_alone_has_the_specified_mae_on_heaters(identifier, episodes, expected):
    scenario = scenarios.get(identifier, episodes)
    traces = rollout(*none(scenario.plant), scenario)
    assert traces.y.shape == (episodes or 32, 200)
    assert mae(traces) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("identifier", "episodes", "steps"),
    [("pitch/steps", 64, 200), ("pitch/sines", 64, 600), ("heaters/days", 64, 200), ("pitch/noise", 32, 200)],
)
def test_families_have_64_members_and_noisy_scenarios_32_seeds(identifier, episodes, steps):
    chex.assert_shape(scenarios.get(identifier).r, (episodes, steps))


def test_families_are_drawn_from_their_seed():
    first, again, other = (scenarios.get("pitch/staircase", 4, seed).r for seed in (2024, 2024, 7))
    chex.assert_trees_all_equal(first, again)
    assert not np.array_equal(first, other)


def test_houses_start_at_the_given_mean_and_are_not_alike():
    scenario = scenarios.get("heaters/paper-1000", 2)
    traces = rollout(*none(scenario.plant), scenario, record_members=True)
    np.testing.assert_allclose(traces.y0, 17.8, atol=1e-4)
    chex.assert_shape(traces.members, (2, 200, 1000))
    assert np.ptp(traces.members[0, 0]) > 1.5


def test_parameters_change_half_way_under_load():
    calm, load = scenarios.get("pitch/paper"), scenarios.get("pitch/load")
    a, b = (rollout(*none(s.plant), s).y[0] for s in (calm, load))
    np.testing.assert_allclose(a[:100], b[:100], rtol=0.0, atol=1e-6)
    assert abs(a[120] - b[120]) > 0.1


def test_mixed_stock_differs_from_house_to_house_within_30_percent():
    house = scenarios.get("heaters/mixed-stock").params.house
    for values, nominal in ((house.Ca, 10.0), (house.Ua, 0.2)):
        chex.assert_shape(values, (32, 4))
        assert float(jnp.ptp(values / nominal)) > 0.5
        assert float(jnp.max(jnp.abs(values / nominal - 1))) <= 0.3 + 1e-6


def test_sensor_noise_does_not_touch_the_metrics_of_a_policy_that_ignores_y():
    clean, noisy = scenarios.get("pitch/paper"), scenarios.get("pitch/noise", 1)
    assert mae(rollout(*none(clean.plant), clean)) == mae(rollout(*none(noisy.plant), noisy))


def test_plant_without_scenarios_has_its_families(monkeypatch):
    from jaxouter.plants import REGISTRY
    from tests import lag

    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    assert list(scenarios.catalogue("lag")) == [
        f"lag/{name}" for name in ("steps", "staircase", "ramps", *REST.split())
    ]
    scenario = scenarios.get("lag/staircase", 3)
    chex.assert_shape(rollout(*none(scenario.plant), scenario).y, (3, 100))


@pytest.mark.parametrize(
    ("identifier", "known"),
    [
        ("pitch/paper", "pitch"),
        ("pitch/steps", "pitch"),
        ("pitch/delay-0.57", "pitch(d1=0.57, d2=0.57)"),
        ("pitch/delay-5.7", "pitch"),  # which is unstable alone
        ("pitch(tau=0.7)/delay-0.57", "pitch(tau=0.7, d1=0.57, d2=0.57)"),
        ("heaters/paper-1000", "heaters"),  # more houses of the same kind
        ("heaters/load", "heaters"),
        ("heaters/noise", ("heaters", 0.1, True)),  # and the noise of the sensor; that of a thousand houses is small
        ("heaters/rest-noise", ("heaters", 0.06, True)),
        ("pitch/rest-noise", ("pitch", 0.2)),  # 0.204, to one digit
        ("heaters/cold", "heaters(x_out=-15.0)"),
        ("heaters/riccati", "heaters(Pi=17.186)"),
    ],
)
def test_plant_of_a_scenario_for_those_who_know_it(identifier, known):
    assert scenarios.known(identifier) == (Known(known) if isinstance(known, str) else Known(*known))


def test_unknown_scenario_lists_those_that_exist():
    with pytest.raises(ValueError, match="no scenario 'pitch/papers'; pitch has: pitch/paper, "):
        scenarios.get("pitch/papers")


def test_perturbed_starts_are_those_of_the_training_and_the_last_set_point_is_held():
    scenario = scenarios.perturbed("pitch/delay-swapped", 250, 8)
    assert scenario.r.shape == (8, 250)
    np.testing.assert_array_equal(scenario.r, scenarios.get("pitch/delay-swapped").r[0, 0])
    np.testing.assert_allclose(scenario.params.d2, 5.7)
    traces = rollout(*none(scenario.plant), scenario)
    assert np.ptp(traces.y0) > 2.0
    assert np.abs(traces.y0).max() <= 5.0


PITCH_RANGES = (("tau", 0.3, 0.7), ("d1", 0.0, 0.57), ("d2", 0.0, 6.0))
HEATERS_RANGES = (("Pi", 0.3, 2.0), ("x_out", -15.0, 0.0), ("Ca", 7.0, 13.0), ("Ua", 0.14, 0.26))


@pytest.mark.parametrize(
    ("name", "ranges", "noise", "place"),
    [
        ("pitch/paper", (), 0.0, "inside"),
        ("pitch/sines", PITCH_RANGES, 0.0, "edge"),  # d1 = d2 = 0
        ("pitch/delay-0.57", PITCH_RANGES, 0.0, "edge"),
        ("pitch/delay-swapped", (("d1", 0.0, 1.0), ("d2", 0.0, 6.0)), 0.0, "inside"),
        ("pitch/delay-5.7", PITCH_RANGES, 0.0, "outside"),
        ("pitch/uncertainty", PITCH_RANGES, 0.0, "outside"),
        ("pitch/uncertainty", (("W[1]", 0.0, 0.4), ("W[2]", -0.3, 0.3)), 0.0, "edge"),
        ("pitch/uncertainty", (("W[1]", 0.0, 0.4), ("W[2]", -0.2, 0.2)), 0.0, "outside"),
        ("pitch/load", (("disturbance", -3.0, 3.0),), 0.0, "inside"),
        ("pitch/load", (("disturbance", -3.0, 1.0),), 0.0, "outside"),
        ("pitch/noise", (), 0.1, "outside"),
        ("pitch/noise", (), 0.3, "inside"),
        ("heaters/paper-1000", HEATERS_RANGES, 0.0, "inside"),
        ("heaters/riccati", HEATERS_RANGES, 0.0, "outside"),
        ("heaters/cold", HEATERS_RANGES, 0.0, "edge"),
        ("heaters/load", HEATERS_RANGES, 0.0, "edge"),
        ("heaters/mixed-stock", HEATERS_RANGES, 0.0, "inside"),
        ("heaters/mixed-stock", (("Ca", 8.0, 12.0), ("Ua", 0.14, 0.26)), 0.0, "outside"),
    ],
)
def test_place_of_a_scenario_among_the_plants_of_a_training(name, ranges, noise, place):
    assert scenarios.place(scenarios.get(name), name.split("/")[0], ranges, noise) == place


def test_set_points_over_the_range_are_held_long_without_disturbance_and_with_noise_where_named():
    silent, noisy = (scenarios.get(f"heaters/{name}") for name in ("rest", "rest-noise"))
    assert silent.r.shape == (19, 1_200)
    np.testing.assert_allclose(silent.r[:, [0, -1]], np.linspace(15.0, 25.0, 19)[:, None] * np.ones(2), rtol=1e-6)
    assert float(silent.params.house.sigma.max()) == 0.0
    assert float(silent.sensor.noise) == 0.0
    assert float(noisy.sensor.noise) == pytest.approx(0.06)
    assert not {"heaters/rest", "heaters/rest-noise"} & set(scenarios.reported("heaters"))
