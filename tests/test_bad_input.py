"""Whatever the input: a result, or one clear message and status 2; no traceback, no hang, no changed file."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import hashlib
import io
import json
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from jaxouter import evaluate, train
from jaxouter.loop import references
from jaxouter.training import checkpoint
from jaxouter.training.config import TrainConfig, from_dict, preset, to_dict
from jaxouter.training.resources import resources
from jaxouter.training.run import RunFolder
from tests.training.small import small

some = settings(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
few = settings(some, max_examples=25)
numbers = st.one_of(st.integers(), st.floats(), st.integers(-2, 3), st.sampled_from([1e30, -1e30, 2**40, 10**9]))
values = st.recursive(
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=8)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=5,
)
PATHS = [
    *((name,) for name in to_dict(small()) if name not in ("agent", "pretraining")),
    *((group, name) for group in ("agent", "pretraining") for name in to_dict(small())[group]),
    ("agent",), ("pretraining",), ("unknown",), ("agent", "unknown"),
]  # fmt: skip


def outcome(values_of_config: dict) -> TrainConfig | str:
    """The configuration, checked as the command checks it, or what is wrong."""
    try:
        config = from_dict(values_of_config).check()
        resources(config).check()
        return config
    except ValueError as error:
        return str(error)


@some
@given(path=st.sampled_from(PATHS), value=values)
def test_a_configuration_with_any_value_is_one_or_refused(path, value):
    content = json.loads(json.dumps(to_dict(small())))
    inner = content
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    found = outcome(content)
    assert found if isinstance(found, str) else from_dict(json.loads(json.dumps(to_dict(found)))) == found


@pytest.mark.parametrize("path", [path for path in PATHS if path[-1] != "unknown"])
def test_a_configuration_of_another_type_is_refused_by_name(path):
    content = to_dict(small())
    inner = content
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = object()
    assert path[-1] in str(outcome(content)) or "got `object`" in str(outcome(content))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"steps": 10**15}, "steps is 1000000000000000; it must be a number between"),
        ({"reward_scale": np.nan}, "reward_scale is nan"),
        ({"seeds": 10**8}, "this run needs about"),
        (
            {"environments": 10**9, "steps": 10**9, "agent.prefill": 10**9, "epoch": 10**9},
            "agent.prefill is 1000000000",
        ),
        ({"environments": 10**8, "steps": 2 * 10**9, "agent.prefill": 10**9, "epoch": 10**9}, "this run needs about"),
    ],
)
def test_numbers_beyond_any_use_are_refused(changes, text):
    content = to_dict(small())
    for name, value in changes.items():
        group, _, field = name.rpartition(".")
        (content[group] if group else content)[field] = value
    assert text in str(outcome(content))


OPTIONS = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(TrainConfig) if field.name != "plant"]
OPTIONS += [
    "--agent.hidden",
    "--agent.batch-size",
    "--pretraining.lags",
    "--resume",
    "--out",
    "--coordinator",
    "--no",
    "-x",
]
words = st.one_of(
    st.sampled_from(
        [*OPTIONS, "pitch", "heaters", "paper", "robust", "0", "1", "-1", "gain", "0.5", "nan", "inf", "1e9"]
    ),
    numbers.map(str),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=6),
)


def ended(main, arguments: list[str]) -> tuple[int, str]:
    """Status and what was printed to stderr; an exception is the test's failure."""
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            main(arguments)
            status = 0
        except SystemExit as end:
            status = end.code or 0
    assert status in (0, 2)
    return status, errors.getvalue() + out.getvalue()


