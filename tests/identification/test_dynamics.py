"""What kind of plant a record shows: dead time, order, whether y settles, integrates or runs away."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

from jaxouter.identification import dynamics, linear_models, records, steady_state
from jaxouter.identification.linear_models import ARX
from jaxouter.identification.records import Record
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.loop.observation import HISTORY, Observer
from jaxouter.plants import make
from tests import kinds

KEY = jax.random.key(0)


def recorded(a: list[float], b: list[float], dead: int, steps: int = 100, noise: float = 0.0, seed: int = 0) -> Record:
    """8 episodes of a linear plant under random levels of r~."""
    rng = np.random.default_rng(seed)
    rates = np.geomspace(4.0 / steps, 0.5, 8)[:, None]
    when = np.maximum.accumulate(np.where(rng.random((8, steps)) < rates, np.arange(steps), 0), axis=1)
    r_tilde = np.take_along_axis(rng.uniform(-1.0, 1.0, (8, steps)), when, 1)
    y = np.zeros((8, steps + 1))
    for k in range(steps):
        forced = sum(each * r_tilde[:, k - dead - i] for i, each in enumerate(b) if k >= dead + i)
        y[:, k + 1] = sum(each * y[:, k - i] for i, each in enumerate(a) if k >= i) + forced
    return Record(r_tilde, y + noise * rng.standard_normal(y.shape))


POLE = kinds.POLE
LAG = [0.5 * (1 - POLE)]


@pytest.mark.parametrize(("dead", "steps"), [(0, 100), (3, 100), (14, 100), (40, 200), (70, 100)])
def test_dead_time_and_order_of_a_lag_are_found_exactly(dead: int, steps: int) -> None:
    found = dynamics.of_record(recorded([POLE], LAG, dead, steps))
    assert (found.order, found.dead, found.kind, found.shown) == (1, dead, "stable", True)
    assert found.settling == 18 + dead


def test_dead_time_is_found_beside_noise() -> None:
    found = dynamics.of_record(recorded([POLE], LAG, 20, noise=0.01))
    assert found.dead <= 20 < found.dead + found.order


def test_relative_figures_do_not_depend_on_the_unit_of_y() -> None:
    data = recorded([POLE], LAG, 8, steps=50)
    for unit in (1e-6, 1e5):
        assert dynamics.of_record(Record(unit * data.r_tilde, unit * data.y)) == dynamics.of_record(data)


@pytest.mark.parametrize(
    ("a", "b", "kind"),
    [
        ([1.0], [0.05], "integrating"),
        ([1.7, -0.7], [0.01], "integrating"),  # with a lag
        ([1.05], [0.05], "unstable"),
        ([math.exp(-1 / 500)], [0.01], "stable"),  # slow: it would settle, in 15 episodes
        ([1.6, -0.63], [-0.03, 0.045], "stable"),  # non-minimum-phase
    ],
)
def test_the_kind_is_told_by_the_largest_pole(a: list[float], b: list[float], kind: str) -> None:
    found = dynamics.of_record(recorded(a, b, 2))
    assert (found.kind, found.dead) == (kind, 2)
    assert math.isinf(found.settling) == (kind != "stable")


def test_what_does_not_answer_is_told() -> None:
    data = recorded([POLE], LAG, 0, noise=0.1)
    deaf = data._replace(y=np.random.default_rng(1).standard_normal(data.y.shape))
    assert not dynamics.of_record(deaf).shown


def test_episodes_that_ran_away_count_until_then() -> None:
    data = recorded([1.3], [0.3], 2, steps=100)
    cut = records.within(data, (-2.0, 2.0))
    assert np.isnan(cut.y[:, -1]).all()
    assert np.nanmax(np.abs(cut.y)) <= 18.0
    found = dynamics.of_record(cut)
    assert (found.kind, found.dead) == ("unstable", 2)


def test_a_model_that_overflows_is_of_no_use() -> None:
    data = Record(np.ones((1, 200)), np.ones((1, 201)))
    assert linear_models.prediction_error(ARX(np.array([1e10]), np.array([1.0]), 0.0, 0, 0.0), data, 150) == math.inf


@pytest.mark.parametrize(("order", "dead", "history"), [(1, 0, 15), (2, 40, 43), (16, 5, 20), (32, 40, 48)])
def test_history_reaches_beyond_the_dead_time(order: int, dead: int, history: int) -> None:
    assert dynamics.history_for(order, dead, HISTORY) == history


def levels_and_courses(response: np.ndarray, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """8 constant levels, and y (8, T + 1) of a plant with this response to a unit step (T + 1,), from other starts."""
    rng, levels = np.random.default_rng(0), np.linspace(-4.0, 4.0, 8)
    fades = 1.0 - response / response[-1] if abs(response[-1]) < 10.0 * abs(response[1]) else np.ones(response.shape)
    y = levels[:, None] * response + rng.uniform(-0.5, 0.5, (8, 1)) * fades
    return levels, y + noise * rng.standard_normal(y.shape)


T = np.arange(201.0)


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize(
    ("response", "words"),
    [
        (0.5 * (1 - np.exp(-T / 10)), None),
        (-0.5 * (1 - np.exp(-T / 10)), None),
        (1 - np.exp(-T / 50), None),  # four time constants
        (np.where(T > 120, 1 - np.exp(-np.maximum(T - 120, 0) / 10), 0.0), None),  # a long dead time
        (1 - np.exp(-T / 200), "does not settle"),
        (0.04 * T, "keeps growing"),
        (np.exp(T / 40) - 1, "runs away"),
        (1 - np.cos(T / 10) * np.exp(T / 40), "runs away"),
        (1 + 0.3 * np.cos(T / 15), None),  # it swings about where it stays
    ],
)
def test_a_gain_that_still_changes_is_none(response: np.ndarray, words: str | None, noise: float) -> None:
    found = steady_state.unsettled(*levels_and_courses(response, noise))
    assert found is None if words is None else words in str(found)


@pytest.mark.parametrize("name", ["pitch", "heaters"])
def test_built_in_plants_settle(name: str) -> None:
    plant, params = make(name)
    assert steady_state.dc_gain(plant, params, jax.random.key(3)).unsettled is None


@pytest.mark.parametrize(("plant", "gain"), [(kinds.Negative, -0.8), (kinds.Nonminimum, 0.5), (kinds.Late, 0.5)])
def test_the_gain_of_what_settles_is_found_within_a_percent(plant: kinds.Maker, gain: float) -> None:
    found = steady_state.dc_gain(*plant(), KEY)
    assert found.unsettled is None
    assert float(found.gain) == pytest.approx(gain, rel=0.01)


@pytest.mark.parametrize("plant", [kinds.Slow, kinds.Integrating, kinds.Unstable])
def test_where_y_does_not_settle_the_base_is_r_itself_and_it_says_so(plant: kinds.Maker) -> None:
    with pytest.warns(IdentificationWarning, match=r"kind: y .* within an episode of 100 control steps.* r~ = r"):
        _, found = steady_state.static(*plant(), KEY)
    assert (float(found.r), float(found.offset)) == (1.0, 0.0)


def test_an_integrator_is_known_by_its_rate() -> None:
    found = steady_state.dc_gain(*kinds.Integrating(), KEY)
    assert found.rate == pytest.approx(0.04, rel=1e-3)
    assert found.still == pytest.approx(0.0, abs=1e-3)


def test_only_what_is_declared_by_nobody_is_recorded_for() -> None:
    plant, params = kinds.late(20)()
    assert dynamics.suitable_history(plant, params, KEY) == (22, dynamics.EXPLORED * kinds.EPISODE)
    assert dynamics.suitable_history(*make("heaters"), KEY) == (5, 0)
    assert Observer.of(plant).history == HISTORY
