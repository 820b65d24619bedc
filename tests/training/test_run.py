import errno
import json
import math
import os
import stat
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.training import checkpoint, resources
from jaxouter.training.epochs import NotFiniteError, Pace, train
from jaxouter.training.run import KEEP, RunFolder, RunWarning, lock
from tests.precision import FLOAT, makes_nan
from tests.training.small import small


def new_run(path: Path, **changes) -> RunFolder:
    return RunFolder.create(small(**changes), path)


def rows_without_times(run: RunFolder, seed: int):
    return [
        {key: value for key, value in row.items() if "second" not in key}  # wall time and rates
        for row in run.rows(seed)
    ]


def test_stop_save_and_go_on_equals_an_uninterrupted_run(tmp_path):
    whole, halved = new_run(tmp_path / "whole", seeds=2), new_run(tmp_path / "halved", seeds=2)
    finals = train(whole)
    assert finals is not None
    asked = iter([False, True])
    assert train(halved, stop=lambda: next(asked)) is None
    again = RunFolder.open(halved.path)
    resumed = train(again)
    chex.assert_trees_all_equal(finals, resumed)
    assert whole.fleet.prefill._cache_size() == again.fleet.prefill._cache_size() == 1
    assert whole.fleet.epoch._cache_size() == again.fleet.epoch._cache_size() == 2  # of two lengths, whatever the seed
    for seed in (0, 1):
        assert rows_without_times(whole, seed) == rows_without_times(again, seed)
        assert [row["epoch"] for row in whole.rows(seed)] == [1, 2, 3]
        assert whole.rows(seed)[-1]["steps"] == 3_040


def test_rows_of_an_epoch_that_was_not_saved_are_dropped_on_resumption(tmp_path):
    run = new_run(tmp_path / "run")
    train(run, stop=lambda: True)
    run.append(0, {"epoch": 2, "steps": 2_560, "seconds": 1.0})  # as after a kill between row and checkpoint
    assert train(run) is not None
    assert [row["epoch"] for row in run.rows(0)] == [1, 2, 3]


