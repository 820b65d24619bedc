"""History, lags and recorded episodes, chosen by what a record tells of the plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jaxouter import plants
from jaxouter.identification import unstable
from jaxouter.identification.dynamics import EXPLORED, Dynamics
from jaxouter.plants import arx
from jaxouter.plants.arx import Model
from jaxouter.training.choice import choose, fitted
from jaxouter.training.config import from_dict, preset, to_dict
from tests import kinds

LATE = Dynamics(2, 40, 60.0, "stable", shown=True)
PLANT, _ = kinds.late(40, episode_steps=200)()
DEFAULT = preset("pitch")
CONFIG = replace(DEFAULT, plant="kind")


def test_history_is_chosen_by_the_dead_time_and_told_and_stored() -> None:
    choice = fitted(CONFIG, PLANT, [LATE], 1_600)
    assert (choice.config.history, choice.config.pretraining, choice.warnings) == (43, CONFIG.pretraining, ())
    assert choice.config.explored_steps == 1_600
    assert choice.said == (
        "identified: dead time 40 control steps, order 2, settling time 60 control steps; chosen: history 43"
    )
    assert from_dict(to_dict(choice.config)) == choice.config


def test_a_short_dead_time_takes_no_longer_history_than_before() -> None:
    assert fitted(CONFIG, PLANT, [LATE._replace(dead=3)], 0).config.history == 15


def test_of_drawn_plants_the_latest_counts() -> None:
    found = [LATE._replace(dead=dead) for dead in (3, 50, 20)]
    assert fitted(CONFIG, PLANT, found, 0).config.history == 53


@pytest.mark.parametrize("declared", [True, False])
def test_what_is_given_wins_with_a_warning_and_a_model_that_still_fits(declared: bool) -> None:
    plant = replace(PLANT, history=10) if declared else PLANT
    config = CONFIG if declared else replace(CONFIG, history=10)
    choice = fitted(config, plant, [LATE], 0)
    assert choice.config.history == config.history
    assert choice.config.pretraining.lags == 43
    (warning,) = choice.warnings
    whose = "what kind declares" if declared else "--history"
    assert "dead time of 40 control steps does not fit in the 10 past samples" in warning
    assert whose in warning
    assert warning.endswith("set --history 43")


def test_lags_that_are_given_stay_with_a_warning() -> None:
    config = replace(CONFIG, pretraining=replace(CONFIG.pretraining, lags=20))
    choice = fitted(config, PLANT, [LATE], 0)
    assert choice.config.pretraining.lags == 20
    assert "--pretraining.lags 20; set 43" in choice.warnings[0]


def test_episodes_are_recorded_longer_where_a_model_needs_it() -> None:
    plant = replace(PLANT, episode_steps=80)
    choice = fitted(CONFIG, plant, [LATE], 0)
    assert (choice.config.history, choice.config.pretraining.episode_steps) == (43, 86)
    assert "recorded episodes of 86 control steps" in str(choice.said)
    elsewhere = fitted(CONFIG, replace(plant, differentiable=False, episode_steps=60), [LATE], 0)  # may end by itself
    assert (elsewhere.config.pretraining.lags, elsewhere.config.pretraining.episode_steps) == (30, None)
    assert "does not fit in a model of half a recorded episode, 30 control steps" in elsewhere.warnings[0]
    assert "longer than half an episode of 60" in elsewhere.warnings[1]


def test_an_episode_in_which_y_does_not_settle_is_said_to_be_short() -> None:
    (warning,) = fitted(CONFIG, PLANT, [LATE._replace(settling=900.0)], 0).warnings
    assert "about 900 control steps to settle, longer than an episode of 200" in warning
    assert fitted(CONFIG, PLANT, [LATE._replace(settling=np.inf, kind="integrating")], 0).warnings == ()


def test_a_plant_of_ones_own_is_explored_once_and_that_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "kind", kinds.late(20))
    config = choose(CONFIG).config
    assert config.history == 22
    assert config.explored_steps == EXPLORED * kinds.EPISODE
    recorded = config.pretraining.episodes * kinds.EPISODE
    assert config.identification_steps == (EXPLORED + 8) * kinds.EPISODE + recorded


def test_built_in_plants_stay_as_they_are() -> None:
    assert choose(DEFAULT) == (DEFAULT, None, ())


def test_a_plant_that_diverges_is_held_first_and_what_is_given_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "kind", kinds.kind([1.08], [0.04]))
    given = replace(preset("kind"), correction=0.7)
    choice = choose(given)
    config = choice.config
    assert (config.history, config.pretraining.episode_steps) == (15, 2 * kinds.EPISODE)
    assert (config.correction, config.pairs.rounds, config.pretraining.closed_loop) == (0.7, 0, 128)
    assert config.explored_steps == (EXPLORED + unstable.EPISODES) * kinds.EPISODE
    assert config.identification_steps == config.explored_steps + (8 + 2 * (64 + 128)) * kinds.EPISODE
    assert "identified: unstable alone; chosen: history 15" in (choice.said or "")
    assert choose(replace(given, base="static")).warnings[0].endswith("train with --base lq, which holds it")


def test_what_nothing_moves_is_refused_before_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "kind", kinds.late(kinds.EPISODE))  # it answers after the episode's end
    with pytest.raises(
        ValueError,
        match=r"for 100 control steps \(the dead time\), and an episode has 100; make episodes several times",
    ):
        choose(CONFIG)


def test_dead_time_of_a_log_is_that_of_its_models(monkeypatch: pytest.MonkeyPatch) -> None:
    model = Model(np.array([0.9]), np.array([0.0] * 12 + [0.1]), np.zeros(()), np.zeros(()))
    names = ("name", "y_unit", "time_unit", "control_step", "episode_steps", "r_tilde_bounds", "setpoint_range")
    declared = {name: getattr(PLANT, name) for name in names}
    monkeypatch.setitem(plants.REGISTRY, "kind", lambda: arx.make(model, [model, model], history=5, **declared))
    choice = choose(CONFIG)
    assert "dead time of 12 control steps does not fit in the 5 past samples" in choice.warnings[0]
    assert choice.config.explored_steps == 0
