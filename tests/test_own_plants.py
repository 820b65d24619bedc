"""Plants of one's own through the commands: in a file, in recorded data, in Gymnasium."""

import json
import os
import re
import subprocess
import sys
from unittest.mock import patch

import gymnasium
import numpy as np
import pytest

from jaxouter import evaluate, plants, train
from jaxouter.plants import registry
from jaxouter.training.run import RunFolder
from tests import lag
from tests.load import ROOT
from tests.recorded import recorded, write
from tests.training.small import TINY

TANKS = f"{ROOT}/scripts/examples/tanks.py:Tanks"
LONG_PIPE = f"{ROOT}/scripts/examples/long_pipe.py:LongPipe"


@pytest.fixture(autouse=True)
def forgotten():
    """No plant that a test adds stays."""
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        yield


@pytest.mark.slow
def test_a_plant_is_trained_and_evaluated_and_a_run_folder_imports_none(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    train.main([TANKS, "--out", "run", *TINY])
    assert "Tanks/steps" in capsys.readouterr().out
    kept = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (kept["config"]["plant"], kept["plant"]["reference"]) == ("Tanks", TANKS)
    evaluate.main(["run", "--plant", TANKS, "--scenario", "Tanks/steps", "--episodes", "2"])
    del plants.REGISTRY["Tanks"], registry.REGISTRATIONS["Tanks"]
    with pytest.raises(ValueError, match="code is never imported because a run folder names it"):
        RunFolder.open(tmp_path / "run")


@pytest.mark.slow
def test_a_loop_that_is_unstable_alone_is_held(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    train.main([LONG_PIPE, "--out", "run", "--pretraining.gradient-steps", "20", "--pretraining.closed-loop", "16"])
    assert "LongPipe: identified: unstable alone" in capsys.readouterr().out
    results = json.loads((tmp_path / "run" / "summary.json").read_text())["results"]
    maes = {each["policy"]: each["scenarios"]["LongPipe/steps"]["mae"] for each in results}
    assert maes["none"] > 100.0
    assert maes["learned"] < 0.3


WEAK = """
from dataclasses import replace
from tests import kinds

def Weak():
    plant, params = kinds.kind([1.2], [0.01], divergence_bounds=(-12.0, 12.0), setpoint_range=(-1.0, 1.0))()
    return replace(plant, name="Weak", r_tilde_bounds=(-0.01, 0.01)), params
"""


@pytest.mark.slow
def test_a_loop_that_nothing_can_hold_is_refused_with_the_reason_and_leaves_nothing(tmp_path):
    (tmp_path / "weak.py").write_text(WEAK)
    command = [sys.executable, "-m", "jaxouter.train", "weak.py:Weak"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert re.search(r"grows by 1\.2 in a control step, r~ acts after 1 and lies in \(-0\.01, 0\.01\)", done.stderr)
    assert "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.iterdir() if path.name != "__pycache__"] == ["weak.py"]


@pytest.mark.slow
def test_a_log_is_trained_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "lag.csv", recorded(*lag.make(), rows=600, noise=0.03))
    train.main(["log:lag.csv", "--y-unit", "cm", "--out", "run", *TINY])
    assert "MAE in cm" in capsys.readouterr().out
    assert json.loads((tmp_path / "run" / "config.json").read_text())["config"]["plant"] == "lag"
    with pytest.raises(SystemExit):
        train.main(["log:none.csv"])
    assert "there is no file none.csv" in capsys.readouterr().err


class LagEnvironment(gymnasium.Env):
    """A lag; y is the second number that it shows."""

    dt = 0.1
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.y = self.np_random.uniform(-1.0, 1.0)
        return np.array([0.0, self.y], np.float32), {}

    def step(self, action):
        self.y += 0.1 * (0.5 * action.item() - self.y)
        return np.array([0.0, self.y], np.float32), 0.0, False, False, {}


@pytest.mark.slow
def test_a_gymnasium_environment_is_trained_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(
        gymnasium.registry, "Lag-v0", gymnasium.envs.registration.EnvSpec("Lag-v0", entry_point=LagEnvironment)
    )
    asked = ["gym:Lag-v0", "--y-index", "1", "--setpoint-range", "-0.5", "0.5", "--episode-steps", "30"]
    train.main([*asked, "--out", "run", *TINY])
    assert "Lag-v0/steps" in capsys.readouterr().out
    kept = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (kept["plant"]["reference"], kept["config"]["plant_options"]["y_index"]) == ("gym:Lag-v0", 1)
