"""The commands where something is missing that is usually there: a home, a terminal, a reader, a device, a signal."""

import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import jax
import pytest
from rich.console import Console

from jaxouter import cli, terminal
from jaxouter.evaluation import cache, drawing
from tests import interrupts
from tests.load import ROOT

MODULES = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
WARM = "from dataclasses import replace\n\nfrom tests import lag\n\n\ndef Warm():\n    plant, params = lag.make()\n"
WARM += '    return replace(plant, y_unit="°C"), params\n'
HOMELESS = """
import os, pwd, runpy, sys
def nobody(uid): raise KeyError(uid)
pwd.getpwuid = nobody  # as for a number of which the system knows no user
for command, *arguments in (
    ("check", "warm.py:Warm", "--figure", "step-response.png"),
    ("train", "warm.py:Warm", "--dry-run"),
    ("evaluate", "--plant", "warm.py:Warm", "--policy", "none", "--scenario", "Warm/steps", "--episodes", "1"),
    ("compare", "--list"),
):
    sys.argv[1:] = arguments
    runpy.run_module(f"jaxouter.{command}", run_name="__main__", alter_sys=True)
"""


def ended(code: str, cwd: Path, **options) -> subprocess.CompletedProcess[str]:
    """A script after what was started ended; it finds the modules of the tests."""
    kept = {name: os.environ[name] for name in ("PATH", "XLA_FLAGS") if name in os.environ}
    environment = kept | {"PYTHONPATH": MODULES, "PYTHONDONTWRITEBYTECODE": "1"} | options.pop("env", {})
    return subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, env=environment, capture_output=True, text=True, timeout=250, **options
    )


def test_a_command_works_without_home_user_cache_backend_terminal_and_unicode(tmp_path):
    (tmp_path / "warm.py").write_text(WARM, encoding="utf-8")
    bare = {"MPLBACKEND": "nonsense", "TERM": "dumb", "COLUMNS": "20", "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    fast = {name: os.environ[name] for name in ("MPLCONFIGDIR", "JAX_COMPILATION_CACHE_DIR")}
    done = ended(HOMELESS, tmp_path, env=bare | fast)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("warning: there is no cache folder, for want of a home")
    for text in ("-2 to 2 ?C", "gradient steps", "policy none", "pitch/paper"):
        assert text in done.stdout
    assert (tmp_path / "step-response.png").stat().st_size > 10_000
    assert {path.name for path in tmp_path.iterdir()} == {"warm.py", "step-response.png"}


ELSEWHERE = """
import importlib, pkgutil, sys
for name in ("fcntl", "resource", "termios", "pwd", "grp", "readline", "tty", "pty"):
    sys.modules[name] = None  # as on Windows
import jaxouter
for module in pkgutil.walk_packages(jaxouter.__path__, "jaxouter."):
    importlib.import_module(module.name)
print("imported", flush=True)

import jax
from jax.extend.backend import clear_backends
from jaxouter import check, compare, evaluate, export, live, train
for name, main, *arguments in (
    ("cuda", train.main, "lag.py:make", "--seeds", "2"),
    ("nonsense", train.main, "heaters", "--dry-run"),
    ("tpu", evaluate.main, "--policy", "none"),
    ("cuda", compare.main, "lag.py:make"),
    ("cpu,nonsense", check.main, "lag.py:make"),
    ("cuda", export.main, "run", "--format", "npz"),
    ("tpu", live.main, "loop.py:step", "--learn", "--r-tilde-bounds", "0", "1", "--setpoint-range", "0", "1", "--dt",
     "0.1", "--run", "loop"),
):
    jax.config.update("jax_platforms", name)  # as JAX_PLATFORMS does when it is imported
    try:
        main(arguments)
    except SystemExit as end:
        assert end.code == 2
    clear_backends()
"""


def test_without_home_and_cache_folder_functions_are_compiled_and_a_line_says_so(monkeypatch, capsys):
    before = jax.config.values["jax_compilation_cache_dir"]
    monkeypatch.setattr(cache, "folder", lambda: None)
    cache._usable.cache_clear()
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        for _ in range(2):
            with warnings.catch_warnings():
                warnings.simplefilter("default")
                warnings.showwarning = terminal.show
                cache.use_compilation_cache()
        assert not jax.config.values["jax_compilation_cache_dir"]
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: there is no cache folder, for want of a home")


def test_fonts_have_a_folder_where_there_is_no_home(monkeypatch):
    def home() -> Path:
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setenv("MPLCONFIGDIR", "")
    monkeypatch.setattr(Path, "home", home)
    drawing._fonts()
    assert list(Path(os.environ["MPLCONFIGDIR"]).iterdir()) == []


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """A process without what POSIX alone has, whose commands ask for devices that aren't there; and its folder."""
    folder = tmp_path_factory.mktemp("elsewhere")
    for name in ("tests/lag.py", "scripts/examples/loop.py"):
        (folder / Path(name).name).write_text((ROOT / name).read_text())
    return ended(ELSEWHERE, folder, env={"HOME": str(tmp_path_factory.mktemp("home"))}), folder


def test_every_module_is_imported_without_what_posix_alone_has(elsewhere):
    done, _ = elsewhere
    assert done.stdout.startswith("imported\n"), done.stderr


def test_a_device_that_is_not_there_is_said_before_anything_else(elsewhere):
    done, folder = elsewhere
    assert done.returncode == 0, done.stderr
    names = ("cuda", "nonsense", "tpu", "cuda", "cpu,nonsense", "cuda", "tpu")
    text = "error: JAX_PLATFORMS is '{}', but JAX finds only cpu: unset it, or set JAX_PLATFORMS=cpu"
    assert [line for line in done.stderr.splitlines() if "error" in line] == [text.format(name) for name in names]
    assert "Traceback" not in done.stderr
    assert done.stdout == "imported\n"
    assert {path.name for path in folder.iterdir()} == {"lag.py", "loop.py"}


def test_a_device_that_the_environment_names_and_is_not_there_is_one_line(tmp_path):
    code = "from jaxouter import train; train.main(['heaters', '--dry-run'])"
    done = ended(code, tmp_path, env={"JAX_PLATFORMS": "nonsense"})
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: JAX_PLATFORMS is 'nonsense'")


def test_a_suite_that_is_deaf_to_ctrl_c_starts_what_hears_it():
    deaf = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as nohup does
    try:
        with interrupts.heard():
            code = "import signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
            done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, deaf)
    assert done.stdout == "True\n"


