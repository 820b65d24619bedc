"""Plants of one's own, by reference."""

import json
from unittest.mock import patch

import gymnasium
import jax
import numpy as np
import pytest

from jaxouter import evaluate, plants, train
from jaxouter.plants import contract, host, simulate, sources
from jaxouter.plants.simulators import PlantOptions
from jaxouter.training.run import Run
from tests import lag
from tests.load import ROOT
from tests.logs import recorded, write

TANKS = f"{ROOT}/scripts/examples/tanks.py:Tanks"
TINY = ["--pretraining.gradient-steps", "2", "--pretraining.episodes", "2", "--ddpg.hidden", "8", "8"]


@pytest.fixture(autouse=True)
def forgotten():
    """No plant that a test adds stays."""
    with patch.dict(plants.REGISTRY), patch.dict(sources.SOURCES):
        yield


def test_a_plant_in_a_file_is_made_by_its_short_name():
    assert sources.add(TANKS) == "Tanks"
    assert sources.add(TANKS) == "Tanks"
    plant, params = plants.make("Tanks", load=5.0)
    assert (plant, float(params.load)) == (plants.make("Tanks")[0], 5.0)
    assert plant.evaluation_range == plant.setpoint_range
    assert [what for what, wrong in contract.behaviour(*plants.make("Tanks")) if wrong] == []


def test_a_plant_is_trained_and_evaluated_and_a_run_folder_imports_none(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    train.main([TANKS, "--out", "run", *TINY])
    assert "Tanks/steps" in capsys.readouterr().out
    kept = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (kept["config"]["plant"], kept["plant"]["reference"]) == ("Tanks", TANKS)
    evaluate.main(["run", "--plant", TANKS, "--scenario", "Tanks/steps", "--episodes", "2"])
    del plants.REGISTRY["Tanks"], sources.SOURCES["Tanks"]
    with pytest.raises(ValueError, match="code is never imported because a run folder names it"):
        Run.open(tmp_path / "run")


def test_a_log_is_trained_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "lag.csv", recorded(*lag.make(), rows=600, noise=0.03))
    train.main(["log:lag.csv", "--y-unit", "cm", "--out", "run", *TINY])
    assert "MAE in cm" in capsys.readouterr().out
    assert json.loads((tmp_path / "run" / "config.json").read_text())["config"]["plant"] == "lag"
    with pytest.raises(SystemExit):
        train.main(["log:none.csv"])
    assert "there is no file none.csv" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("def Own(): return 1", "must return a jaxouter.plants.Plant and its parameters"),
        ("def Own(): 1 / 0", "can't be made: ZeroDivisionError"),
        ("Own = 3", "it must be a function that returns a plant"),
        ("def other(): pass", "has no 'Own'"),
        ("from jaxouter.plants.pitch import make as Own\nimport no_such_thing", "can't be imported"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, line, text):
    path = tmp_path / "own.py"
    path.write_text(line)
    with pytest.raises(ValueError) as error:
        sources.add(f"{path}:Own")
    assert text in str(error.value)


def test_an_installed_package_offers_a_plant(tmp_path, monkeypatch):
    site = tmp_path / "site-packages"
    (site / "basin-1.0.dist-info").mkdir(parents=True)
    (site / "basin-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: basin\nVersion: 1.0\n")
    (site / "basin-1.0.dist-info" / "entry_points.txt").write_text("[jaxouter.plants]\nBasin = basin:Tanks\n")
    (site / "basin.py").write_text((ROOT / "scripts" / "examples" / "tanks.py").read_text())
    monkeypatch.syspath_prepend(site)
    assert sources.add("Basin") == "Basin"
    assert plants.make("Basin")[0].name == "Basin"
    with pytest.raises(ValueError, match=r"the plants are: pitch, heaters, Basin, and FILE\.py:NAME"):
        sources.add("basin")


def test_a_broken_contract_names_the_function(tmp_path):
    source = (ROOT / "scripts" / "examples" / "tanks.py").read_text()
    for broken, text in (
        ("return state.lower\n", "output(params, state) gave"),
        ("length=SUBSTEPS)[0]", "step(params, state, r_tilde, key) returned"),
    ):
        path = tmp_path / f"{len(text)}.py"
        whole = "return jnp.stack([state.lower])\n" if "lower" in broken else "length=SUBSTEPS)"
        path.write_text(source.replace(broken, whole))
        with pytest.raises(ValueError) as error:
            sources.add(f"{path}:Tanks")
        assert text in str(error.value)


def test_unknown_plants_and_taken_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"there is no plant 'nothing'; the plants are: pitch, heaters"):
        sources.add("nothing")
    with pytest.raises(ValueError, match="declares itself"):
        sources.add("pitch", PlantOptions(y_index=1))
    sources.add(TANKS)
    other = tmp_path / "other.py"
    other.write_text((ROOT / "scripts" / "examples" / "tanks.py").read_text())
    with pytest.raises(ValueError, match="short name 'Tanks', which is that of"):
        sources.add(f"{other}:Tanks")


class Lag:
    """A simulator that remembers."""

    def reset(self, seed):
        self.y = np.random.default_rng(seed).uniform(-1.0, 1.0)
        return self.y

    def step(self, r_tilde):
        self.y += 0.1 * (0.5 * r_tilde - self.y)
        return self.y


def test_a_simulator_is_a_pure_plant():
    """Also from a moment that it has left."""
    declared = dict(y_unit="1", time_unit="s", control_step=0.1, episode_steps=50)
    plant, params = host.plant(Lag, name="lag", r_tilde_bounds=(-2.0, 2.0), setpoint_range=(-0.5, 0.5), **declared)
    assert [what for what, wrong in contract.behaviour(plant, params) if wrong] == []
    state = plant.init(jax.random.key(0), params)
    ys = [np.asarray(simulate(plant, params, np.ones(20), jax.random.key(1), state)) for _ in range(2)]
    np.testing.assert_array_equal(*ys)
    start = float(state.y)
    np.testing.assert_allclose(ys[0], 0.5 + (start - 0.5) * 0.9 ** np.arange(1, 21), atol=1e-5)


def test_a_gymnasium_environment_is_a_plant():
    name = sources.add(
        "gym:jaxouter.deploy.gymnasium:jaxouter/Pitch-v0", PlantOptions(y_index=1, setpoint_range=(-0.2, 0.2))
    )
    plant, params = plants.make(name)
    assert (name, plant.episode_steps, plant.r_tilde_bounds) == ("Pitch-v0", 200, (-1.0, 1.0))
    assert [what for what, wrong in contract.behaviour(plant, params) if wrong] == []
    with pytest.raises(ValueError, match=r"--y-index is 99; gym:jaxouter/Heaters-v0 observes numbers 0 to"):
        sources.add("gym:jaxouter/Heaters-v0", PlantOptions(y_index=99))
    with pytest.raises(ValueError, match="gym:No-v9"):
        sources.add("gym:No-v9")


class LagEnvironment(gymnasium.Env):
    """The lag as Gymnasium knows it; y is the second number that it shows."""

    dt = 0.1
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))

    def __init__(self):
        self.lag = Lag()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([0.0, self.lag.reset(seed)], np.float32), {}

    def step(self, action):
        return np.array([0.0, self.lag.step(action.item())], np.float32), 0.0, False, False, {}


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
