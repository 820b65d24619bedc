"""The check of a plant as users call it."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from jaxouter import check, plants
from jaxouter.identification.steady_state import DcGain
from jaxouter.plants import registry
from tests import lag, recorded
from tests.load import ROOT
from tests.precision import makes_nan

TANKS = ROOT / "scripts" / "examples" / "tanks.py"


@pytest.fixture(autouse=True)
def forgotten():
    with patch.dict(plants.REGISTRY, lag=lag.make), patch.dict(registry.REGISTRATIONS):
        yield


def test_a_plant_that_implements_the_interface(tmp_path, capsys):
    figure = tmp_path / "steps.png"
    check.main([f"{TANKS}:Tanks", "--figure", str(figure)])
    out = capsys.readouterr().out
    assert out.count("implemented") == 5
    assert "DC gain" in out
    assert figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("unit", "text"), [("1", "0.5, y = 0 at r~ = 0"), ("bar", "0.5, y = 0 bar at r~ = 0")])
def test_a_unit_is_shown_where_there_is_one(unit, text):
    plant, _ = lag.make()
    found = DcGain(np.asarray(0.5), np.asarray(0.0))
    assert dict(check.steady(replace(plant, y_unit=unit), found))["DC gain"] == text


def test_dead_time_and_gain_of_the_lag():
    plant, params = lag.make(K=0.5, d=0.3)
    moves, responses = check.step_responses(plant, params)
    assert check.dead_time(responses) == 3
    np.testing.assert_allclose(responses[:, -1] / moves, 0.5, rtol=1e-3)


@makes_nan
def test_what_is_not_pure_is_found_and_ends_with_status_1(tmp_path, capsys):
    source = TANKS.read_text().replace(
        "return state.lower\n", "return jnp.where(state.lower > 15.0, jnp.nan, state.lower)\n"
    )
    (tmp_path / "own.py").write_text(source)
    with pytest.raises(SystemExit) as end:
        check.main([f"{tmp_path}/own.py:Tanks", "--figure", str(tmp_path / "steps.png")])
    assert end.value.code in (1, 2)
    assert "control steps" in capsys.readouterr().out


def test_models_of_recorded_data_are_validated(tmp_path, capsys):
    path = recorded.write(tmp_path / "tank-3.csv", recorded.recorded(*lag.make(), rows=800, noise=0.03))
    figure = tmp_path / "log.png"
    check.main([f"log:{path}", "--figure", str(figure)])
    out = capsys.readouterr().out
    assert "tank-3: model validation" in out
    assert "held out, free run" in out
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_mistakes_are_said(capsys):
    with pytest.raises(SystemExit) as end:
        check.main(["nothing"])
    assert end.value.code == 2
    assert "there is no plant 'nothing'" in capsys.readouterr().err


def test_no_figure_is_written_unasked(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(check, "response_report", lambda plant, params: lambda figure: figure)
    check.main(["lag"])
    assert list(tmp_path.iterdir()) == []
    assert "figure" not in capsys.readouterr().out
    check.main(["lag", "--figure", "own.png"])
    assert "figure: own.png" in capsys.readouterr().out