NOTEBOOK = """
import asyncio, os, sys, threading
from jaxouter import compare, evaluate
os.cpu_count = lambda: 2
common = ["lag.py:make", "--policy", "none", "static", "--scenario", "lag/steps", "--sweep", "--out", "compared"]
async def cell():
    evaluate.main(["--plant", "lag.py:make", "--policy", "none", "--scenario", "make/steps"])
    thread = threading.Thread(target=compare.main, args=[[each.replace("lag/", "make/") for each in common]])
    thread.start()
    while thread.is_alive():
        await asyncio.sleep(0.1)
asyncio.run(cell())
"""


@pytest.mark.slow
def test_a_thread_an_event_loop_and_a_script_without_a_guard_will_do(tmp_path):
    """The processes of a comparison don't run the script again that has started it."""
    (tmp_path / "lag.py").write_text((ROOT / "tests" / "lag.py").read_text())
    (tmp_path / "script.py").write_text(NOTEBOOK)
    environment = os.environ | {"PYTHONPATH": MODULES, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    content = json.loads((tmp_path / "compared" / "comparison.json").read_text())
    assert [row["policy"] for row in content["rows"]] == ["none", "static"]


def test_signals_are_left_alone_where_they_cannot_or_must_not_be_handled():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    errors = []

    def enter() -> None:
        try:
            with terminal.Interrupt() as interrupt:
                assert not interrupt.requested
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert errors == []
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with terminal.Interrupt():
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) not in (signal.SIG_DFL, before[signal.SIGTERM])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_output_that_nobody_reads_is_dropped(monkeypatch):
    reading, writing = os.pipe()
    stream = terminal.Lasting(os.fdopen(writing, "w"))
    monkeypatch.setattr(sys, "stdout", stream)
    os.close(reading)
    for _ in range(3):
        print("x" * 100_000, flush=True)
        Console().print("a table")
    assert not stream.closed
    stream.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_output_that_cannot_be_written_is_said_once(monkeypatch, capsys):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", terminal.Lasting(full))
        for _ in range(3):
            print("x" * 10, flush=True)
    assert capsys.readouterr().err == (
        f"warning: the output can't be written ({os.strerror(errno.ENOSPC)}); going on without\n"
    )


def test_a_program_without_error_output_whose_reader_leaves_ends_well(tmp_path):
    """Through the real entry point, with the streams as a shell would close them."""
    lines = f"set -o pipefail; {sys.executable} -m jaxouter.train --list 2>&- | head -1; echo $? >&2"
    environment = os.environ | {"PYTHONPATH": MODULES}
    done = subprocess.run(["bash", "-c", lines], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("pitch\n", "0\n")


def test_streams_that_are_closed_from_the_start_take_everything(monkeypatch):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert not terminal.on_terminal()
    terminal.last()
    for stream in (sys.stdout, sys.stderr):
        print("°", file=stream, flush=True)
        stream.close()


def test_a_failure_that_ends_nothing_is_told_in_a_line(capsys):
    with terminal.optional("figures"):
        raise RuntimeError("no fonts\nand much more")
    assert capsys.readouterr().err == "warning: no figures: RuntimeError: no fonts\n"


def test_a_file_that_cannot_be_written_ends_a_program_with_one_line(monkeypatch):
    monkeypatch.setattr(cli, "last", lambda: None)

    def main() -> None:
        Path("/nowhere/at/all").write_text("")

    with pytest.raises(SystemExit, match=r"error: .*No such file or directory: '/nowhere/at/all'"):
        cli.run(main)


def test_a_compilation_cache_that_cannot_be_written_is_said_once(capsys):
    for i in range(3):
        terminal.show(f"Error writing persistent compilation cache entry for 'jit_f{i}': PermissionError")
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(("given", "found"), [("0", 80), ("1", 20), ("20", 20), ("-5", 80), ("wide", 80), ("200", 200)])
def test_columns_are_as_many_as_text_needs(monkeypatch, given, found):
    monkeypatch.setattr(os, "get_terminal_size", lambda *_: os.terminal_size((80, 24)))
    monkeypatch.setenv("COLUMNS", given)
    terminal.set_columns()
    assert os.environ["COLUMNS"] == str(found)


def test_a_narrow_terminal_has_room_for_every_table(monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(cli, "console", Console(file=out, width=20, force_terminal=True))
    cli.table("MAE, crad", ["scenario", "learned", "none"], [["pitch/paper", "2.68", "11.90"]])
    cli.print_lists()
    assert {"2.68", "11.90", "pitch"} <= set(re.findall(r"[\w.]+", out.getvalue()))
