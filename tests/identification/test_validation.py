"""Validation of models of recorded data whose plant is known."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from jaxouter.evaluation import figures
from jaxouter.identification import validation
from jaxouter.identification.recorded_data import RecordedData, ensemble
from jaxouter.identification.validation import Validation
from jaxouter.plants import simulate
from tests import lag
from tests.recorded import recorded


def told(data: RecordedData) -> Validation:
    return validation.validate(data, ensemble(data))


@pytest.fixture(scope="module")
def good() -> Validation:
    return told(recorded(*lag.make(), rows=1_200, noise=0.05))


def test_a_good_record_is_told_to_be_one(good: Validation) -> None:
    assert good.warnings == ()
    assert good.gain_range[0] - 0.005 < 0.5 < good.gain_range[1] + 0.005
    assert good.rise_time == pytest.approx(0.3 * np.log(9.0), abs=0.15)
    assert good.settling_time == pytest.approx(0.25 + 3 * 0.3, abs=0.2)
    assert good.length == pytest.approx(120.0 / good.settling_time)
    assert good.error_free_run == pytest.approx(0.05, rel=0.2)
    assert good.fit_free_run > 0.99
    assert good.coverage > 0.8
    assert good.levels_seen > 0.9
    assert good.excited_share == 1.0


def test_a_clean_log_leaves_no_error() -> None:
    it = told(recorded(*lag.make(), rows=600))
    assert it.error_one_step < 1e-5
    assert it.error_free_run < 1e-5
    assert (it.order, it.dead_time) == (2, pytest.approx(0.2))
    assert it.warnings == ()


def test_one_step_errors_are_those_of_the_equation_by_hand() -> None:
    """In an ARX model with white e, which is what is left one step ahead; in free run it adds up."""
    rng, n = np.random.default_rng(0), 2_000
    r_tilde, y = np.repeat(rng.uniform(-1.0, 1.0, n // 10), 10), np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = 0.9 * y[k] + 0.1 * r_tilde[k] + 0.02 * rng.standard_normal()
    it = told(RecordedData(np.arange(n) / 10, r_tilde, y))
    assert it.error_one_step == pytest.approx(0.02, rel=0.1)
    assert it.error_free_run == pytest.approx(0.02 / np.sqrt(1 - 0.81), rel=0.3)


def test_what_a_poor_log_lacks_is_named() -> None:
    """Six moves between two levels, all of them early."""
    r_tilde = np.where((np.arange(300) // 40 % 2 == 0) | (np.arange(300) > 200), -1.0, 3.0)
    y = np.asarray(simulate(*lag.make(), r_tilde, jax.random.key(0))) + np.random.default_rng(0).normal(0, 0.3, 300)
    it = told(RecordedData(0.1 * np.arange(300), np.append(r_tilde[1:], -1.0), y))  # y_k before r~_k acts
    text = "\n".join(it.warnings)
    for words in ("r~ moves only 6 times", "0 times in the last quarter", "r~ was never at", "frequencies"):
        assert words in text
    assert it.levels_seen == pytest.approx(0.1)
    ((low, high),) = it.levels_unseen
    assert (low, high) == (pytest.approx(-0.8), pytest.approx(2.8))


def test_a_plant_that_is_not_linear_is_noticed() -> None:
    data = recorded(*lag.make(), rows=2_000, redraw=0.05)
    bent = told(data._replace(y=data.y + 0.15 * data.y**2))
    assert bent.nonlinearity > 0.05
    assert any("not linear" in text for text in bent.warnings)


def test_a_load_in_the_last_quarter_is_noticed() -> None:
    data = recorded(*lag.make(), rows=1_200, noise=0.02)
    it = told(data._replace(y=data.y + np.where(np.arange(1_200) > 880, 0.8, 0.0)))
    assert abs(it.bias) > 0.3
    assert it.coverage < 0.75
    assert any("a load or a drift" in text for text in it.warnings)
    assert any("more than the ensemble does" in text for text in it.warnings)


def test_noise_without_an_answer_is_noticed() -> None:
    data = recorded(*lag.make(), rows=1_200, noise=3.0)
    it = told(data)
    assert it.fit_free_run < 0.3
    text = "\n".join(it.warnings)
    assert "a controller based on it is a guess" in text


def test_the_table_has_units_and_the_figure_is_drawn(good: Validation, tmp_path: Path) -> None:
    rows = dict(validation.table(good, "degC"))
    assert rows["rows"].startswith("1200 of 0.1 s, ")
    assert " degC, 99." in rows["held out, free run"]
    path = figures.save(figures.validation_figure(good, "log:lag.csv", "degC"), tmp_path / "log.png")
    assert path.stat().st_size > 20_000
