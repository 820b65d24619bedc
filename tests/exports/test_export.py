"""The export of a controller as users call it, each format run beside the policy by what others run it with."""

from __future__ import annotations

import ctypes
import dataclasses
import json
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import fmpy
import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import fmi2Error
from fmpy.validation import validate_fmu

from jaxouter import export, plants
from jaxouter.exports import c, files, fmu, verify
from jaxouter.exports.spec import ControllerSpec
from jaxouter.loop import bank
from jaxouter.loop.policy import LinearLaw
from jaxouter.plants import registry
from jaxouter.training.policy import LearnedParams
from jaxouter.training.run import RunFolder
from tests.load import ROOT
from tests.training.small import small

TANKS = f"{ROOT}/scripts/examples/tanks.py:Tanks"
STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"]
MORE = ["-Wshadow", "-Wconversion", "-Wno-sign-conversion", "-Wdouble-promotion", "-Wundef"]


class Trained(NamedTuple):
    """A run whose policy moves r~ over much of its range."""

    run: RunFolder
    policy: Any
    params: Any
    spec: ControllerSpec

    def export(self, kind: str, out: Path) -> Path:
        export.main([str(self.run.path), "--format", kind, "--out", str(out)])
        return out


def trained(plant: str, folder: Path) -> Trained:
    run = RunFolder.create(small(plant), folder / plant)
    trainer, params = run.trainer
    state = trainer.start(0, params)
    actor = jax.tree.map(lambda leaf: 3.0 * leaf, state.agent.actor)
    last = max(actor["params"])
    actor["params"][last] = jax.tree.map(lambda leaf: 30.0 * leaf, actor["params"][last])
    run.save(0, 1, state._replace(agent=state.agent._replace(actor=actor)))
    state, _ = run.load(0)
    learned = trainer.policy_params(state)
    return Trained(run, trainer.policy, learned, ControllerSpec.of(trainer.policy, learned, trainer.env.plant))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {plant: trained(plant, folder) for plant in ("pitch", "heaters")}


@pytest.fixture(scope="module")
def pitch(runs):
    return runs["pitch"]


