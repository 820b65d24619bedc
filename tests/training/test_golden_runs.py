"""Run folders that an earlier version made are still read: those of tests/runs, which scripts/golden_runs.py makes."""

import json
import re
import shutil
import warnings

import pytest

import jaxouter
from jaxouter.training.run import FORMAT, RunFolder
from tests.load import load
from tests.precision import X64

golden = load("scripts", "golden_runs")
RUNS = [golden.path(*name) for name in golden.names()]
NAMES = [folder.name for folder in RUNS]
MOST = 2_000_000  # bytes of all
single = pytest.mark.skipif(X64, reason="a checkpoint is read in the precision in which it was made")


@single
@pytest.mark.parametrize("folder", RUNS, ids=NAMES)
def test_a_golden_run_loads_and_its_policy_does_what_it_did(folder):
    run = jaxouter.load(folder)
    assert f"{run.config.plant}-{run.config.preset}" == folder.name
    assert run.summary is not None
    assert run.summary.results[0].policy == "learned"
    assert run.metrics[-1]["epoch"] == run.config.epochs
    assert golden.deviation(run) <= golden.TOLERANCE


@single
@pytest.mark.parametrize("folder", RUNS, ids=NAMES)
def test_it_is_exported(folder, tmp_path):
    told = jaxouter.load(folder).export(tmp_path / "controller.npz", force=True, progress=False)
    assert told.startswith("verified: ")


@single
@pytest.mark.slow
def test_a_finished_run_is_evaluated_again_and_a_stopped_one_goes_on(tmp_path):
    folder = shutil.copytree(golden.path("pitch", "paper"), tmp_path / "run")
    run = RunFolder.open(folder)
    newest, rows = run.checkpoints(0)[run.config.epochs], run.rows(0)
    whole, summary = newest.read_bytes(), json.loads((folder / "summary.json").read_text())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # versions and flags are others
        again = jaxouter.resume(jaxouter.load(folder), progress=False, episodes=1)
        assert (newest.read_bytes(), run.rows(0)) == (whole, rows)
        assert again.summary is not None
        figures = again.summary.results[0].scenarios["pitch/paper"]
        assert figures.mae == pytest.approx(summary["results"][0]["scenarios"]["pitch/paper"]["mae"], rel=1e-3)
        newest.unlink()
        jaxouter.resume(jaxouter.load(folder), progress=False, episodes=1)
    assert [row["epoch"] for row in run.rows(0)] == [row["epoch"] for row in rows]
    assert newest.exists()


def test_a_run_of_another_format_names_the_version_that_made_it(tmp_path):
    folder = shutil.copytree(RUNS[0], tmp_path / "run")
    content = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(content | {"format": FORMAT + 1}))
    made = re.escape(content["versions"]["jaxouter"])
    text = rf"is of format {FORMAT + 1}, and this version reads format {FORMAT}: jaxouter {made} made it, and reads it"
    with pytest.raises(ValueError, match=text):
        jaxouter.load(folder)


def test_they_are_small_and_name_no_place():
    files = [file for folder in RUNS for file in folder.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) <= MOST
    assert {file.suffix for file in files} == {".json", ".jsonl", ".npz"}
    for file in files:
        if file.suffix != ".npz":
            assert not re.search(r'"/|[A-Z]:\\', file.read_text())
