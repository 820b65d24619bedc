"""The comparison as users call it."""

import base64
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib
import msgspec
import numpy as np
import pytest
import tyro

from jaxouter import compare, evaluate
from jaxouter.evaluation import comparison, scenarios, sweeps
from jaxouter.evaluation.baselines import NAMES
from jaxouter.evaluation.results import Comparison
from jaxouter.plants import REGISTRY
from jaxouter.progress import showing
from jaxouter.training.run import RunFolder, write_json
from tests import interrupts, lag
from tests.training.small import small

LEAD = Path(__file__).parents[1] / "scripts" / "examples" / "lead.py"
ASKED = ["pitch", "--scenario", "pitch/paper", "--sweep", "pitch/gain"]
POLICIES = ["learned", "lead.py:Lead", "none", "static"]


class Compared(NamedTuple):
    """What a comparison left."""

    stdout: str
    out: Path
    cache: Path
    content: dict

    def rows(self, policy: str) -> list[dict]:
        return [row for row in self.content["rows"] if row["policy"] == policy]


def command(*arguments: str, cwd: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    fonts = {"MPLCONFIGDIR": matplotlib.get_cachedir()}  # else they are looked for again
    return subprocess.run(
        [sys.executable, "-m", "jaxouter.compare", *arguments],
        cwd=cwd,
        env=os.environ | {"XDG_CACHE_HOME": str(cache)} | fonts,
        capture_output=True,
        text=True,
        timeout=280,
    )


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two seeds that has only begun, of which the second counts as the median."""
    run = RunFolder.create(small("pitch", seeds=2), tmp_path_factory.mktemp("runs") / "run")
    trainer, params = run.trainer
    for seed in run.seeds:
        run.save(seed, 1, trainer.start(seed, params))
    write_json(run.path / "summary.json", {"median_seed": 1})
    return run


@pytest.fixture(scope="module")
def compared(tmp_path_factory, run):
    """Two seeds of a run, the example and two baselines, on a scenario and a sweep, through the real entry point."""
    folder = tmp_path_factory.mktemp("compare")
    arguments = [*ASKED, "--run", str(run.path), "--policy", "none", "static", f"{LEAD}:Lead", "--out", "a/result"]
    done = command(*arguments, cwd=folder, cache=folder / "cache")
    assert done.returncode == 0, done.stderr
    out = folder / "a" / "result"
    return Compared(done.stdout, out, folder / "cache", json.loads((out / "comparison.json").read_text()))


def test_comparison_json_has_the_keys_that_the_report_needs(compared):
    content = compared.content
    assert content.keys() == {
        "format", "plant", "y_unit", "time_unit", "family_seed", "date", "machine", "policies", "rows", "statistics",
        "sweeps", "stability", "seconds", "command", "folder",
    }  # fmt: skip
    assert [content[key] for key in ("format", "plant", "y_unit", "time_unit")] == [1, "pitch", "crad", "s"]
    assert content["machine"].keys() == {"versions", "device", "flags"}
    assert content["command"].startswith("python -m jaxouter.compare pitch --scenario pitch/paper --sweep pitch/gain ")
    assert {name: each["kind"] for name, each in content["policies"].items()} == dict(
        zip(POLICIES, ("learned", "user", "baseline", "baseline"), strict=True)
    )
    assert content["policies"]["static"]["settings"]["slope"] == pytest.approx(3.0, rel=0.01)
    assert content["policies"]["static"]["steps"] == 1600


def test_rows_are_those_of_the_specification(compared):
    rows = compared.content["rows"]
    assert [(row["policy"], row["seed"]) for row in rows] == [
        ("learned", 1), ("learned", 0), ("lead.py:Lead", None), ("none", None), ("static", None),
    ]  # fmt: skip
    (lead,), (alone,), (static,) = (compared.rows(name) for name in POLICIES[1:])
    assert alone["mae"] == pytest.approx(10.907, rel=1e-3)
    assert static["mae"] == pytest.approx(3.404, abs=0.01)
    assert lead["mae"] < static["mae"]
    for row in rows:
        assert row["scenario"] == "pitch/paper"
        assert (row["ratio_to_limit"], row["ratio_to_bound"], row["within_limits"]) == (None, None, True)
        assert row["improvement"] == pytest.approx(100 * (1 - row["mae"] / alone["mae"]))
    assert (lead["rank"], static["rank"], lead["best"], static["best"]) == (1, 2, True, False)
    assert [(row["rank"], Path(row["run"]).name) for row in compared.rows("learned")] == [(4, "run")] * 2
    assert compared.rows("learned")[0]["mae"] != compared.rows("learned")[1]["mae"]
    lines = compared.content["statistics"]["lines"]
    assert {label: line["seeds"] for label, line in lines.items()} == dict(zip(POLICIES, (2, 1, 1, 1), strict=True))


def test_sweep_and_stability_are_those_of_the_first_seed(compared):
    gain = compared.content["sweeps"]["pitch/gain"]
    assert list(gain["policies"]) == POLICIES
    for name, swept in gain["policies"].items():
        assert len(swept["values"][0]) == (5 if name == "lead.py:Lead" else 21)
        nominal = swept["mae"][swept["values"][0].index(1.0)]
        assert nominal == pytest.approx(compared.rows(name)[0]["mae"], rel=1e-4)
    assert set(gain["best_baseline"]["policy"]) == {"static"}
    stability = compared.content["stability"]
    for name in POLICIES:
        rows = [row for row in stability if row["policy"] == name]
        assert [row["set_point"] for row in rows] == pytest.approx(np.linspace(-16, 16, 19).tolist())
        assert {row["scenario"] for row in rows} == {"pitch/paper"}
        radii = [row["spectral_radius"] for row in rows]
        assert radii == [None] * 19 if name == "lead.py:Lead" else max(radii) < 1


def test_csv_has_the_same_rows(compared):
    with (compared.out / "comparison.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    rows = compared.content["rows"]
    assert table == [{key: "" if value is None else str(value) for key, value in row.items()} for row in rows]


def test_figures_are_drawn_and_the_report_holds_them(compared):
    figures = {path.stem: path.read_bytes() for path in (compared.out / "figures").glob("*.png")}
    assert set(figures) == {"errors", "effort", "sweep-gain", "stability", "pitch-paper"}
    assert {path.stem for path in (compared.out / "figures").glob("*.svg")} == set(figures)
    page = (compared.out / "report.html").read_text()
    for content in figures.values():
        assert content.startswith(b"\x89PNG\r\n\x1a\n")
        assert base64.b64encode(content).decode() in page
    for name in POLICIES:
        assert f">{name}<" in page
    assert {path.name for path in compared.out.iterdir()} == {
        "comparison.json", "comparison.csv", "report.html", "figures",
    }  # fmt: skip


def test_table_is_printed_and_where_the_report_is(compared):
    header = next(line for line in compared.stdout.splitlines() if "scenario" in line)
    assert sorted(POLICIES, key=header.index) == POLICIES
    line = next(line for line in compared.stdout.splitlines() if "│ pitch/paper" in line)
    shown = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", line)]
    learned = sum(row["mae"] for row in compared.rows("learned")) / 2
    assert shown == pytest.approx([learned, *(compared.rows(name)[0]["mae"] for name in POLICIES[1:])], rel=0.01)
    assert compared.stdout.rstrip().endswith(str(Path("a") / "result" / "report.html"))
    begun = [line.split("  ")[0] for line in compared.stdout.splitlines()]  # plain lines where there is no terminal
    assert [phase for phase in ("comparing", "statistics", "drawing") if phase not in begun] == []
    assert "*: best without the model." in compared.stdout
    assert "ratio to the limit" not in compared.stdout  # which nobody asked for


def test_baselines_come_from_the_cache_the_second_time(compared, tmp_path, monkeypatch):
    cached = {path: path.stat().st_mtime_ns for path in (compared.cache / "jaxouter" / "baselines").iterdir()}
    assert sorted(path.name.rsplit("-", 1)[0] for path in cached) == [
        "pitch-none", "pitch-none-evaluate", "pitch-none-stability", "pitch-none-sweep",
        "pitch-static", "pitch-static-evaluate", "pitch-static-stability", "pitch-static-sweep",
    ]  # fmt: skip
    monkeypatch.setenv("XDG_CACHE_HOME", str(compared.cache))
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    monkeypatch.chdir(tmp_path)
    compare.main([*ASKED, "--policy", "static"])
    assert {path: path.stat().st_mtime_ns for path in (compared.cache / "jaxouter" / "baselines").iterdir()} == cached
    content = json.loads((tmp_path / "runs" / "compare-pitch" / "comparison.json").read_text())
    assert [row["policy"] for row in content["rows"]] == ["none", "static"]
    for row in content["rows"]:
        (before,) = compared.rows(row["policy"])
        ranked = ("rank", "best")  # among other policies
        assert {k: v for k, v in row.items() if k not in ranked} == {k: v for k, v in before.items() if k not in ranked}
    assert comparison.folder(None, "pitch") == Path("runs/compare-pitch-2")


def test_where_nothing_can_be_drawn_all_else_is_written(compared, tmp_path, capsys, monkeypatch):
    def draw(*_: object) -> None:
        raise RuntimeError("no fonts")

    monkeypatch.setattr(comparison.comparison_figures, "draw", draw)
    content = msgspec.convert(compared.content, Comparison)
    selected = comparison.Selection("pitch", (), (), (), 0, tmp_path)
    with showing(True) as progress:
        page = comparison.write(selected, content, [], progress)
    assert capsys.readouterr().err == "warning: no figures: RuntimeError: no fonts\n"
    assert "outer loops compared" in page.read_text(encoding="utf-8")
    assert json.loads((tmp_path / "comparison.json").read_text()) == compared.content


def test_existing_folder_is_refused_and_left_alone(compared, capsys, monkeypatch):
    before = {path: path.stat().st_mtime_ns for path in compared.out.rglob("*")}
    monkeypatch.chdir(compared.out.parents[1])
    with pytest.raises(SystemExit) as end:
        compare.main(["--out", "a/result"])
    assert end.value.code == 2
    assert capsys.readouterr().err == f"error: {Path('a/result')} exists; choose another --out\n"
    assert {path: path.stat().st_mtime_ns for path in compared.out.rglob("*")} == before


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A working directory with a run on the heaters and files that hold no policy."""
    folder = tmp_path / "place"
    folder.mkdir()
    monkeypatch.chdir(folder)
    RunFolder.create(small("heaters"), Path("heated"))
    Path("fails.py").write_text("1 / 0")
    Path("empty.py").touch()
    shutil.copy(LEAD, "lead.py")
    Path("own.py").write_text(OWN)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    return folder


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["submarine"], "there is no plant 'submarine'; the plants are: pitch, heaters"),
        (
            ["--policy", "best"],
            "there is no policy 'best'; it may be FILE.py:CLASS or one of: none, static, lq, lq-return, pi, mpc",
        ),
        (["--policy", "lead.py"], "there is no policy 'lead.py'; it may be FILE.py:CLASS"),
        (
            ["--policy", "nowhere.py:Lead"],
            "nowhere.py is not a Python file; a policy of your own is named FILE.py:NAME",
        ),
        (["--policy", "lead.py:Lag"], "lead.py has no 'Lag'"),
        (["--policy", "empty.py:Lead"], "empty.py has no 'Lead'"),
        (["--policy", "fails.py:Lead"], "fails.py can't be imported: ZeroDivisionError: division by zero"),
        (["--scenario", "pitch/papers"], "there is no scenario 'pitch/papers'; pitch has: pitch/paper, "),
        (["--scenario", "boat/paper"], "there is no plant 'boat'"),
        (["--scenario", "pitch/paper", "heaters/cold"], "the plant is pitch; heaters/cold is another plant's"),
        (["--sweep", "pitch/gains"], "there is no sweep 'pitch/gains'; pitch has: pitch/pilot-delay, "),
        (["--sweep", "heaters/houses"], "the plant is pitch; heaters/houses is another plant's"),
        (["--run", "nowhere"], "nowhere is not a run folder"),
        (["--run", "heated/seed-0", "."], ". is not a run folder"),
        (["pitch", "--run", "heated"], "heated is a run on heaters; the comparison is on pitch"),
        (["--run", "heated", "--scenario", "pitch/paper"], "the plant is heaters; pitch/paper is another"),
        (["--family-seed", "-1"], "--family-seed is -1; it must lie in [0, 2^32)"),
        (["--out", "."], ". exists; choose another --out"),
        (
            ["--sweep", "--scenario", "pitch/paper", "--out", "lead.py/out"],
            "the folder lead.py/out can't be made: Not a ",
        ),
        (["heaters", "--run", "heated"], "heated/seed-0 has no checkpoint yet"),
        (["--policy", "own.py:NoPlant"], "own.py:NoPlant can't be made: TypeError: NoPlant() takes no arguments"),
        (
            ["--policy", "none", "own.py:Broken", "--scenario", "pitch/steps", "--sweep", "--out", "out"],
            "own.py:Broken failed on pitch/steps: RuntimeError: out of ideas",
        ),
    ],
)
def test_bad_input_is_one_message_and_status_2(arguments, text, capsys, place):
    before = sorted(place.rglob("*"))
    with pytest.raises(SystemExit) as end:
        compare.main(arguments)
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"error: {text}")
    assert len(captured.err.splitlines()) == 1
    assert captured.out.startswith("comparing\n") if "failed on" in text else captured.out == ""
    assert [path for path in sorted(place.rglob("*")) if path.name != "__pycache__" and path.suffix != ".pyc"] == before