def compile_and_run(folder: Path, sources: list[Path], *flags: str, compiler: str = "gcc") -> list[float]:
    program = folder / "program"
    command = [compiler, *flags, "-I", str(sources[0].parent), *map(str, sources), "-o", str(program), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    out = subprocess.run([str(program)], capture_output=True, text=True, timeout=60, check=True).stdout
    return [float(line) for line in out.split()]


@pytest.mark.parametrize(
    ("plant", "kind"),
    [("pitch", kind) for kind in files.FORMATS] + [("heaters", kind) for kind in ("npz", "c", "fmu")],
)
def test_what_was_written_does_what_the_policy_does(runs, plant, kind, tmp_path, capsys):
    it = runs[plant]
    path = it.export(kind, tmp_path / f"controller.{kind}")
    seen = verify.signals(it.spec, it.policy, it.params)
    low, high = it.spec.r_tilde_bounds
    assert seen.r_tilde.shape == (1_000,)
    assert np.ptp(seen.r_tilde) > 0.3 * (high - low)
    assert np.mean((seen.r_tilde > low) & (seen.r_tilde < high)) > 0.5
    with verify.opened(kind, path, it.spec) as controller:
        found = verify.deviation(controller, it.spec, seen)
    assert found.at_a_step < 1e-5
    assert found.in_closed_loop < 1e-4
    out = capsys.readouterr().out
    assert f"written: {path} (" in out
    text = f"range of r~: {found.at_a_step:.1e} at a step, {found.in_closed_loop:.1e} in closed loop"
    assert text in out
    written = {path.name} | ({"controller.h"} if kind == "c" else set())
    assert {each.name for each in tmp_path.iterdir()} == written


@pytest.mark.parametrize("lags", [2, 7])  # fewer and more than the observation holds
@pytest.mark.parametrize("kind", files.FORMATS)
def test_a_base_law_with_lags_is_written_too(pitch, kind, lags, tmp_path):
    """A law that integrates, as the LQ law does."""
    numbers = 0.1 * np.random.default_rng(0).normal(size=(2, lags))
    numbers[1] -= numbers[1].mean()
    numbers[1, 0] += 1.0  # r~ stays where nothing moves
    law = LinearLaw(*(jnp.asarray(each, float) for each in (0.0, 0.5, -0.5, *numbers)))
    policy = dataclasses.replace(pitch.policy, observer=dataclasses.replace(pitch.policy.observer, lags=lags))
    params = pitch.params._replace(base=law)
    spec = ControllerSpec.of(policy, params, pitch.run.trainer[0].env.plant)
    assert (spec.lags, spec.remembered) == (lags, max(3, lags))
    path = tmp_path / f"controller.{kind}"
    files._write(kind, path, spec, policy, params)
    assert verify.verify(kind, path, spec, policy, params).small


@pytest.mark.parametrize("kind", files.FORMATS)
def test_a_bank_of_laws_is_written_too(pitch, kind, tmp_path):
    """Random laws and models, of which now one and now another predicts best."""
    rng, lags, laws = np.random.default_rng(16), 7, 3
    numbers = 0.1 * rng.normal(size=(laws, 2, lags))
    each = [LinearLaw(*(jnp.asarray(x, float) for x in (0.5, 0.5, -0.2, *past))) for past in numbers]
    made = bank.of(each, *(0.3 * rng.normal(size=(2, laws, lags))), 17.0)
    observer = dataclasses.replace(pitch.policy.observer, lags=lags, laws=laws)
    policy = dataclasses.replace(pitch.policy, observer=observer)
    actor = policy.init_actor(jax.random.key(1))
    params = LearnedParams(jax.tree.map(lambda leaf: 3.0 * leaf, actor), made)
    spec = ControllerSpec.of(policy, params, pitch.run.trainer[0].env.plant)
    assert (spec.laws, spec.lags, spec.model_lags, spec.remembered) == (laws, lags, lags, lags)
    active = verify.signals(spec, policy, params).state.evidence.active
    assert (active[0], set(active[1:].tolist())) == (-1, {0, 1, 2})
    path = tmp_path / f"controller.{kind}"
    files._write(kind, path, spec, policy, params)
    assert verify.verify(kind, path, spec, policy, params).small


def test_a_controller_of_other_numbers_is_noticed(pitch, tmp_path):
    bias = pitch.spec.biases[-1] + np.float32(3e-5)
    other = dataclasses.replace(pitch.spec, biases=(*pitch.spec.biases[:-1], bias))
    other.save(tmp_path / "controller.npz")
    found = verify.verify("npz", tmp_path / "controller.npz", pitch.spec, pitch.policy, pitch.params)
    assert found.at_a_step > 1e-5
    assert not found.small
    assert not verify.Deviation(float("nan"), 0.0).small


@pytest.mark.parametrize("kind", ["npz", "c"])
def test_what_deviates_is_not_written(pitch, kind, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(verify, "AT_A_STEP", -1.0)
    with pytest.raises(SystemExit, match=r"error: nothing is written: largest deviations from the policy"):
        pitch.export(kind, tmp_path / f"controller.{kind}")
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().out == "writing\nverifying\n"


@pytest.mark.parametrize("kind", ["c", "fmu"])
def test_on_the_plant_it_leads_to_the_same_output(pitch, kind, tmp_path):
    plant, params = plants.make("pitch")
    key = jax.random.key(0)
    step = jax.jit(lambda state, r_tilde: plant.step(params, state, r_tilde, key))
    r = np.repeat(np.float32([16.0, -5.0, 0.0, 9.0]), 50)

    def on_the_plant(controller: Any, act: Any) -> np.ndarray:
        state, out = plant.init(key, params), []
        y = plant.output(params, state)
        memory = controller.init(float(y))
        for r_k in r:
            memory, r_tilde = act(memory, r_k, np.float32(y))
            state = step(state, jnp.asarray(r_tilde, float))
            y = plant.output(params, state)
            out.append((float(r_tilde), float(y)))
        return np.asarray(out)

    class Policy:
        def init(self, y0: float) -> Any:
            return pitch.policy.init(pitch.params, jnp.asarray(r[0], float), jnp.asarray(y0, float))

    act = jax.jit(pitch.policy.act)
    wanted = on_the_plant(Policy(), lambda m, r, y: act(pitch.params, m, jnp.asarray(r, float), jnp.asarray(y, float)))
    with verify.opened(kind, pitch.export(kind, tmp_path / f"controller.{kind}"), pitch.spec) as controller:
        got = on_the_plant(controller, controller.act)
    assert np.ptp(wanted[:, 1]) > 1.0
    np.testing.assert_allclose(got, wanted, atol=1e-4 * 120.0)


def test_command_writes_beside_the_run(pitch):
    arguments = [sys.executable, "-m", "jaxouter.export", str(pitch.run.path / "seed-0"), "--format", "npz"]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (0, "")
    path = pitch.run.path / "seed-0" / "controller.npz"
    begun, lines = done.stdout.splitlines()[:2], done.stdout.splitlines()[2:]
    assert begun == ["writing", "verifying"]
    assert lines[0] == (
        "pitch, seed 0: r~ in [-60, 60] crad from r and y in crad, once every 0.1 s; "
        "state: 3 past y, 3 past r~, integral"
    )
    assert lines[1].startswith(f"written: {path} (")
    assert lines[2].startswith("verified: ")
    np.testing.assert_equal(ControllerSpec.load(path).weights, pitch.spec.weights)
    before = path.read_bytes()
    again = subprocess.run(arguments, capture_output=True, text=True, timeout=100)
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr == f"error: {path} exists; remove it, or choose another file\n"
    assert path.read_bytes() == before
    path.unlink()


@pytest.mark.slow
def test_a_run_on_a_plant_of_ones_own_names_it_again(tmp_path):
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        run = trained(registry.add(TANKS), tmp_path).run
    arguments = [sys.executable, "-m", "jaxouter.export", str(run.path), "--format", "c"]
    unnamed = subprocess.run(arguments, capture_output=True, text=True, timeout=100)
    assert (unnamed.returncode, unnamed.stdout) == (2, "")
    assert "so name the plant on the command line" in unnamed.stderr
    done = subprocess.run([*arguments, "--plant", TANKS], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (0, "")
    _, _, told, *_, found = done.stdout.splitlines()
    assert told.startswith("Tanks, seed 0: r~ in [2, 30] cm from r and y in cm, once every 10 s; ")
    assert found.startswith("verified: ")
    assert "Tanks_outer_loop_step" in (run.path / "controller.h").read_text()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "say what to export: a run folder, or the folder of one seed in it"),
        (["pitch"], "say --format; the formats are: onnx, npz, stablehlo, c, fmu"),
        (["pitch", "--format", "pt"], "there is no format 'pt'; the formats are: onnx, npz, stablehlo, c, fmu"),
        (["nowhere", "--format", "c"], "nowhere is not a run folder"),
        (["pitch/seed-7", "--format", "c"], "pitch/seed-7 is not a seed of its run, which has: 0"),
        (["pitch", "--format", "c", "--plant", "heaters"], "pitch is a run on pitch, not on heaters"),
        (["pitch", "--format", "c", "--plant", "no"], "there is no plant 'no'; the plants are: pitch, heaters"),
        (["empty", "--format", "npz"], "empty/seed-0 has no checkpoint yet"),
        (["pitch", "--format", "c", "--out", "a.cpp"], "--out is a.cpp; for the format c its name must end in .c"),
        (["pitch", "--format", "c", "--out", "there.c"], "there.h exists; remove it, or choose another file"),
        (["pitch", "--format", "npz", "--out", "no/a.npz"], "no/a.npz can't be written: no must be a folder that you"),
    ],
)
def test_bad_input_is_one_message_and_status_2(pitch, arguments, text, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(pitch.run.path, "pitch")
    RunFolder.create(small("pitch"), Path("empty"))
    Path("there.h").touch()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as end:
        export.main(arguments)
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"error: {text}")
    assert len(captured.err.splitlines()) == 1
    assert captured.out == ""
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("kind", "missing", "text"),
    [
        ("onnx", "onnx", 'jaxouter.exports.onnx needs ONNX: pip install "jaxouter[onnx]"'),
        ("stablehlo", "flatbuffers", "jax.export needs FlatBuffers to write files: pip install flatbuffers"),
        ("fmu", None, "there is no C compiler on the PATH; install one that is called cc or gcc or clang"),
    ],
)
def test_what_a_format_needs_is_named(pitch, kind, missing, text, tmp_path, capsys, monkeypatch):
    if missing is None:
        monkeypatch.setenv("PATH", str(tmp_path))
    else:
        monkeypatch.setitem(sys.modules, missing, None)
        monkeypatch.delitem(sys.modules, f"jaxouter.exports.{kind}", raising=False)
        monkeypatch.delattr(sys.modules["jaxouter.exports"], kind, raising=False)
    with pytest.raises(SystemExit) as end:
        pitch.export(kind, tmp_path / f"controller.{kind}")
    assert end.value.code == 2
    assert capsys.readouterr().err == f"error: format {kind} can't be made here: {text}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("kind", "missing", "text"),
    [
        ("onnx", "onnxruntime", "what runs it is not installed: pip install onnxruntime"),
        ("fmu", "fmpy", 'what runs it is not installed: pip install "jaxouter[fmu]"'),
        ("c", None, "there is no C compiler on the PATH; install one that is called cc or gcc or clang"),
    ],
)
def test_it_says_where_it_could_not_verify(pitch, kind, missing, text, tmp_path, capsys, monkeypatch):
    if missing is None:
        monkeypatch.setenv("PATH", str(tmp_path))
    else:
        monkeypatch.setitem(sys.modules, missing, None)
    assert pitch.export(kind, tmp_path / f"controller.{kind}").stat().st_size > 1_000
    assert capsys.readouterr().out.splitlines()[-1] == f"not verified: {text}"