def test_a_row_that_was_not_written_to_its_end_is_none(tmp_path):
    run = new_run(tmp_path / "run")
    train(run, stop=lambda: True)
    path = run.seed_folder(0) / "metrics.jsonl"
    whole = path.read_text()
    path.write_text(whole + whole[: len(whole) // 2])
    assert len(run.rows(0)) == 1
    run.forget(0, 1)
    assert path.read_text() == whole
    path.write_text("{\n" + whole)
    with pytest.raises(ValueError, match=r"metrics\.jsonl is damaged"):
        run.rows(0)


def keep(run: RunFolder, *epochs: int) -> None:
    """Checkpoints of each seed after so many epochs; for seed 0 first."""
    for seed, of_seed in zip(run.seeds, epochs, strict=True):
        for epoch in of_seed:
            checkpoint.save(run.seed_folder(seed) / f"checkpoint-{epoch:06d}.npz", tree(), epoch=epoch)


def test_seeds_go_on_together_from_the_newest_epoch_that_all_have(tmp_path):
    run = new_run(tmp_path / "run", seeds=3)
    keep(run, (1, 2), (1, 2), (1,))
    assert run.common_epoch() == 1
    run.forget(0, 1)
    assert list(run.checkpoints(0)) == [1]
    (run.seed_folder(2) / "checkpoint-000001.npz").unlink()
    with pytest.raises(
        ValueError, match=r"no whole checkpoint of the same epoch \(seed 0: \[1\]; seed 1: \[1, 2\]; seed 2: none"
    ):
        run.common_epoch()


DAMAGE = {
    "truncated": lambda content: content[: len(content) // 2],
    "flipped": lambda content: content[:5000] + bytes([content[5000] ^ 1]) + content[5001:],
    "empty": lambda content: b"",
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_it_used(tmp_path, damage):
    whole, damaged = new_run(tmp_path / "whole"), new_run(tmp_path / "damaged")
    finals = train(whole)
    train(damaged, stop=iter([False, True]).__next__)
    path = damaged.seed_folder(0) / "checkpoint-000002.npz"
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    with pytest.warns(RunWarning, match=r"checkpoint-000002\.npz is not a readable checkpoint"):
        assert damaged.load(0)[1] == 1
    with pytest.warns(RunWarning, match=r"checkpoint-000002\.npz is not a readable checkpoint"):
        resumed = train(RunFolder.open(damaged.path))
    chex.assert_trees_all_equal(finals, resumed)
    assert rows_without_times(whole, 0) == rows_without_times(damaged, 0)


def test_where_every_checkpoint_is_damaged_nothing_starts_over_by_itself(tmp_path):
    run = new_run(tmp_path / "run")
    train(run)
    for path in run.checkpoints(0).values():
        path.write_bytes(b"")
    with pytest.warns(RunWarning), pytest.raises(ValueError, match="no whole checkpoint"):
        train(run)
    assert len(run.checkpoints(0)) == KEEP


@makes_nan
def test_parameters_that_are_not_finite_end_the_run_and_are_not_saved(tmp_path):
    run = new_run(tmp_path / "run")
    train(run, stop=lambda: True)
    state, _ = run.load(0)
    critics = jax.tree.map(lambda leaf: leaf.at[0].set(jnp.nan), state.agent.critics)
    run.save(0, 1, state._replace(agent=state.agent._replace(critics=critics)))
    with pytest.raises(NotFiniteError, match="seed 0, epoch 2: critics is not finite any more"):
        train(run)
    assert list(run.checkpoints(0)) == [1]
    assert [row["epoch"] for row in run.rows(0)] == [1]


def test_saving_takes_no_more_than_its_share(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    pace, saved = Pace(), []

    def save():
        now[0] += 0.1
        saved.append(now[0])

    while now[0] < 100.0:
        now[0] += 0.7
        if pace.due():
            pace.do(save)
    assert len(saved) == pytest.approx(100 / (0.1 / Pace.SHARE), abs=3)
    assert 0.1 * len(saved) / now[0] < 1.05 * Pace.SHARE


def test_a_folder_is_trained_by_one_process_at_a_time(tmp_path):
    run = new_run(tmp_path / "run")
    refused = pytest.raises(ValueError, match=rf"is in use by process {os.getpid()}")
    with lock(run.path), refused, lock(RunFolder.open(run.path).path):
        pass
    with lock(run.path):
        pass


def test_a_folder_that_cannot_be_locked_or_made_is_refused(tmp_path):
    run = new_run(tmp_path / "run")
    (run.path / "lock").mkdir()
    with pytest.raises(ValueError, match="can't be locked: Is a directory"), lock(run.path):
        pass
    with pytest.raises(ValueError, match="can't be made: File name too long"):
        new_run(tmp_path / ("x" * 300))


def test_a_file_system_that_does_not_sync_folders_will_do(tmp_path, monkeypatch):
    fsync = os.fsync

    def of_files_alone(number: int) -> None:
        if stat.S_ISDIR(os.fstat(number).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(number)

    monkeypatch.setattr(os, "fsync", of_files_alone)
    checkpoint.write(tmp_path / "file", b"content")
    assert (tmp_path / "file").read_bytes() == b"content"


def test_memory_of_the_machine_is_unlimited_where_nothing_tells_it(monkeypatch):
    assert 0 < resources._there() < 1e16
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(Path, "read_text", lambda *_: "max")
    assert resources._there() == math.inf


@pytest.mark.parametrize("content", ["{}", "[" * 100_000, '{"median_seed": 7}'])
def test_a_summary_that_is_damaged_is_named(tmp_path, content):
    run = new_run(tmp_path / "run")
    (run.path / "summary.json").write_text(content)
    with pytest.raises(ValueError, match=r"summary\.json is damaged"):
        run.median_seed()
    (run.path / "config.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="is not a run folder"):
        RunFolder.open(run.path)


def test_what_changed_since_the_run_was_made_is_listed(tmp_path):
    run = new_run(tmp_path / "run")
    assert run.changes() == []
    content = json.loads((run.path / "config.json").read_text())
    content["versions"]["jax"] = "0.1.0"
    del content["flags"]["XLA_FLAGS"]
    (run.path / "config.json").write_text(json.dumps(content))
    assert set(run.changes()) == {
        f"jax was 0.1.0 and is {jax.__version__}",
        f"XLA_FLAGS was None and is {os.environ.get('XLA_FLAGS', '')}",
    }


def test_each_epoch_is_reported_with_what_on_epoch_gave(tmp_path):
    run, reported = new_run(tmp_path / "run"), []
    train(
        run,
        lambda trainer, state: {"mae": float(state.steps)},
        lambda seed, row: reported.append((seed, row)),
    )
    assert [(seed, row["epoch"], row["mae"]) for seed, row in reported] == [(0, 1, 1600), (0, 2, 2560), (0, 3, 3040)]
    assert [row["updates"] for _, row in reported] == [120, 240, 300]


def test_old_checkpoints_are_removed(tmp_path):
    run = new_run(tmp_path / "run")
    train(run)
    assert len(run.checkpoints(0)) == KEEP
    assert run.load(0)[1] == 3


def test_default_folder_gets_a_number_where_it_exists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [str(RunFolder.create(small(), None).path) for _ in range(3)]
    assert names == ["runs/heaters-record-0", "runs/heaters-record-0-2", "runs/heaters-record-0-3"]


def test_given_folder_must_not_exist(tmp_path):
    with pytest.raises(ValueError, match="exists; choose another --out"):
        new_run(tmp_path)


def test_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a run folder"):
        RunFolder.open(tmp_path)
    for content, text in (
        ({"format": 99}, "of format 99, and this version reads format 4: another version of jaxouter made it"),
        ({"format": 3, "versions": {"jaxouter": "0.2.0"}}, r"of format 3, .*: jaxouter 0\.2\.0 made it, and reads it"),
        ({"format": 4, "config": {"plant": "pitch"}}, "is not a configuration"),
    ):
        (tmp_path / "config.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match=text):
            RunFolder.open(tmp_path)


def test_config_json_says_what_the_result_depends_on(tmp_path):
    run = new_run(tmp_path / "run")
    content = json.loads((run.path / "config.json").read_text())
    assert content["versions"]["jax"] == jax.__version__
    assert content["device"]["count"] == jax.device_count()
    assert set(content) == {"format", "config", "versions", "device", "flags"}


def tree():
    return {"a": jnp.arange(3.0), "key": jax.random.key(7), "b": (jnp.ones((2, 2), jnp.int32),)}


def test_checkpoint_round_trip_keeps_values_types_and_keys(tmp_path):
    checkpoint.save(tmp_path / "c.npz", tree(), epoch=4)
    loaded, header = checkpoint.load(tmp_path / "c.npz", jax.eval_shape(tree))
    chex.assert_trees_all_equal(loaded, tree())
    chex.assert_trees_all_equal_dtypes(loaded["b"], tree()["b"])
    assert header["epoch"] == 4
    assert float(jax.random.normal(loaded["key"])) == float(jax.random.normal(jax.random.key(7)))
    assert list(tmp_path.iterdir()) == [tmp_path / "c.npz"]


def test_a_checkpoint_without_its_checksum_is_refused(tmp_path):
    path = tmp_path / "c.npz"
    checkpoint.save(path, tree())
    path.write_bytes(path.read_bytes()[: -len(checkpoint.MARK) - 32])
    with pytest.raises(ValueError, match="has no checksum"):
        checkpoint.load(path, tree())


def test_checkpoint_holds_no_pickle(tmp_path):
    checkpoint.save(tmp_path / "c.npz", tree())
    with np.load(tmp_path / "c.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text"])
def test_damaged_checkpoint_is_named(tmp_path, damage):
    path = tmp_path / "c.npz"
    checkpoint.save(path, tree())
    content = bytearray(path.read_bytes())
    middle = content.index(np.arange(3.0, dtype=FLOAT).tobytes())
    content[middle] ^= 1
    path.write_bytes({"truncated": content[:200], "flipped": content, "empty": b"", "text": b"hello"}[damage])
    with pytest.raises(ValueError, match=r"c\.npz is not a readable checkpoint"):
        checkpoint.load(path, tree())


def test_a_change_that_the_zip_file_itself_does_not_notice_is_found(tmp_path):
    path = tmp_path / "c.npz"
    checkpoint.save(path, tree())
    content = bytearray(path.read_bytes())
    content[10] ^= 1  # of the time at which the first array was written
    path.write_bytes(content)
    np.load(path)["header"]
    with pytest.raises(ValueError, match="its checksum differs"):
        checkpoint.load(path, tree())


def test_checkpoint_of_another_configuration_is_refused(tmp_path):
    checkpoint.save(tmp_path / "c.npz", tree())
    with pytest.raises(ValueError, match="another configuration"):
        checkpoint.load(tmp_path / "c.npz", {"a": jnp.zeros(3)})
    with pytest.raises(ValueError, match=rf"{FLOAT}\(3,\), expected {FLOAT}\(4,\)"):
        checkpoint.load(tmp_path / "c.npz", tree() | {"a": jnp.zeros(4)})
