"""Whether what was learned is said to be worse than doing nothing."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.api import Run
from jaxouter.evaluation.verdict import Verdict, _is_worse, judge
from jaxouter.loop.policy import LinearLaw
from jaxouter.loop.policy import affine as linear
from jaxouter.training.policy import LearnedParams
from jaxouter.training.run import RunFolder
from jaxouter.training.trainer import build
from tests import kinds
from tests.training.small import small

PLANT, PARAMS = kinds.late(3)()


def affine(slope: float) -> LinearLaw:
    return linear(slope, 0.0)


SIMPLE = {"none": affine(1.0), "static": affine(2.0)}


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "kind", kinds.late(3))


def judged(**slopes: float) -> Verdict:
    """The verdict on policies by seed whose network does nothing; with a DC gain of 0.5 a slope of 2 is right."""
    policy = build(small("kind"))[0].policy
    idle = jax.tree.map(jnp.zeros_like, jax.eval_shape(policy.init_actor, jax.random.key(0)))
    learned = {int(seed[1:]): LearnedParams(idle, affine(slope)) for seed, slope in slopes.items()}
    return judge(PLANT, PARAMS, jax.random.key(5), policy, learned, SIMPLE)


def test_the_best_is_said_to_be() -> None:
    found = judged(s0=2.0)
    assert found.worse == []
    mae: Any = found.mae
    assert mae["learned"]["0"] == mae["static"] < mae["none"]
    assert found.text.startswith("verdict: on 16 fresh training episodes what was learned is the best; MAE: learned")


def test_what_is_worse_than_doing_nothing_is_named_by_seed() -> None:
    found = judged(s3=2.0, s4=-1.0)
    assert found.worse == [4]
    assert "what was learned by seed 4 is worse than static; MAE: learned" in found.text
    assert "export asks for --force" in found.text
    json.dumps(msgspec.to_builtins(found), allow_nan=False)


def test_where_the_lq_law_has_the_lower_mae_it_is_said_and_nothing_is_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, slope in (("static", 1.5), ("lq", 2.0)):
        monkeypatch.setitem(SIMPLE, name, affine(slope))
    found = judged(s0=1.9)
    assert found.worse == []
    assert "what was learned is better than none and static, but lq has the lower MAE; MAE: learned" in found.text


def test_worse_is_worse_by_however_little() -> None:
    assert _is_worse(1.0 + np.array([0.2, -0.1, 0.0, 0.0]), np.ones(4))
    assert not _is_worse(np.ones(4), np.ones(4))
    assert not _is_worse(np.ones(4), np.full(4, np.inf))


def test_an_episode_counts_as_the_range_of_the_divergence_bounds_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "PLANT", replace(PLANT, divergence_bounds=(-0.1, 0.1)))
    mae: Any = judged(s0=-1e6).mae  # r~ at its bounds
    assert mae["learned"]["0"] == pytest.approx(0.2, abs=1e-6)


def test_what_diverges_is_worse() -> None:
    found = judged(s0=float("nan"))
    assert (found.worse, found.mae["learned"]) == ([0], {"0": None})
    assert "learned diverged" in found.text


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder.create(small("kind"), tmp_path / "run")


def test_export_refuses_what_is_worse_unless_forced(run: RunFolder) -> None:
    summary = run.path / "summary.json"
    path, learned = run.path / "controller.npz", Run(run, 0)
    for older in ({}, {"verdict": {"worse": [], "text": ""}}):
        summary.write_text(json.dumps({"median_seed": 0} | older))
        with pytest.raises(ValueError, match="has no checkpoint yet"):  # what comes after the verdict
            learned.export(path)
    summary.write_text(json.dumps({"median_seed": 0, "verdict": {"worse": [0], "text": "worse than none"}}))
    with pytest.raises(ValueError, match="seed 0: worse than none"):
        learned.export(path)
    with pytest.raises(ValueError, match="has no checkpoint yet"):
        learned.export(path, force=True)
    summary.write_text("{")
    assert run.verdict() == {}