def test_help_teaches_the_formats(capsys):
    with pytest.raises(SystemExit) as end:
        export.main(["--help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    for word in (*files.FORMATS, "--out", "FMI 2.0", "C99", "median seed"):
        assert word in out


def test_onnx_says_how_to_call_it(pitch, tmp_path):
    """A caller who knows nothing but the file."""
    path = pitch.export("onnx", tmp_path / "controller.onnx")
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    said = {each.key: each.value for each in model.metadata_props}
    assert (said["plant"], said["y_unit"], said["time_unit"]) == ("pitch", "crad", "s")
    numbers = {
        key: float(said[key]) for key in ("control_step", "r_tilde_min", "r_tilde_max", "r_min", "r_max", "past")
    }
    assert list(numbers.values()) == [0.1, -60.0, 60.0, -17.0, 17.0, 3.0]
    assert "integral is 0" in said["start"]
    assert all("crad" in each.doc_string for each in model.graph.input)

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert [each.name for each in session.get_inputs()] == ["r", "y", "y_past", "r_tilde_past", "integral"]
    names = [each.name for each in session.get_outputs()]
    assert names == ["r_tilde", "y_past_next", "r_tilde_past_next", "integral_next"]
    y, h = np.float32(80.0), int(said["past"])
    before = np.clip(y, np.float32(said["r_tilde_min"]), np.float32(said["r_tilde_max"]))
    state = {"y_past": np.full(h, y), "r_tilde_past": np.full(h, before), "integral": np.zeros((), np.float32)}
    wanted = pitch.spec.init(80.0)
    for r in np.float32([10.0, 10.0, -3.0, 4.0, 5.0]):
        out = dict(zip(names, session.run(None, {"r": np.asarray(r), "y": np.asarray(y), **state}), strict=True))
        state = {name: out[f"{name}_next"] for name in state}
        wanted, r_tilde = pitch.spec.act(wanted, r, y)
        assert out["r_tilde"] == pytest.approx(r_tilde, abs=1e-3)
        np.testing.assert_allclose(np.hstack(list(state.values())), np.hstack(wanted), atol=1e-3)
        y = np.float32(0.5 * y)


def test_stablehlo_runs_without_this_package_and_for_other_platforms(pitch, tmp_path):
    path = pitch.export("stablehlo", tmp_path / "controller.stablehlo")
    code = f"""
import json, pathlib, sys, jax, numpy as np
from jax import export
exported = export.deserialize(bytearray(pathlib.Path({str(path)!r}).read_bytes()))
state = np.full(3, 2, np.float32), np.full(3, 2, np.float32), np.float32(0)
r_tilde = []
for r in (5, 5, -1):
    value, *state = exported.call(np.float32(r), np.float32(2), *state)
    r_tilde.append(float(value))
print(json.dumps([exported.platforms, r_tilde, any(name.startswith("jaxouter") for name in sys.modules)]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    platforms, r_tilde, known = json.loads(done.stdout)
    assert {"cpu", "cuda", "tpu"} <= set(platforms)
    assert not known
    state = pitch.spec.init(2.0)
    for r, got in zip((5.0, 5.0, -1.0), r_tilde, strict=True):
        state, wanted = pitch.spec.act(state, r, 2.0)
        assert got == pytest.approx(wanted, abs=1e-3)


MAIN = """
#include <stdio.h>
#include "controller.h"

int main(void)
{
    NAME_state state;
    float y = 2.0f;
    int k;

    NAME_init(&state, y);
    for (k = 0; k < 20; k++) {
        const float r_tilde = NAME_step(&state, 5.0f, y);
        printf("%.9g\\n", (double)r_tilde);
        y += 0.1f * (r_tilde / 3.0f - y);
    }
    return 0;
}
"""


@pytest.mark.parametrize("compiler", ["gcc", "g++", "clang"])
def test_c_compiles_without_a_warning_and_runs_from_c(pitch, compiler, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    path = pitch.export("c", tmp_path / "controller.c")
    main = tmp_path / "main.c"
    main.write_text(MAIN.replace("NAME", c.prefix(pitch.spec)))
    flags = [*STRICT, *MORE] if compiler != "g++" else [f for f in STRICT if f != "-std=c99"]
    got = compile_and_run(tmp_path, [main, path], *flags, compiler=compiler)
    state, y = pitch.spec.init(2.0), np.float32(2.0)
    for value in got:
        state, r_tilde = pitch.spec.act(state, 5.0, y)
        assert value == pytest.approx(r_tilde, abs=1e-3)
        y = np.float32(y + np.float32(0.1) * (r_tilde / np.float32(3.0) - y))
    assert len(got) == 20


def test_sources_of_the_fmu_compile_without_a_warning(pitch, tmp_path):
    path = pitch.export("fmu", tmp_path / "controller.fmu")
    folder = Path(fmpy.extract(str(path), str(tmp_path / "fmu"))) / "sources"
    said = fmpy.model_description.read_build_description(str(path))[0].sourceFileSets[0]
    assert sorted(said.sourceFiles) == sorted(each.name for each in folder.glob("*.c"))
    command = ["gcc", *STRICT, *MORE, "-shared", "-fPIC", *said.sourceFiles, "-o", "out.so", "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")


def test_c_needs_no_memory_and_has_symbols_of_its_own(pitch, tmp_path):
    path = pitch.export("c", tmp_path / "controller.c")
    subprocess.run(["gcc", *STRICT, "-c", str(path), "-o", str(tmp_path / "a.o")], check=True, timeout=60)
    out = subprocess.run(["nm", "-g", str(tmp_path / "a.o")], capture_output=True, text=True, check=True).stdout
    found = [line.split()[-2:] for line in out.splitlines()]
    assert {name for kind, name in found if kind != "U"} == {"pitch_outer_loop_init", "pitch_outer_loop_step"}
    assert {name for kind, name in found if kind == "U"} <= {"tanhf", "memmove", "memcpy", "_GLOBAL_OFFSET_TABLE_"}
    header = (tmp_path / "controller.h").read_text()
    for text in ("[-60, 60] crad", "0.1 s", "pitch_outer_loop_init(&state, y)", "r in [-17, 17], y in [-60, 60] crad"):
        assert text in header


def test_c_with_what_is_not_finite(pitch, tmp_path):
    nan, inf = float("nan"), float("inf")
    with verify.opened("c", pitch.export("c", tmp_path / "controller.c"), pitch.spec) as controller:
        state, last = controller.act(controller.init(2.0), 5.0, 3.0)
        for r, y, wanted in [
            (5.0, nan, 5.0), (70.0, inf, 60.0), (-70.0, nan, -60.0), (nan, 3.0, last), (inf, 3.0, last),
            (-inf, nan, last),
        ]:  # fmt: skip
            after, r_tilde = controller.act(state, r, y)
            assert r_tilde == wanted
            assert bytes(after) == bytes(state)
        assert bytes(controller.init(nan)) == bytes(controller.init(pitch.spec.y_middle))
        for r, y in [(3e38, -3e38), (-3e38, 3e38), (1.0, 3e38), (3e38, 1.0)]:
            after, r_tilde = controller.act(state, r, y)
            assert -60.0 <= r_tilde <= 60.0
            for _ in range(pitch.spec.history):
                after, r_tilde = controller.act(after, 5.0, 3.0)
                assert -60.0 <= r_tilde <= 60.0
            assert list(after.y_past) == [3.0] * pitch.spec.history
            assert np.isfinite(after.integral)


@pytest.mark.parametrize(("history", "hidden"), [(1, (16,)), (2, ())])
def test_smallest_controllers(pitch, history, hidden, tmp_path):
    """One sample of the past; no hidden layer."""
    rng = np.random.default_rng(0)
    widths = [3 + 2 * history, *hidden, 1]
    weights = tuple(rng.normal(size=pair).astype(np.float32) for pair in pairwise(widths))
    biases = tuple(rng.normal(size=n).astype(np.float32) for n in widths[1:])
    spec = dataclasses.replace(pitch.spec, history=history, weights=weights, biases=biases)
    paths = {kind: tmp_path / f"controller.{kind}" for kind in ("onnx", "c", "fmu")}
    for kind, path in paths.items():
        files._write(kind, path, spec, pitch.policy, pitch.params)
        with verify.opened(kind, path, spec) as controller:
            state, wanted = controller.init(2.0), spec.init(2.0)
            for r, y in [(5.0, 2.0), (5.0, 3.0), (-5.0, 1.0), (0.0, 0.0)]:
                state, got = controller.act(state, r, y)
                wanted, r_tilde = spec.act(wanted, r, y)
                assert got == pytest.approx(r_tilde, abs=1e-3)


@pytest.mark.parametrize(
    ("plant", "name"),
    [
        ("pitch", "pitch_outer_loop"), ("fmu:a/b*/ c.fmu", "fmu_a_b_c_fmu_outer_loop"), ("747", "plant_747_outer_loop"),
        ("*/", "outer_loop"),
    ],
)  # fmt: skip
def test_any_name_of_a_plant_gives_an_fmu(pitch, plant, name, tmp_path):
    spec = dataclasses.replace(pitch.spec, plant=plant, y_unit='"\\°</*', time_unit="<a&b>")
    assert c.prefix(spec) == name
    fmu.save(spec, tmp_path / "controller.fmu")
    assert validate_fmu(str(tmp_path / "controller.fmu")) == []
    assert fmpy.read_model_description(str(tmp_path / "controller.fmu")).modelName == name


def test_fmu_describes_itself(runs, tmp_path):
    for plant, step, unit in (("pitch", 0.1, "crad"), ("heaters", 3600.0, "degC")):
        path = runs[plant].export("fmu", tmp_path / f"{plant}.fmu")
        assert validate_fmu(str(path)) == []
        said = fmpy.read_model_description(str(path))
        assert said.fmiVersion == "2.0"
        assert not said.coSimulation.canHandleVariableCommunicationStepSize
        assert float(said.defaultExperiment.stepSize) == step
        low, high = runs[plant].spec.r_tilde_bounds
        assert [(v.name, v.causality, v.unit) for v in said.modelVariables] == [
            ("r", "input", unit), ("y", "input", unit), ("r_tilde", "output", unit), ("time", "independent", "s"),
        ]  # fmt: skip
        assert (float(said.modelVariables[2].min), float(said.modelVariables[2].max)) == (low, high)
        assert fmpy.supported_platforms(str(path)) == ["c-code", fmpy.platform]
    first, second = (fmpy.read_model_description(str(tmp_path / f"{p}.fmu")).guid for p in ("pitch", "heaters"))
    assert first != second


def test_fmu_simulates_in_fmpy_like_the_law(pitch, tmp_path):
    path = pitch.export("fmu", tmp_path / "controller.fmu")
    seen = verify.signals(pitch.spec, pitch.policy, pitch.params, steps=200)
    time = 0.1 * np.arange(201)
    signals = np.zeros(201, [("time", float), ("r", float), ("y", float)])
    signals["time"], signals["r"][:200], signals["y"][:200] = time, seen.r, seen.y
    out = fmpy.simulate_fmu(str(path), input=signals, stop_time=20.0, output=["r_tilde"])
    np.testing.assert_allclose(out["time"], time)
    assert out["r_tilde"][0] == pytest.approx(np.clip(seen.y[0], -60.0, 60.0))
    np.testing.assert_allclose(out["r_tilde"][1:], seen.r_tilde, atol=1e-4 * 120.0)


@pytest.fixture
def slave(pitch, tmp_path):
    """An instance of the FMU, with the messages that it logs."""
    path = pitch.export("fmu", tmp_path / "controller.fmu")
    said = fmpy.read_model_description(str(path))
    folder = fmpy.extract(str(path), str(tmp_path / "fmu"))
    # FMPy has one logger in a process, that of the newest instance which brings its own.
    instance = fmpy.instantiate_fmu(folder, said, "CoSimulation", logger=lambda *message: print(message[-1].decode()))
    instance.setupExperiment(startTime=0.0)
    instance.enterInitializationMode()
    yield instance
    instance.freeInstance()


def test_fmu_refuses_other_steps_and_says_so(slave, capfd):
    slave.exitInitializationMode()
    slave.doStep(0.0, 0.1 * (1 + 1e-9))
    assert slave.getRealStatus(2) == pytest.approx(0.1)
    for step in (0.05, 0.2, 0.0, float("nan")):
        with pytest.raises(FMICallException) as error:
            slave.doStep(0.1, step)
        assert error.value.status == fmi2Error
        sys.stdout.flush()
        assert f"the communication step is {step:g}; it must be the control step, 0.1" in capfd.readouterr().out


def test_fmu_keeps_the_order_of_calls(slave, capfd):
    with pytest.raises(FMICallException):
        slave.doStep(0.0, 0.1)
    sys.stdout.flush()
    assert "fmi2DoStep must come after fmi2ExitInitializationMode" in capfd.readouterr().out
    for call in (lambda: slave.setReal([2], [1.0]), lambda: slave.getReal([9]), lambda: slave.getInteger([0])):
        with pytest.raises(FMICallException):
            call()
    slave.exitInitializationMode()
    slave.terminate()
    with pytest.raises(FMICallException):
        slave.doStep(0.0, 0.1)


def test_fmu_begins_with_the_first_y_and_its_state_can_be_kept(pitch, slave):
    slave.setReal([0, 1], [5.0, 90.0])
    assert slave.getReal([2]) == [60.0]  # y within the bounds of r~
    slave.exitInitializationMode()
    slave.setReal([1], [3.0])

    def steps(n: int) -> list[float]:
        out = []
        for _ in range(n):
            slave.doStep(0.0, 0.1)
            out += slave.getReal([2])
        return out

    first = steps(1)
    _, wanted = pitch.spec.act(pitch.spec.init(3.0), 5.0, 3.0)
    assert first[0] == pytest.approx(wanted, abs=1e-3)
    kept = slave.getFMUstate()
    ahead = steps(4)
    slave.setFMUstate(kept)
    slave.freeFMUstate(kept)
    assert steps(4) == ahead
    slave.reset()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.setReal([0, 1], [5.0, 3.0])
    slave.exitInitializationMode()
    assert steps(5) == first + ahead


def test_fmu_takes_memory_from_the_importer_alone(pitch, tmp_path):
    path = pitch.export("fmu", tmp_path / "controller.fmu")
    folder = Path(fmpy.extract(str(path), str(tmp_path / "fmu")))
    library = next((folder / "binaries").glob("*/*"))
    out = subprocess.run(["nm", "-D", "--undefined-only", str(library)], capture_output=True, text=True, check=True)
    assert not [line for line in out.stdout.splitlines() if "alloc" in line or "free" in line]
    loaded = ctypes.CDLL(str(library))
    loaded.fmi2Instantiate.restype = ctypes.c_void_p
    assert loaded.fmi2Instantiate(b"a", 1, b"another", b"", None, 0, 0) is None
