"""FMUs as plants, FMI 2 and 3, from the file to a trained outer loop."""

import re
import shutil
import subprocess
import zipfile
from pathlib import Path
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fmpy import platform, platform_tuple, sharedLibraryExtension
from fmpy.validation import validate_fmu

from jaxouter import check, export, plants, train
from jaxouter.exports import c
from jaxouter.plants import interface, registry, simulate
from jaxouter.plants.errors import PlantError
from jaxouter.plants.simulators import PlantOptions
from jaxouter.training.run import RunFolder
from tests.training.small import TINY, small

FEW = ["--episode-steps", "30"]
K, T, D = 0.5, 0.3, 0.25  # of lag_fmi3.c


@pytest.fixture(autouse=True)
def forgotten():
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        yield


@pytest.fixture(scope="module")
def controller(tmp_path_factory):
    """FMI 2: what our own exporter makes, from r to r~."""
    if not any(map(shutil.which, c.COMPILERS)):
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("exported")
    run = RunFolder.create(small("pitch", base="static"), folder / "run")
    trainer, params = run.trainer
    run.save(0, 1, trainer.start(0, params))
    export.main([str(run.path), "--format", "fmu", "--out", str(folder / "outer.fmu")])
    return folder / "outer.fmu"


def compiled(folder, name, system, *defined, changes=()):
    """An FMU of a C file beside this one, with the changes to its description."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    folder.mkdir(exist_ok=True)
    here, library = Path(__file__).parent, folder / f"lag{sharedLibraryExtension}"
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", *(f"-D{each}" for each in defined)]
    subprocess.run(["gcc", *flags, str(here / f"{name}.c"), "-o", str(library), "-lm"], check=True, timeout=60)
    description = (here / f"{name}.xml").read_text()
    for old, new in changes:
        assert old in description
        description = description.replace(old, new)
    with zipfile.ZipFile(folder / "lag.fmu", "w") as file:
        file.writestr("modelDescription.xml", description)
        file.write(library, f"binaries/{system}/{library.name}")
    return folder / "lag.fmu"


@pytest.fixture(scope="module")
def lag(tmp_path_factory):
    """FMI 3: a first-order lag with a dead time."""
    found = compiled(tmp_path_factory.mktemp("compiled"), "lag_fmi3", platform_tuple)
    assert validate_fmu(str(found)) == []
    return found


def trained(arguments, name, capsys):
    """The run that `train` makes of a plant, and what it says."""
    train.main([*arguments, "--out", "run", *TINY])
    out = capsys.readouterr().out
    assert f"{name}/steps" in out
    assert "diverged" not in out
    return RunFolder.open(Path("run")).config


@pytest.mark.slow
def test_an_exported_controller_is_a_plant(controller, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = ["--input", "r", "--output", "r_tilde", "--r-tilde-bounds", "-10", "10", *FEW]
    check.main([f"fmu:{controller}", *options])
    out = capsys.readouterr().out
    assert out.count("implemented") == 5
    assert "-5 to 5 crad" in out
    config = trained([f"fmu:{controller}", *options], "outer", capsys)
    assert (config.plant, config.plant_options.input, config.plant_options.r_tilde_bounds) == ("outer", "r", (-10, 10))
    export.main(["run", "--plant", f"fmu:{controller}", "--format", "npz", "--force"])  # static is better
    assert "r~ in [-10, 10] crad" in capsys.readouterr().out


def test_what_an_fmu_leaves_open_must_be_said(controller):
    with pytest.raises(ValueError, match=r"--input is None; .*outer.fmu has: r, y"):
        registry.add(f"fmu:{controller}")
    with pytest.raises(ValueError, match=r"the bounds of r~ are nan and nan; give finite ones"):
        registry.add(f"fmu:{controller}", PlantOptions(input="r"))


def test_an_fmu_for_another_system_is_refused(lag, tmp_path):
    with zipfile.ZipFile(lag) as whole, zipfile.ZipFile(tmp_path / "lag.fmu", "w") as file:
        file.writestr("modelDescription.xml", whole.read("modelDescription.xml"))
    with pytest.raises(ValueError, match=r"lag.fmu can't be started here: Cannot find shared library"):
        registry.add(f"fmu:{tmp_path}/lag.fmu")


def response(r_tilde, times):
    """Y of the lag from rest, of moves of r~ at the control steps."""
    since = times[:, None] - 0.1 * np.arange(len(r_tilde)) - D
    return K * (1.0 - np.exp(-np.maximum(since, 0.0) / T)) @ np.diff(r_tilde, prepend=0.0)


def test_an_fmu_of_fmi_3_says_what_it_is_and_answers_as_its_equation_does(lag):
    plant, params = plants.make(registry.add(f"fmu:{lag}"))
    assert (plant.r_tilde_bounds, plant.control_step, plant.y_unit) == ((-4.0, 4.0), 0.1, "cm")
    assert [what for what, wrong in interface.behaviour(plant, params) if wrong] == []
    rng = np.random.default_rng(0)
    for r_tilde in (np.ones(50), rng.uniform(-4.0, 4.0, 50), rng.uniform(-4.0, 4.0, 50)):
        y = simulate(plant, params, r_tilde.astype(np.float32), jax.random.key(0))
        np.testing.assert_allclose(y, response(r_tilde, 0.1 * np.arange(1, 51)), atol=1e-6)


@pytest.mark.slow
def test_an_fmu_of_fmi_3_is_trained_on_and_checked(lag, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    check.main([f"fmu:{lag}", *FEW])
    out = capsys.readouterr().out
    assert out.count("implemented") == 5
    assert "2 control steps of 0.1 s" in out
    assert trained([f"fmu:{lag}", *FEW], "lag", capsys).plant == "lag"


def faulty(folder, *defined, changes=()):
    """Y' = r~ - y, FMI 2, steps of 0.1 s, stop time 10 s, with faults; see lag_fmi2.c."""
    return compiled(folder, "lag_fmi2", platform, *defined, changes=changes)


