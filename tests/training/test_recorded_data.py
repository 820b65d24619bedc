"""A controller that has learned from a record alone, on the true plant."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest

from jaxouter import plants
from jaxouter.evaluation.baselines.tuning import score, training_episodes
from jaxouter.identification import recorded_data, steady_state
from jaxouter.loop.policy import none
from jaxouter.training.config import PretrainingConfig
from jaxouter.training.trainer import build
from tests import lag
from tests.recorded import recorded, write
from tests.training.small import small

START = PretrainingConfig(gradient_steps=100, batch_size=16)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "lag.csv", recorded(*lag.make(), rows=800, noise=0.03))


@pytest.mark.slow
def test_a_controller_from_a_log_is_better_on_the_true_plant(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "logged", lambda: recorded_data.make("logged", str(path)))
    config = small("logged", pretraining=START, base="static", steps=0)
    assert config.identification_steps == 0  # of the plant nothing more is asked
    trainer, params = build(config)
    state = trainer.start(0, params)
    plant, of_plant = lag.make()
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)
    episodes = training_episodes(plant, of_plant, jax.random.key(1), 64)
    reached = score(trainer.policy, trainer.policy_params(state), episodes)
    assert reached > 0.7 * score(*none(plant), episodes)  # both negative
    assert reached > score(*steady_state.static(plant, of_plant, jax.random.key(0)), episodes)
