"""Identification from r~ and y alone."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from jaxouter.loop import identify
from jaxouter.plants import make
from tests import lag

KEY = jax.random.key(0)


def test_dc_gain_of_pitch_is_a_third_without_offset() -> None:
    gain, offset = identify.dc_gain(*make("pitch"), KEY)
    assert float(gain) == pytest.approx(1 / 3, rel=0.01)
    assert float(offset) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("K", [0.5, -2.0])
def test_dc_gain_of_a_lag_is_exact(K: float) -> None:
    gain, offset = identify.dc_gain(*lag.make(K=K, T=0.2), KEY)
    assert float(gain) == pytest.approx(K, rel=1e-5)
    assert float(offset) == pytest.approx(0.0, abs=1e-5)


def test_offset_is_found() -> None:
    plant, params = lag.make(K=0.5, T=0.2)
    raised = dataclasses.replace(plant, output=lambda params, state: state.y + 3.0)
    gain, offset = identify.dc_gain(raised, params, KEY)
    assert float(gain) == pytest.approx(0.5, rel=1e-5)
    assert float(offset) == pytest.approx(3.0, rel=1e-5)


def test_static_prefilter_inverts_the_identified_line() -> None:
    actor, params = identify.static(*lag.make(K=0.5, T=0.2), KEY)
    r = jnp.asarray(0.7, float)
    _, r_tilde = actor.act(params, actor.init(params, r, r), r, r)
    assert float(r_tilde) == pytest.approx(1.4, rel=1e-4)
    assert actor.r_tilde_bounds == (-4.0, 4.0)


def test_offset_is_taken_off_by_the_static_prefilter(monkeypatch: pytest.MonkeyPatch) -> None:
    found = identify.DcGain(jnp.asarray(0.5, float), jnp.asarray(-3.0, float))

    def line(*_: Any) -> identify.DcGain:
        return found

    monkeypatch.setattr(identify, "dc_gain", line)
    actor, params = identify.static(*make("heaters"), KEY)
    r = jnp.asarray(10.0, float)
    assert float(actor.act(params, (), r, r)[1]) == pytest.approx(26.0)


@pytest.mark.parametrize("K", [0.0, float("nan")])
def test_plant_that_does_not_answer_is_refused(K: float) -> None:
    with pytest.raises(ValueError, match=r"DC gain of lag.*no r~ in \(-4.0, 4.0\)"):
        identify.dc_gain(*lag.make(K=K), KEY)
