import errno
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import platformdirs
import pytest

from jaxouter.evaluation import cache
from jaxouter.evaluation.cache import Tuned

KEY = {"budget": 100, "on": "pitch/paper"}
TUNED = Tuned(
    {"kp": 0.1, "order": 3, "rows": [{"radius": None, "note": "at a kink, r̃"}], "finite": True},
    {"a": np.linspace(0, 1, 7, dtype=np.float32).reshape(1, 7), "n": np.array([2, 3])},
    1600,
)


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


class Maker:
    """Gives TUNED, and counts how often."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> Tuned:
        self.calls += 1
        return TUNED


def never() -> Tuned:
    raise AssertionError("it was in the cache")


def files() -> list[Path]:
    return sorted(path for path in cache.folder().rglob("*") if path.is_file())


def assert_equal(found: Tuned, wanted: Tuned) -> None:
    assert found.settings == wanted.settings
    assert found.steps == wanted.steps
    assert found.arrays.keys() == wanted.arrays.keys()
    for name, array in wanted.arrays.items():
        np.testing.assert_array_equal(found.arrays[name], array, strict=True)


def test_made_once_and_read_back_equal():
    make = Maker()
    for _ in range(3):
        assert_equal(cache.cached("pitch-pi", KEY, make), TUNED)
    assert make.calls == 1
    (path,) = files()
    assert path.name.startswith("pitch-pi-")


def test_order_of_the_key_does_not_matter_its_values_and_the_name_do():
    make = Maker()
    cache.cached("pitch-pi", KEY, make)
    cache.cached("pitch-pi", dict(reversed(KEY.items())), never)
    cache.cached("pitch-pi", KEY | {"budget": 101}, make)
    cache.cached("pitch-mpc", KEY, make)
    assert make.calls == len(files()) == 3


def test_folder_is_the_users_own(tmp_path, monkeypatch):
    assert cache.folder() == tmp_path / "jaxouter"
    for unset in (lambda: monkeypatch.setenv("XDG_CACHE_HOME", ""), lambda: monkeypatch.delenv("XDG_CACHE_HOME")):
        unset()
        assert cache.folder() == Path(platformdirs.user_cache_path("jaxouter", appauthor=False))
    if sys.platform == "linux":
        assert cache.folder() == Path.home() / ".cache" / "jaxouter"


@pytest.mark.parametrize("damage", ["empty", "text", "truncated", "flipped", "without header", "pickle"])
def test_damaged_file_is_made_again(damage):
    cache.cached("pitch-pi", KEY, Maker())
    (path,) = files()
    content = path.read_bytes()
    if damage == "without header":
        np.savez(path, a=np.zeros(3))
    elif damage == "pickle":
        np.savez(path, header=np.array([{"settings": {}, "steps": 0}], object))
    else:
        flipped = bytearray(content)
        flipped[content.index(TUNED.arrays["a"].tobytes())] ^= 1
        path.write_bytes({"empty": b"", "text": b"hello", "truncated": content[:-30], "flipped": flipped}[damage])
    again = Maker()
    assert_equal(cache.cached("pitch-pi", KEY, again), TUNED)
    assert again.calls == 1
    assert_equal(cache.cached("pitch-pi", KEY, never), TUNED)
    assert files() == [path]


def test_time_that_it_took_is_kept():
    made = cache.cached("pitch-pi", KEY, lambda: time.sleep(0.05) or TUNED)
    assert made.seconds >= 0.05
    assert cache.cached("pitch-pi", KEY, never).seconds == made.seconds


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        ("a file in its place", "can't be written (Not a directory); nothing that is compiled or tuned is kept"),
        ("no home", "there is no cache folder"),
        ("full", "can't be written (No space left on device); nothing"),
        ("full meanwhile", "can't be written (No space left on device); it is made anew next time"),
    ],
)
def test_without_a_folder_the_result_is_there_all_the_same_and_it_is_said_once(tmp_path, monkeypatch, trouble, words):
    (tmp_path / "file").touch()
    if trouble == "a file in its place":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    elif trouble == "no home":
        monkeypatch.setattr(cache, "folder", lambda: None)
        cache._usable.cache_clear()
    else:
        monkeypatch.setattr(*((tempfile, "TemporaryFile") if trouble == "full" else (np, "savez")), full)
    with pytest.warns(UserWarning, match=re.escape(words)):
        assert_equal(cache.cached("pitch-pi", KEY, Maker()), TUNED)
    if trouble != "full meanwhile":  # which may be over
        assert_equal(cache.cached("pitch-pi", KEY, Maker()), TUNED)
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {"file"}


def test_nothing_is_pickled():
    cache.cached("pitch-pi", KEY, Maker())
    with zipfile.ZipFile(files()[0]) as archive:
        assert sorted(archive.namelist()) == ["a.npy", "header.npy", "n.npy"]
    with np.load(files()[0], allow_pickle=False) as file:
        assert [file[name].dtype.kind for name in sorted(file.files)] == ["f", "U", "i"]
    with pytest.raises(ValueError, match="allow_pickle"):
        cache.cached("pitch-mpc", KEY, lambda: TUNED._replace(arrays={"a": np.array([None])}))


def test_what_could_not_be_made_leaves_nothing():
    with pytest.raises(ZeroDivisionError):
        cache.cached("pitch-pi", KEY, lambda: TUNED._replace(steps=1 // 0))
    assert files() == []


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the package that the code's hash is taken of."""
    copy = tmp_path / "copy"
    shutil.copytree(cache.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(cache, "PACKAGE", copy)
    cache.code.cache_clear()
    yield copy
    cache.code.cache_clear()


def code() -> str:
    cache.code.cache_clear()
    return cache.code()


@pytest.mark.parametrize(
    "source",
    [
        "plants/pitch.py",
        "loop/observation.py",
        "identification/lq.py",
        "tasks/pitch.py",
        "agents/networks.py",
        "training/config.py",
        "evaluation/baselines/pi.py",
        "evaluation/metrics.py",
        "evaluation/rollout.py",
        "evaluation/scenarios.py",
        "evaluation/sweeps.py",
        "evaluation/stability.py",
        "evaluation/jobs.py",
        "evaluation/cache.py",
    ],
)
def test_results_are_made_again_when_the_source_that_they_depend_on_changes(package, source):
    make = Maker()
    cache.cached("pitch-pi", KEY, make)
    (package / source).write_text((package / source).read_text() + "\n")
    cache.code.cache_clear()
    cache.cached("pitch-pi", KEY, make)
    assert make.calls == len([path for path in files() if path.suffix == ".npz"]) == 2


def test_a_new_baseline_changes_the_code_and_the_commands_do_not(package):
    before = code()
    for source in ("compare.py", "evaluation/report.py", "evaluation/figures.py"):
        (package / source).write_text("")
    assert code() == before
    (package / "evaluation" / "baselines" / "new.py").write_text("")
    assert code() != before


def _write_many(which: int) -> list[float]:
    """Ask for the same 40 results as the other process, each with the asker's own number in it."""

    def make() -> Tuned:
        return Tuned({"by": which}, {"by": np.full(200_000, which)}, which)

    found = [cache.cached("pitch-pi", {"number": i}, make) for i in range(40)]
    return [each.settings["by"] for each in found if (each.arrays["by"] == each.settings["by"]).all()]


@pytest.mark.parametrize("threads", [False, True])
def test_two_at_once_leave_whole_files(threads):
    with ThreadPoolExecutor(2) if threads else ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        first, second = pool.map(_write_many, (1, 2))
    assert len(first) == len(second) == 40
    assert len(files()) == 40
    for i, path in enumerate(files()):
        with np.load(path) as file:
            assert np.ptp(file["by"]) == 0, i