OWN = """
class NoPlant:
    host = True

class Broken:
    host = True
    def __init__(self, plant):
        pass
    def init(self, params, r0, y0):
        return ()
    def act(self, params, carry, r, y, key=None):
        raise RuntimeError("out of ideas")
"""


def test_bad_input_leaves_no_traceback(tmp_path):
    done = command("--policy", f"{LEAD}:Lag", cwd=tmp_path, cache=tmp_path / "cache")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: {LEAD} has no 'Lag'\n"
    assert list(tmp_path.iterdir()) == []


def test_everything_is_the_default(place, monkeypatch):
    selected = comparison.select()
    assert (selected.plant, selected.out) == ("pitch", Path("runs/compare-pitch"))
    assert [c.name for c in selected.entrants] == list(NAMES)
    assert selected.scenarios == tuple(scenarios.catalogue("pitch"))
    assert selected.sweeps == tuple(sweeps.catalogue("pitch"))
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    run = RunFolder.create(small("lag"), Path("lagging"))
    trainer, params = run.trainer
    run.save(0, 1, trainer.start(0, params))
    selected = comparison.select(runs=[run.path], policies=["lead.py:Lead"])
    assert (selected.plant, selected.out) == ("lag", Path("runs/compare-lag"))
    assert [c.name for c in selected.entrants] == ["learned", "lead.py:Lead", *NAMES]


