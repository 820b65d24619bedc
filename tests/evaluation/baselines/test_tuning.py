"""Training episodes and searches that the baselines are tuned with."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.evaluation.baselines.tuning import coordinate_search, learners_episodes, score, training_episodes
from jaxouter.evaluation.metrics import trained_return
from jaxouter.evaluation.rollout import rollout
from jaxouter.loop.policy import Linear, affine, none
from jaxouter.training.config import preset
from tests import lag
from tests.precision import makes_nan

KEY = jax.random.key(0)
PLANT = replace(lag.RANDOMISED, setpoint_range=(-1.0, 3.0))
EPISODES, STEPS, SPAN = 300, 50, 4.0


@pytest.fixture(scope="module")
def episodes():
    return training_episodes(PLANT, lag.make()[1], KEY, EPISODES)


def test_set_points_fill_the_range_of_the_plant(episodes):
    assert episodes.r.shape == (EPISODES, STEPS)
    assert -1.0 <= episodes.r.min() < -0.95
    assert 2.95 < episodes.r.max() <= 3.0
    assert abs(np.mean(episodes.r[:, 0]) - 1.0) < 5 * SPAN / np.sqrt(12 * EPISODES)


def test_a_fifth_is_constant_a_fifth_redrawn_and_the_rest_moves_at_each_step(episodes):
    """What is redrawn changes seldom and far, the rest at each step; some of the former are never redrawn."""
    r = np.asarray(episodes.r)
    changes = np.count_nonzero(np.diff(r), axis=1)
    moving, constant = changes > 45, changes == 0
    redrawn = ~moving & ~constant
    assert 0.5 < np.mean(moving) < 0.7
    assert 0.15 < np.mean(constant) < 0.4
    assert 0.08 < np.mean(redrawn) < 0.28
    assert changes[redrawn].max() < 40
    jumps = np.abs(np.diff(r[redrawn]))
    assert jumps[jumps > 0].mean() == pytest.approx(SPAN / 3, rel=0.15)  # of two levels drawn alike


def test_what_moves_at_each_step_does_so_from_a_quarter_percent_of_the_range_on(episodes):
    r = np.asarray(episodes.r)
    moves = np.diff(r[np.count_nonzero(np.diff(r), axis=1) > 45]) / SPAN
    deviation = np.sqrt(np.mean(moves**2, axis=1))
    assert 0.0025 * 0.5 < deviation.min() < 0.006


def test_episodes_differ_and_another_key_gives_others(episodes):
    assert len(np.unique(episodes.r, axis=0)) == EPISODES
    np.testing.assert_array_equal(training_episodes(PLANT, lag.make()[1], KEY, EPISODES).r, episodes.r)
    other = training_episodes(PLANT, lag.make()[1], jax.random.key(1), EPISODES)
    assert not np.any(np.asarray(other.r == episodes.r).all(1))


def test_start_and_parameters_are_those_of_training(episodes):
    y0 = rollout(*none(PLANT), episodes).y0
    assert -0.5 <= y0.min() < -0.45
    assert 0.45 < y0.max() <= 0.5
    assert 0.45 <= episodes.params.K.min() < 0.46
    assert 0.54 < episodes.params.K.max() <= 0.55
    assert float(episodes.sensor.noise) == 0.0


@makes_nan
def test_score_is_the_mean_return_that_the_learner_is_trained_on_and_minus_infinity_where_it_diverges(episodes):
    policy, params = none(PLANT)
    traces = rollout(policy, params, episodes)
    assert score(policy, params, episodes) == trained_return(traces, PLANT, preset("lag").reward)
    assert score(policy, params, episodes) > traces.reward.sum(1).mean()  # errors are rounded at zero
    one = replace(episodes, params=episodes.params.replace(K=episodes.params.K.at[7].set(jnp.nan)))
    assert score(policy, params, one) == -np.inf
    assert score(Linear(PLANT.r_tilde_bounds), affine(jnp.nan, 0.0), episodes) == -np.inf


def test_baselines_are_tuned_under_the_noise_and_the_loads_of_the_learner():
    found = learners_episodes(PLANT, lag.make()[1], KEY)
    start, noise, load = preset("lag").disturbances, np.asarray(found.sensor.noise), np.asarray(found.load)
    assert 0.0 < noise.max() <= start.noise * SPAN / 2
    assert 0.2 < np.mean(noise == 0.0) < 0.8
    assert load.shape == found.r.shape
    assert 0.0 < np.abs(load).max() <= start.load * np.ptp(PLANT.r_tilde_bounds) / 2
    assert 0.2 < np.mean(np.all(load == 0.0, axis=1)) < 0.8
    policy, params = none(PLANT)
    alike = rollout(policy, params, replace(found, load=None))
    assert not np.array_equal(rollout(policy, params, found).y, alike.y)
    np.testing.assert_array_equal(rollout(policy, params, found).r_tilde, alike.r_tilde)


GRID = {"a": (1, 2, 4, 8, 16), "b": (0.1, 0.3, 1.0, 3.0), "c": ("low", "high")}


class Concave:
    """A concave function of the positions on the grid, its optimum at a = 8, b = 0.3, c = high; it counts."""

    def __init__(self):
        self.asked = []

    def __call__(self, settings):
        self.asked.append(tuple(settings.values()))
        x, y, z = (GRID[name].index(settings[name]) for name in "abc")
        return -((x - 3) ** 2) - (y - 1) ** 2 - 0.5 * (x - 3) * (y - 1) + z


@pytest.mark.parametrize("start", [{"a": 1, "b": 3.0, "c": "low"}, {"a": 8, "b": 0.3, "c": "high"}])
def test_coordinate_search_finds_the_maximum_and_asks_nothing_twice(start):
    value, reports = Concave(), []
    found, count = coordinate_search(value, GRID, start, 100, lambda text, share: reports.append(share))
    assert found == {"a": 8, "b": 0.3, "c": "high"}
    assert count == len(value.asked) == len(set(value.asked)) == len(reports) < 30
    assert value.asked[0] == tuple(start.values())
    assert reports == [(i + 1) / 100 for i in range(count)]


@pytest.mark.parametrize("most", [0, 1, 4])
def test_coordinate_search_keeps_to_the_most_and_returns_the_best_tried(most):
    value, start = Concave(), {"a": 1, "b": 3.0, "c": "low"}
    found, count = coordinate_search(value, GRID, start, most)
    assert count == len(value.asked) == most
    best = max(value.asked, key=lambda asked: Concave()(dict(zip(GRID, asked, strict=True))), default=(1, 3.0, "low"))
    assert tuple(found.values()) == best


def test_coordinate_search_never_takes_what_diverges():
    def value(settings):
        return -np.inf if settings["a"] > 4 else float(settings["a"])

    assert coordinate_search(value, GRID, {"a": 1, "b": 1.0, "c": "low"}, 100)[0] == {"a": 4, "b": 1.0, "c": "low"}
