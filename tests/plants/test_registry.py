"""Plants of one's own, by reference."""

from unittest.mock import patch

import jax
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.plants import host, interface, registry, simulate
from jaxouter.plants.simulators import PlantOptions
from tests.load import ROOT

TANKS = f"{ROOT}/scripts/examples/tanks.py:Tanks"


@pytest.fixture(autouse=True)
def forgotten():
    """No plant that a test adds stays."""
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        yield


def test_a_plant_in_a_file_is_made_by_its_short_name():
    assert registry.add(TANKS) == "Tanks"
    assert registry.add(TANKS) == "Tanks"
    plant, params = plants.make("Tanks", load=5.0)
    assert (plant, float(params.load)) == (plants.make("Tanks")[0], 5.0)
    assert plant.evaluation_range == plant.setpoint_range
    assert [what for what, wrong in interface.behaviour(*plants.make("Tanks")) if wrong] == []


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
        registry.add(f"{path}:Own")
    assert text in str(error.value)


def test_an_installed_package_offers_a_plant(tmp_path, monkeypatch):
    site = tmp_path / "site-packages"
    (site / "basin-1.0.dist-info").mkdir(parents=True)
    (site / "basin-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: basin\nVersion: 1.0\n")
    (site / "basin-1.0.dist-info" / "entry_points.txt").write_text("[jaxouter.plants]\nBasin = basin:Tanks\n")
    (site / "basin.py").write_text((ROOT / "scripts" / "examples" / "tanks.py").read_text())
    monkeypatch.syspath_prepend(site)
    assert registry.add("Basin") == "Basin"
    assert plants.make("Basin")[0].name == "Basin"
    with pytest.raises(ValueError, match=r"the plants are: pitch, heaters, Basin, and FILE\.py:NAME"):
        registry.add("basin")


def test_a_function_that_breaks_the_interface_is_named(tmp_path):
    source = (ROOT / "scripts" / "examples" / "tanks.py").read_text()
    for broken, text in (
        ("return state.lower\n", "output(params, state) gave"),
        ("length=SUBSTEPS)[0]", "step(params, state, r_tilde, key) returned"),
    ):
        path = tmp_path / f"{len(text)}.py"
        whole = "return jnp.stack([state.lower])\n" if "lower" in broken else "length=SUBSTEPS)"
        path.write_text(source.replace(broken, whole))
        with pytest.raises(ValueError) as error:
            registry.add(f"{path}:Tanks")
        assert text in str(error.value)


def test_unknown_plants_and_taken_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"there is no plant 'nothing'; the plants are: pitch, heaters"):
        registry.add("nothing")
    with pytest.raises(ValueError, match="declares itself"):
        registry.add("pitch", PlantOptions(y_index=1))
    registry.add(TANKS)
    other = tmp_path / "other.py"
    other.write_text((ROOT / "scripts" / "examples" / "tanks.py").read_text())
    with pytest.raises(ValueError, match="short name 'Tanks', which is that of"):
        registry.add(f"{other}:Tanks")


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
    assert [what for what, wrong in interface.behaviour(plant, params) if wrong] == []
    state = plant.init(jax.random.key(0), params)
    ys = [np.asarray(simulate(plant, params, np.ones(20), jax.random.key(1), state)) for _ in range(2)]
    np.testing.assert_array_equal(*ys)
    start = float(state.y)
    np.testing.assert_allclose(ys[0], 0.5 + (start - 0.5) * 0.9 ** np.arange(1, 21), atol=1e-5)


def test_a_gymnasium_environment_is_a_plant():
    name = registry.add(
        "gym:jaxouter.runtime.gymnasium:jaxouter/Pitch-v0", PlantOptions(y_index=1, setpoint_range=(-0.2, 0.2))
    )
    plant, params = plants.make(name)
    assert (name, plant.episode_steps, plant.r_tilde_bounds) == ("Pitch-v0", 200, (-1.0, 1.0))
    assert [what for what, wrong in interface.behaviour(plant, params) if wrong] == []
    with pytest.raises(ValueError, match=r"--y-index is 99; gym:jaxouter/Heaters-v0 observes numbers 0 to"):
        registry.add("gym:jaxouter/Heaters-v0", PlantOptions(y_index=99))
    with pytest.raises(ValueError, match="gym:No-v9"):
        registry.add("gym:No-v9")
