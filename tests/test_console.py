"""The program `jaxouter`: each command by its name, and the same command as `python -m jaxouter.NAME`."""

import re
import subprocess
import sys
import tomllib

import pytest

import jaxouter
from jaxouter import __main__ as console
from jaxouter import cli
from tests.load import ROOT


def test_help_lists_each_command_with_what_it_does(capsys):
    for arguments in ([], ["--help"], ["-h"]):
        console.main(arguments)
        shown = capsys.readouterr().out
        assert shown.startswith("usage: jaxouter COMMAND ...\n")
        assert dict(re.findall(r"^  (\w+) +(.+)$", shown, re.MULTILINE)) == console.COMMANDS


def test_each_command_is_a_module_and_each_such_module_a_command():
    modules = (ROOT / "jaxouter").glob("*.py")
    commands = {path.stem for path in modules if path.read_text().startswith('"""`python -m jaxouter.')}
    assert set(console.COMMANDS) == commands


def test_its_version_is_that_of_the_library(capsys):
    console.main(["--version"])
    assert capsys.readouterr().out == f"{jaxouter.__version__}\n"


@pytest.mark.parametrize("name", ["trian", "--list", ""])
def test_an_unknown_command_is_one_line_and_status_2(name, capsys):
    with pytest.raises(SystemExit) as end:
        console.main([name])
    assert end.value.code == 2
    told = f"error: there is no command {name!r}; the commands are: {', '.join(console.COMMANDS)}\n"
    assert capsys.readouterr() == ("", told)


def test_a_command_gets_the_rest_of_the_arguments(capsys):
    console.main(["train", "--list"])
    assert "agents: ddpg" in capsys.readouterr().out


@pytest.mark.parametrize("name", console.COMMANDS)
def test_help_of_a_command_names_it_as_it_was_called(name, capsys, monkeypatch):
    for called, shown in (("/usr/bin/jaxouter", f"jaxouter {name}"), (f"{name}.py", f"python -m jaxouter.{name}")):
        monkeypatch.setattr(sys, "argv", [called])
        with pytest.raises(SystemExit) as end:
            console.main([name, "--help"])
        assert end.value.code in (None, 0)
        assert capsys.readouterr().out.lstrip().startswith(f"usage: {shown} ")


@pytest.mark.parametrize("name", console.COMMANDS)
def test_a_mistake_is_told_on_stderr_with_status_2_by_each_command(name, capsys):
    with pytest.raises(SystemExit) as end:
        console.main([name, "--no-such-option"])
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert (out, "--help" in err) == ("", True)


def test_the_installed_program_is_this_function():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"jaxouter": f"{console.__name__}:main"}


def test_version_and_help_import_no_jax():
    code = (
        "import sys; from jaxouter.__main__ import main; main(['--version']); main([]); assert 'jax' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_program_is_called_as_the_user_called_it(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["jaxouter.exe"])
    assert cli.program("train") == "jaxouter train"
