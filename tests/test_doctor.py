"""What the doctor finds: all well here, and each thing that may be wrong, with its cure."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from jaxouter import doctor, versions
from jaxouter.evaluation import cache
from jaxouter.exports import c


def diagnosis(capsys) -> tuple[int, str]:
    """Exit status, and what is printed."""
    status = 0
    try:
        doctor.main([])
    except SystemExit as end:
        status = int(end.code or 0)
    return status, capsys.readouterr().out


def test_where_all_is_well_a_screen_says_so(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "not" / "made" / "yet")
    status, out = diagnosis(capsys)
    assert status == 0
    assert "WRONG" not in out
    assert len(out.splitlines()) <= 24
    for text in ("jaxouter ", "jaxlib ", "(cpu)", "computes rightly", "GB free", "gymnasium ", "fmpy "):
        assert text in out
    assert not (tmp_path / "not").exists()


@pytest.mark.parametrize("broken", ["version", "arithmetic", "disk"])
def test_what_is_wrong_is_said_with_its_cure_and_status_1(broken, capsys, monkeypatch):
    if broken == "version":
        monkeypatch.setattr(doctor, "version", lambda name: "0.10.2")
        cure = f"jaxlib 0.10.2 {versions.FAULTS['0.10.2']}: {versions.CURE}"
    elif broken == "arithmetic":
        monkeypatch.setattr(np, "allclose", lambda *_, **__: False)
        cure = f"computes wrongly here: {versions.CURE}"
    else:
        monkeypatch.setattr(doctor, "FREE", float("inf"))
        cure = "free some space"
    status, out = diagnosis(capsys)
    assert status == 1
    lines = out.splitlines()
    assert any(before.startswith("WRONG") and cure in after for before, after in pairwise(lines))


def test_what_is_optional_and_missing_is_no_error(capsys, monkeypatch):
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(c, "COMPILERS", ())
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setenv("JAX_DEBUG_NANS", "1")
    monkeypatch.setattr(cache, "folder", lambda: None)
    status, out = diagnosis(capsys)
    assert status == 0
    for text in (
        "-      no onnx, for export --format onnx\n       -> ",
        "pip install 'jaxouter[onnx]'",
        "no C compiler",
        "-      no cache folder: nothing that is compiled or tuned is kept\n       -> set XDG_CACHE_HOME",
        "there is an NVIDIA GPU that JAX does not use: python -m pip install 'jax[cuda13]==",
        "unset JAX_DEBUG_NANS",
    ):
        assert text in out


def test_a_folder_is_looked_at_where_it_is_or_would_be(tmp_path):
    assert doctor.folder("folder", tmp_path / "new", "none").cure == ""
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    found = doctor.folder("folder", tmp_path / "file" / "below", "choose another")
    assert (found.what.endswith("can't be written (Not a directory)"), found.cure) == (True, "choose another")
    assert Path(doctor.folder("folder", tmp_path, "none").what.split()[1].rstrip(",")) == tmp_path