def test_inner_loop_alone_is_always_there_and_no_policy_twice(run):
    selected = comparison.select(policies=["pi", "clairvoyant", "pi"])
    assert [(c.name, c.kind) for c in selected.entrants] == [
        ("none", "baseline"), ("pi", "baseline"), ("clairvoyant", "preview"),
    ]  # fmt: skip
    selected = comparison.select(runs=[run.path], policies=["none"])
    assert [(c.name, c.seed) for c in selected.entrants] == [("learned", 1), ("learned", 0), ("none", None)]
    selected = comparison.select(runs=[run.path / "seed-0"], policies=["none"])
    assert [c.seed for c in selected.entrants] == [0, None]


def test_what_is_named_twice_counts_once_and_files_of_one_name_are_told_apart(run, place):
    Path("other").mkdir()
    shutil.copy(LEAD, "other/lead.py")
    selected = comparison.select(
        runs=[run.path / "seed-0", run.path / "seed-0"],
        policies=["none", "lead.py:Lead", "other/lead.py:Lead", "lead.py:Lead"],
        scenario=["pitch/paper", "paper"],
        sweep=["gain", "pitch/gain"],
    )
    assert [c.name for c in selected.entrants] == ["learned", "lead.py:Lead", "other/lead.py:Lead", "none"]
    assert (selected.scenarios, selected.sweeps) == (("pitch/paper",), ("pitch/gain",))


