"""The real-time command as users call it."""

import json
import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from jaxouter import live
from jaxouter.exports.spec import ControllerSpec
from jaxouter.identification.recorded_data import read
from jaxouter.training.run import RunFolder
from tests import interrupts
from tests.load import ROOT
from tests.training.small import small

EXAMPLE = f"{ROOT}/scripts/examples/loop.py:step"
NOTHING = ["--learn", "--r-tilde-bounds", "0", "10", "--setpoint-range", "2", "6", "--dt", "0.02"]


def start(*arguments: str, cwd) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "jaxouter.live", *arguments]
    with interrupts.heard():
        return subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A run from nothing in real time, through the entry point: what it printed, and its folder."""
    folder = tmp_path_factory.mktemp("live")
    process = start(EXAMPLE, "--run", "loop", *NOTHING, "--steps", "500", "--record", "200", cwd=folder)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    return out, folder / "loop"


@pytest.mark.slow
def test_it_begins_from_nothing_in_real_time(begun):
    out, folder = begun
    for text in ("step 0: recording", ": static", ": lq", "missed deadlines", "us (p99)", "r~ = r"):
        assert text in out
    summary = json.loads((folder / "live" / "summary.json").read_text())
    assert summary["steps"] == 500 == sum(summary["counts"].values())
    assert sum(summary["counts"][name] for name in ("static", "lq", "learned")) > 100
    assert summary["missed_deadlines"] == summary["counts"]["late"]
    assert summary["updates"] > 50
    law = summary["base"]  # the LQ law, which integrates
    assert law["r"] == -law["y"] > 0.0
    assert sum(law["r_tilde_past"]) == pytest.approx(1.0, abs=1e-4)
    assert 0.0 < summary["act_us"]["p50"] < summary["act_us"]["p99"]
    last = summary["mae"]["last quarter"]
    assert last["y"] < last["y_passed"]
    assert summary["mae"]["first quarter"]["y_passed"] is None
    assert (folder / "live" / "live.png").read_bytes().startswith(b"\x89PNG")
    assert ControllerSpec.load(folder / "live" / "controller.npz").control_step == 0.02


@pytest.mark.slow
def test_the_rows_are_a_log_where_no_deadline_was_missed(begun):
    path = begun[1] / "live" / "steps.csv"
    lines = path.read_text().splitlines()
    assert lines[0] == "step,time,r,y,r_tilde,why,y_passed,y_kept,y_learned"
    assert len(lines) == 501
    why = [line.split(",")[5] for line in lines[1:]]
    if "late" not in why:
        assert read(path).step == pytest.approx(0.02)


@pytest.mark.slow
def test_it_goes_on_where_it_was_and_ends_by_ctrl_c(begun, tmp_path):
    folder = begun[1]
    process = start(EXAMPLE, "--run", str(folder), "--dt", "0.02", "--reference", "4", cwd=tmp_path)
    rows = folder / "live" / "steps.csv"
    deadline = time.monotonic() + 100
    while len(rows.read_text().splitlines()) < 520 and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "stopped; saved, resume with the same command" in err
    summary = json.loads((folder / "live" / "summary.json").read_text())
    assert summary["steps"] == len(rows.read_text().splitlines()) - 1 > 515
    assert summary["counts"]["recording"] < 300  # of the first run alone
    times = [float(line.split(",")[1]) for line in rows.read_text().splitlines()[1:]]
    assert np.all(np.diff(times) > 0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run folder with a checkpoint."""
    run = RunFolder.create(small("pitch"), tmp_path_factory.mktemp("run") / "pitch")
    trainer, params = run.trainer
    run.save(0, 0, trainer.fresh(jax.random.key(0), params))
    return run.path


def test_a_trained_run_acts_and_its_folder_stays_as_it_is(trained, capsys):
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    live.main([EXAMPLE, "--run", str(trained), "--dt", "0.1", "--steps", "5", "--reference", "3"])
    out = capsys.readouterr().out
    assert "5 steps (" in out
    assert "; 0 updates" in out
    assert {path: path.read_bytes() for path in before} == before
    live.main([EXAMPLE, "--run", str(trained / "seed-0"), "--dt", "0.05", "--steps", "2", "--learn"])
    assert "the period is 0.05 s; the policy was trained for 0.1 s" in capsys.readouterr().err
    assert (trained / "seed-0" / "live" / "summary.json").exists()