SHARE = np.exp(-0.1)  # of a difference that a control step leaves
ONCE = [("<CoSimulation", '<CoSimulation canBeInstantiatedOnlyOncePerProcess="true"')]


@pytest.mark.parametrize(
    ("defined", "changes", "warning"),
    [
        ("RESET=1", [], r"can't be reset .*fmi2Reset failed with status 3 .error. - the FMU: no licence to reset"),
        ("RESET=2", [], r"can't be reset .y begins with .* before.; each episode has an instance of its own"),
        ("ONCE=1", [], "can be instantiated once per process; each episode has a process of its own"),
        ("ONCE=2 RESET=1", ONCE, "once per process"),
    ],
)
def test_what_can_be_made_once_or_not_be_reset_answers_all_the_same(tmp_path, defined, changes, warning):
    """From its start again, from an older moment, side by side, and in one episode after another."""
    path = faulty(tmp_path, *defined.split(), changes=changes)
    with pytest.warns(UserWarning, match=warning):
        plant, params = plants.make(registry.add(f"fmu:{path}"))
    for seed in range(3):  # episodes follow each other
        begun = plant.init(jax.random.key(seed), params)
        after = [plant.step(params, begun, jnp.asarray(r_tilde), None) for r_tilde in (1.0, -2.0, 1.0)]
        after = [plant.step(params, state, jnp.asarray(1.0), None).y for state in after]
        wanted = [1.0 - SHARE**2, 1.0 - 3.0 * SHARE + 2.0 * SHARE**2, 1.0 - SHARE**2]
        np.testing.assert_allclose(after, wanted, rtol=1e-5)


@pytest.mark.parametrize(
    ("defined", "changes", "options", "text"),
    [
        ("STEP=0.05", [], {}, "failed in control step 1, of 0.1 s, with r~ = 2: fmi2DoStep failed with status 2"),
        ("STEP=0.1", [], {"control_step": 0.2}, "- the FMU: the step is another; its own step size is 0.1 s"),
        (
            "STOP=10",
            [],
            {"episode_steps": 150},
            "--episode-steps is 150; the FMU's stop time is 10 s, after 100 control",
        ),
        (
            "END=12",
            [],
            {"episode_steps": 150},
            "goes no further than 120: the FMU ended the simulation in control step",
        ),
        ("CRASH=0", ONCE, {}, "the process of the FMU ended with status -6"),
    ],
)
def test_what_an_fmu_refuses_is_said_before_anything_is_learned(tmp_path, defined, changes, options, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        registry.add(f"fmu:{faulty(tmp_path, *defined.split(), changes=changes)}", PlantOptions(**options))


def test_a_description_that_breaks_the_standard_is_told_whole_or_taken_as_it_is(tmp_path):
    path = faulty(tmp_path, changes=[('<Real start="0" min', "<Real min"), ('causality="output"', 'causality="input"')])
    with pytest.raises(ValueError, match="--no-validate") as error:
        registry.add(f"fmu:{path}")
    assert str(error.value).count("\n- ") == 2
    with pytest.raises(ValueError, match="--output is None"):
        registry.add(f"fmu:{path}", PlantOptions(input="r_tilde", validate=False))


def test_a_control_step_is_a_multiple_of_a_fixed_step_size(tmp_path):
    fixed = [
        ('<DefaultExperiment stepSize="0.1"/>', ""),
        ("<CoSimulation", '<CoSimulation fixedInternalStepSize="0.05"'),
    ]
    path = compiled(tmp_path, "lag_fmi3", platform_tuple, changes=fixed)
    with pytest.raises(ValueError, match=r"--control-step is 0.12; .* multiple of the FMU's fixed .* 0.05 s"):
        registry.add(f"fmu:{path}", PlantOptions(control_step=0.12))
    assert plants.make(registry.add(f"fmu:{path}", PlantOptions(control_step=0.15)))[0].control_step == 0.15


def test_an_fmu_that_fails_later_is_named_with_the_step_and_its_message(tmp_path):
    plant, params = plants.make(registry.add(f"fmu:{faulty(tmp_path, 'STOP=10')}"))
    with pytest.raises(PlantError, match=r"control step 101 .*fmi2DoStep failed"), registry.own_errors():
        simulate(plant, params, jnp.ones(120), jax.random.key(0))


def test_an_episode_is_over_by_the_stop_time(tmp_path):
    plant, _ = plants.make(registry.add(f"fmu:{faulty(tmp_path, 'STOP=10')}"))
    assert (plant.episode_steps, plant.family_steps) == (100, 100)
