"""Plants that are hard in one way each, through the commands."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import check, compare, plants, train
from jaxouter.evaluation.baselines import BASELINES
from jaxouter.identification import steady_state
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.plants import registry
from jaxouter.training.config import from_dict
from tests import kinds
from tests.load import ROOT
from tests.training.small import TINY

GAINS = {"Negative": -0.8, "Nonminimum": 0.5, "Late": 0.5}  # of those that settle
REST = {"Slow": "y does not settle", "Integrating": "y keeps growing", "Unstable": "y runs away"}


def reference(name: str) -> str:
    return f"{ROOT}/tests/kinds.py:{name}"


@pytest.fixture(autouse=True)
def forgotten():
    """No plant that a test adds stays."""
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        yield


@pytest.mark.parametrize(
    ("plant", "dead"), [(kinds.Late, 30), (kinds.Unstable, 0), (kinds.Integrating, 0), (kinds.late(70), 70)]
)
def test_dead_time_is_told_whatever_y_grows_to(plant, dead):
    assert check.dead_time(check.step_responses(*plant())[1]) == dead


def test_no_gain_is_shown_where_there_is_none():
    plant, _ = kinds.Integrating()
    found = steady_state.DcGain(jnp.asarray(3.8), jnp.zeros(()), "kind: y keeps growing", 0.04, 0.5)
    (gain, none), (_, change) = check.steady(plant, found)
    assert (gain, none) == ("DC gain", "none, y keeps growing")
    assert change == "by 0.04 a control step for each 1 of r~ beyond 0.5"
    settled = check.steady(plant, found._replace(unsettled=None))
    assert settled[0][1].startswith("3.8, y = 0 at r~ = 0")


def test_static_says_that_it_is_none_also_from_the_cache():
    plant, params = kinds.Integrating()
    tuned = BASELINES["static"].tune(plant, params, kinds.key(0), 0, lambda text: None)
    with pytest.warns(IdentificationWarning, match="the static prefilter is r~ = r"):
        _, found = BASELINES["static"].build(plant, tuned)
    assert (float(found.r), float(found.offset)) == (1.0, 0.0)


@pytest.mark.slow
def test_a_late_plant_is_trained_with_a_history_that_holds_its_dead_time_and_judged(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    train.main([reference("Late"), "--out", "run", *TINY])
    out = capsys.readouterr().out
    assert "Late: identified: dead time 30 control steps, order 1" in out
    assert "chosen: history 32" in out
    config = from_dict(json.loads(Path("run/config.json").read_text())["config"])
    assert (config.history, config.explored_steps) == (32, 8 * kinds.EPISODE)
    judged(Path("run"), out)


def judged(run: Path, out: str) -> None:
    """The verdict is printed as it is written."""
    verdict = json.loads((run / "summary.json").read_text())["verdict"]
    assert " ".join(verdict["text"].split()) in " ".join(out.split())
    values = verdict["mae"]
    learned = values["learned"]["0"]
    others = [values[name] for name in ("none", "static") if values.get(name) is not None]
    if learned is None or not min(others) < learned < 1.1 * min(others):  # else it depends on chance
        assert verdict["worse"] == ([] if learned is not None and learned <= min(others) else [0])


@pytest.mark.slow
@pytest.mark.parametrize("name", [*GAINS, *REST])
def test_every_kind_goes_through_check_train_and_compare(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    check.main([reference(name), "--figure", "steps.png"])
    told = " ".join(capsys.readouterr().out.split())
    if name in GAINS:
        plant, params = getattr(kinds, name)()
        assert float(steady_state.dc_gain(plant, params, kinds.key(0)).gain) == pytest.approx(GAINS[name], rel=0.01)
        assert f"DC gain │ {GAINS[name]:.3g}, y" in told
    else:
        assert f"DC gain │ none, {REST[name]}" in told
    assert f"dead time │ {30 if name == 'Late' else 0} control steps" in told
    brief = [
        "--preset",
        "record",
        "--pretraining.gradient-steps",
        "200",
        "--pretraining.batch-size",
        "32",
        "--agent.hidden",
        "32",
        "32",
    ]
    train.main([reference(name), "--out", "run", *brief])
    captured = capsys.readouterr()
    assert ("the static prefilter is r~ = r" in captured.err) == (name in REST)
    judged(Path("run"), captured.out)
    policies = ["--policy", "none", "static", "pi", "mpc"]
    compare.main([reference(name), "--run", "run", *policies, "--sweep", "--out", "comparison"])
    rows = json.loads(Path("comparison/comparison.json").read_text())["rows"]
    mae = {row["policy"]: np.inf if row["mae"] is None else row["mae"] for row in rows}
    if name != "Unstable":
        assert max(mae["pi"], mae["mpc"]) < mae["none"]
    assert mae["static"] == mae["none"] if name in REST else mae["static"] < mae["none"]