def test_a_function_that_fails_ends_with_one_line_and_all_is_saved(trained, tmp_path, capsys):
    (tmp_path / "own.py").write_text(
        "calls = []\ndef step(r_tilde):\n    calls.append(0)\n    return 1 / (4 - len(calls))\n"
    )
    with pytest.raises(SystemExit) as end:
        live.main([f"{tmp_path}/own.py:step", "--run", str(trained), "--dt", "0.1"])
    assert end.value.code == 1
    assert "error: it failed: ZeroDivisionError: division by zero; saved" in capsys.readouterr().err


def test_the_column_r_of_a_file_is_what_is_asked_for(trained, tmp_path, capsys):
    (tmp_path / "r.csv").write_text("time,r\n0,1.5\n1,2.5\n")
    arguments = ["--run", str(trained), "--dt", "0.1", "--steps", "3", "--reference", str(tmp_path / "r.csv")]
    rows = trained / "live" / "steps.csv"
    rows.unlink(missing_ok=True)
    live.main([EXAMPLE, *arguments])
    capsys.readouterr()
    r = [float(line.split(",")[2]) for line in rows.read_text().splitlines()[1:]]
    assert sorted(set(r)) == [1.5, 2.5]


def test_a_module_that_is_importable_is_named_without_py(trained, tmp_path, monkeypatch, capsys):
    (tmp_path / "own_loop.py").write_text("def step(r_tilde):\n    return 0.5 * r_tilde\n")
    monkeypatch.syspath_prepend(tmp_path)
    live.main(["own_loop:step", "--run", str(trained), "--dt", "0.1", "--steps", "2"])
    assert "updates" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["step", "--run", "x", "--dt", "1"], "the function is 'step'; it is named FILE.py:NAME or MODULE:NAME"),
        (["nothing.py:step", "--run", "x", "--dt", "1"], "nothing.py is not a Python file"),
        (["no_such_module:step", "--run", "x", "--dt", "1"], "can't be imported: No module named"),
        (["math:pi", "--run", "x", "--dt", "1"], "it must be a function of r~ that gives y"),
        ([EXAMPLE, "--run", "x", "--dt", "0"], "--dt is 0.0; it must be a positive number of seconds"),
        ([EXAMPLE, "--run", "x", "--dt", "nan"], "--dt is nan"),
        ([EXAMPLE, "--run", "x", "--dt", "1", "--steps", "0"], "--steps is 0; it must be at least 1"),
        ([EXAMPLE, "--run", "x", "--dt", "1"], "there is no run x; train one, or start without one by --learn"),
        ([EXAMPLE, "--run", "x", "--dt", "1", "--learn"], "needs --r-tilde-bounds LOW HIGH --setpoint-range LOW HIGH"),
        ([EXAMPLE, "--run", "x", *NOTHING, "--setpoint-range", "6", "2"], "--setpoint-range is (6.0, 2.0)"),
        ([EXAMPLE, "--run", "x", *NOTHING, "--reference", "zigzag"], "--reference is 'zigzag'; it must be a number"),
        ([EXAMPLE, "--run", "x", *NOTHING, "--reference", "no.csv"], "--reference: no.csv can't be read: No such file"),
        ([EXAMPLE, "--run", "x", *NOTHING, "--reference", "inf"], "--reference is 'inf'; it must be finite numbers"),
        ([EXAMPLE, "--run", "full", *NOTHING], "full is not a run folder"),
    ],
)
def test_mistakes_are_one_line_and_status_2_and_nothing_is_written(arguments, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(SystemExit) as end:
        live.main(arguments)
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert text in " ".join((captured.out + captured.err).split())
    assert sorted(os.listdir()) == ["full"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--dt", "0.05"], "dt is 0.05; "),
        (["--dt", "0.02", "--r-tilde-bounds", "0", "9"], "r_tilde_bounds is (0.0, 9.0); "),
    ],
)
def test_another_declaration_than_that_of_the_folder_is_refused(begun, arguments, text, capsys):
    with pytest.raises(SystemExit) as end:
        live.main([EXAMPLE, "--run", str(begun[1]), *arguments])
    assert end.value.code == 2
    assert text in capsys.readouterr().err


def test_a_damaged_folder_is_said(tmp_path, capsys):
    (tmp_path / "live").mkdir()
    (tmp_path / "live" / "config.json").write_text("{}")
    with pytest.raises(SystemExit) as end:
        live.main([EXAMPLE, "--run", str(tmp_path), "--dt", "0.02"])
    assert end.value.code == 2
    assert "config.json is not readable" in capsys.readouterr().err