def test_ctrl_c_ends_it_with_130_and_leaves_nothing(tmp_path):
    """As a terminal sends it, to all processes of the group."""
    with interrupts.heard():
        process = subprocess.Popen(
            [sys.executable, "-m", "jaxouter.compare", *ASKED, "--policy", "pi", "mpc", "--out", "out"],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
    assert process.stdout is not None
    process.stdout.readline()  # the jobs have begun
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=100)
    assert (process.returncode, errors) == (130, "")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ([], None),
        (["--sweep"], ()),
        (["--sweep", "pitch/gain", "pitch/pilot-delay"], ("pitch/gain", "pitch/pilot-delay")),
    ],
)
def test_sweep_without_a_name_is_no_sweep(arguments, wanted):
    options = tyro.cli(compare.Options, args=arguments)
    assert options.sweep == wanted
    assert comparison.select(sweep=options.sweep).sweeps == (
        tuple(sweeps.catalogue("pitch")) if wanted is None else wanted
    )


def test_list_names_sweeps_and_all_policies(capsys):
    compare.main(["--list"])
    out = " ".join(capsys.readouterr().out.split())
    for name in ("pitch", "heaters"):
        assert ", ".join(sweeps.catalogue(name)) in out
        assert ", ".join(scenarios.catalogue(name)) in out
    assert ", ".join(NAMES) in out


def test_help_names_every_option(capsys):
    with pytest.raises(SystemExit) as end:
        compare.main(["--help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    for option in ("--run", "--policy", "--scenario", "--sweep", "--family-seed", "--out", "--list", "FILE.py:CLASS"):
        assert option in out


@pytest.mark.slow
def test_evaluate_takes_a_baseline_that_is_tuned(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    maes = {}
    for name in ("static", "pi"):
        path = tmp_path / f"{name}.json"
        evaluate.main(["--policy", name, "--scenario", "lag/steps", "--json", str(path)])
        assert f"policy {name}" in capsys.readouterr().out
        content = json.loads(path.read_text())
        assert content["policy"] == name
        maes[name] = content["scenarios"]["lag/steps"]["mae"]
    assert maes["pi"] < maes["static"]