@few
@given(arguments=st.lists(words, max_size=5))
def test_any_command_line_is_accepted_or_refused(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, text = ended(train.main, [*arguments, "--dry-run"])
    assert text.strip()
    assert "Traceback" not in text
    assert list(tmp_path.iterdir()) == []


@few
@given(arguments=st.lists(words, min_size=1, max_size=4))
def test_any_command_line_of_evaluate_without_a_run_is_refused(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, text = ended(evaluate.main, arguments)
    assert "Traceback" not in text
    assert status == 2 or "--help" in text or "-h" in arguments
    assert list(tmp_path.iterdir()) == []


@some
@given(content=st.one_of(st.binary(max_size=40), values.map(lambda value: json.dumps(value).encode())))
def test_any_config_json_is_a_run_or_refused(content, tmp_path):
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"config\.json"):
        RunFolder.open(tmp_path)


@some
@given(path=st.sampled_from(["format", "config", "versions", "device", "flags"]), value=values)
def test_a_run_folder_with_any_value_is_a_run_or_refused(path, value, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    RunFolder.create(small(), folder)
    content = json.loads((folder / "config.json").read_text()) | {path: value}
    (folder / "config.json").write_text(json.dumps(content))
    with contextlib.suppress(ValueError):
        run = RunFolder.open(folder)
        assert run.config.check()
        assert isinstance(run.changes(), list)


def tree():
    return {"a": jnp.arange(300.0), "key": jax.random.key(7), "b": (jnp.ones((2, 2), jnp.int32),)}


def signed(content: bytes) -> bytes:
    """With a checksum that is right, as anybody can make one."""
    return bytes(content) + checkpoint.MARK + hashlib.sha256(content).digest()


@some
@given(data=st.data(), summed=st.booleans())
def test_a_damaged_checkpoint_is_refused_whatever_the_damage(data, summed, tmp_path):
    """Also one that was signed anew, of which every byte reaches zipfile and NumPy: it may be read, if it is equal."""
    path = tmp_path / "c.npz"
    checkpoint.save(path, tree(), epoch=1)
    content = bytearray(path.read_bytes())[: None if summed else -len(checkpoint.MARK) - 32]
    before = bytes(content)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    damaged = content[: data.draw(st.sampled_from([len(content), len(content) - 1, len(content) // 2]))]
    assume(damaged != before)
    path.write_bytes(damaged if summed else signed(damaged))
    with contextlib.suppress(ValueError):
        loaded, _ = checkpoint.load(path, jax.eval_shape(tree))
        assert not summed
        chex.assert_trees_all_equal(loaded, tree())


@few
@given(
    kind=st.sampled_from(sorted(references.FAMILIES)),
    low=st.floats(-1e4, 1e4),
    width=st.floats(1e-3, 1e4),
    steps=st.integers(1, 200),
    seed=st.integers(0, 2**31 - 1),
)
def test_references_of_any_range_stay_in_it(kind, low, width, steps, seed):
    high = low + width
    r = np.asarray(references.FAMILIES[kind](jax.random.key(seed), steps, low, high))
    slack = 1e-5 * (abs(low) + abs(high) + 1.0)
    assert r.shape == (steps,)
    assert np.all((r >= low - slack) & (r <= high + slack))


class Planted:
    """What a pickle would call."""

    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


def test_a_run_folder_from_someone_else_executes_nothing(tmp_path, monkeypatch):
    """A pickled array among the others, a plant that names code, and a module beside the run."""
    monkeypatch.chdir(tmp_path)
    run = RunFolder.create(small(), tmp_path / "run")
    path = run.seed_folder(0) / "checkpoint-000001.npz"
    header = np.asarray(json.dumps({"format": checkpoint.FORMAT}))
    np.savez(path, header=header, planted=np.array([Planted()], dtype=object))
    path.write_bytes(signed(path.read_bytes()))
    status, text = ended(evaluate.main, ["run"])
    assert status == 2
    assert "is not a readable checkpoint" in text
    (tmp_path / "planted.py").write_text("from pathlib import Path\nPath('executed').touch()\n")
    (run.path / "planted.py").write_text("from pathlib import Path\nPath('executed').touch()\n")
    content = json.loads((run.path / "config.json").read_text())
    for plant in ("planted", "planted:Plant", "planted.py:Plant", "run/planted.py:Plant", "os:system"):
        changed = copy.deepcopy(content)
        changed["config"]["plant"] = plant
        (run.path / "config.json").write_text(json.dumps(changed))
        for main, arguments in ((evaluate.main, ["run"]), (train.main, ["--resume", "run"])):
            status, text = ended(main, arguments)
            assert status == 2
            assert "code is never imported" in text
    assert not (tmp_path / "executed").exists()
    assert preset("pitch").plant == "pitch"
