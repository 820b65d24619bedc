"""Training runs that are killed, run out of disk, or meet another on the same folder, through the real command."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jaxouter.training import checkpoint
from jaxouter.training.epochs import train
from jaxouter.training.run import RunFolder, lock
from tests.load import load
from tests.training.small import small

TMPFS = ["unshare", "--user", "--map-root-user", "--mount"]


def begun(path: Path) -> RunFolder:
    """A run after its first epoch."""
    run = RunFolder.create(small(), path)
    assert train(run, stop=lambda: True) is None
    return run


def ended(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*command], capture_output=True, text=True, timeout=250)


@pytest.mark.slow
@pytest.mark.timeout(1800)  # of which most is waiting where other work shares the cores
def test_three_kills_change_nothing(tmp_path):
    soak = load("scripts", "soak")
    content = soak.soak(soak.Options(kills=3, within=8.0, seeds=1, steps=20_640, out=tmp_path / "soak.json"))
    assert len(content["kills"]) == 3


@pytest.mark.slow
@pytest.mark.parametrize("by", ["file system", "limit"])
def test_a_full_disk_ends_the_run_with_one_line_and_leaves_the_last_checkpoint_whole(tmp_path, by):
    """A file system that holds what there is and half a checkpoint more, or a limit of half a checkpoint a file."""
    run = begun(tmp_path / "run")
    (kept,) = run.checkpoints(0).values()
    before, half = kept.read_bytes(), kept.stat().st_size // 2
    command = [sys.executable, "-m", "jaxouter.train", "--resume"]
    if by == "limit":
        blocks = f"ulimit -f {half // 512}"
        done = ended("sh", "-c", f"{blocks}; exec {' '.join(command)} {run.path}")
    else:
        if shutil.which("unshare") is None or subprocess.run([*TMPFS, "true"], capture_output=True).returncode:
            pytest.skip("no user namespace can be made here")
        used = sum(-(-path.stat().st_size // 4096) * 4096 for path in run.path.rglob("*")) + 16_384
        disk = tmp_path / "disk"
        disk.mkdir()
        lines = [
            f"mount -t tmpfs -o size={used + half} tmpfs {disk}",
            f"cp -r {run.path} {disk}",
            f"{' '.join(command)} {disk}/run; status=$?",
            f"cp {disk}/run/seed-0/* {tmp_path}; exit $status",
        ]
        done = ended(*TMPFS, "sh", "-ec", "\n".join(["set +e", *lines]))
        kept = tmp_path / kept.name
    assert done.returncode == 1, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    assert line.startswith("error: ")
    assert "what was saved before is intact, resume with: python -m jaxouter.train --resume" in line
    assert ("No space left on device" if by == "file system" else "File too large") in line
    assert kept.read_bytes() == before
    assert checkpoint.read(kept)[0]["epoch"] == 1
    assert not list(kept.parent.glob("*.partial"))


def test_a_second_run_into_one_folder_is_refused(tmp_path):
    run = RunFolder.create(small(), tmp_path / "run")
    with lock(run.path):
        files = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
        done = ended(sys.executable, "-m", "jaxouter.train", "--resume", str(run.path))
    assert done.returncode == 2
    assert f"is in use by process {os.getpid()}" in done.stderr
    assert "Traceback" not in done.stderr
    assert files == {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}


def test_half_an_entry_of_the_compilation_cache_is_made_anew_without_a_word(tmp_path):
    """As a kill while it is written leaves it: JAX alone would warn and compile again in each later process."""
    lines = [
        "from jaxouter.evaluation import cache",
        "import jax",
        "cache.use_compilation_cache()",
        'jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)',
        "print(jax.jit(lambda x: 2 * x + 1)(20.5))",
    ]
    command = ["env", f"JAX_COMPILATION_CACHE_DIR={tmp_path}", sys.executable, "-c", "\n".join(lines)]
    assert ended(*command).stdout == "42.0\n"
    entries = list(tmp_path.glob("*-cache"))
    assert entries
    for entry in entries:
        os.truncate(entry, entry.stat().st_size // 2)
    halves = {entry: entry.stat().st_size for entry in entries}
    done = ended(*command)
    assert (done.stdout, done.stderr) == ("42.0\n", "")
    assert all(entry.stat().st_size > half for entry, half in halves.items())
