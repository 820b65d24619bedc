import json
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.training import checkpoint
from jaxouter.training.run import KEEP, Run
from jaxouter.training.train import train
from tests.training.small import small


def new_run(path: Path, **changes) -> Run:
    return Run.create(small(**changes), path)


def rows_without_times(run: Run, seed: int):
    return [
        {key: value for key, value in row.items() if "second" not in key}  # wall time and rates
        for row in run.rows(seed)
    ]


def test_stop_save_and_go_on_equals_an_uninterrupted_run(tmp_path):
    whole, halved = new_run(tmp_path / "whole", seeds=2), new_run(tmp_path / "halved", seeds=2)
    finals = train(whole)
    assert finals is not None
    asked = iter([False, False, True])  # seed 0 has one epoch more than seed 1 then
    assert train(halved, stop=lambda: next(asked)) is None
    again = Run.open(halved.path)
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
    run.append(0, {"epoch": 2})  # as after a kill between row and checkpoint
    assert train(run) is not None
    assert [row["epoch"] for row in run.rows(0)] == [1, 2, 3]


def test_seeds_go_on_together_from_the_newest_epoch_that_all_have(tmp_path):
    run = new_run(tmp_path / "run", seeds=3)
    for seed, epochs in ((0, (1, 2)), (1, (1, 2)), (2, (1,))):
        for epoch in epochs:
            (run.seed_folder(seed) / f"checkpoint-{epoch:06d}.npz").touch()
    assert run.common_epoch() == 1
    run.forget(0, 1)
    assert list(run.checkpoints(0)) == [1]
    (run.seed_folder(2) / "checkpoint-000001.npz").unlink()
    with pytest.raises(
        ValueError, match=r"no checkpoint of the same epoch \(seed 0: \[1\]; seed 1: \[1, 2\]; seed 2: none"
    ):
        run.common_epoch()


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
    names = [str(Run.create(small(), None).path) for _ in range(3)]
    assert names == ["runs/heaters-default-0", "runs/heaters-default-0-2", "runs/heaters-default-0-3"]


def test_given_folder_must_not_exist(tmp_path):
    with pytest.raises(ValueError, match="exists; choose another --out"):
        new_run(tmp_path)


def test_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a run folder"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"format": 99}))
    with pytest.raises(ValueError, match="not of format 1"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"format": 1, "config": {"plant": "pitch"}}))
    with pytest.raises(ValueError, match="is not a configuration"):
        Run.open(tmp_path)


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


def test_checkpoint_holds_no_pickle(tmp_path):
    checkpoint.save(tmp_path / "c.npz", tree())
    with np.load(tmp_path / "c.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text"])
def test_damaged_checkpoint_is_named(tmp_path, damage):
    path = tmp_path / "c.npz"
    checkpoint.save(path, tree())
    content = bytearray(path.read_bytes())
    middle = content.index(np.arange(3.0, dtype=np.float32).tobytes())
    content[middle] ^= 1
    path.write_bytes({"truncated": content[:200], "flipped": content, "empty": b"", "text": b"hello"}[damage])
    with pytest.raises(ValueError, match=r"c\.npz is not a readable checkpoint"):
        checkpoint.load(path, tree())


def test_checkpoint_of_another_configuration_is_refused(tmp_path):
    checkpoint.save(tmp_path / "c.npz", tree())
    with pytest.raises(ValueError, match="another configuration"):
        checkpoint.load(tmp_path / "c.npz", {"a": jnp.zeros(3)})
    with pytest.raises(ValueError, match=r"float32\(3,\), expected float32\(4,\)"):
        checkpoint.load(tmp_path / "c.npz", tree() | {"a": jnp.zeros(4)})
