"""The control spec as numbers against the learned policy."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.exports.spec import ControllerSpec
from jaxouter.training.trainer import build
from tests.training.small import small


def learned(plant):
    """A policy with a random actor that uses its whole range, and its spec."""
    trainer, params = build(small(plant))
    found = trainer.policy_params(trainer.fresh(jax.random.key(3), params))
    actor = jax.tree.map(lambda leaf: 3.0 * leaf, found.actor)
    found = found._replace(actor=actor)
    return trainer.policy, found, ControllerSpec.of(trainer.policy, found, trainer.env.plant)


def chosen(policy, params, r, y):
    """r~ of the policy for these r and y, one by one."""
    carry, act, seen = policy.init(params, *jnp.asarray([r[0], y[0]], float)), jax.jit(policy.act), []
    for r_k, y_k in jnp.asarray([r, y], float).T:
        carry, r_tilde = act(params, carry, r_k, y_k)
        seen.append(float(r_tilde))
    return np.array(seen)


@pytest.mark.parametrize("plant", ["pitch", "heaters"])
def test_it_acts_like_the_policy_in_closed_loop(plant):
    policy, params, spec = learned(plant)
    low, high = spec.r_tilde_bounds
    r, y = np.random.default_rng(0).uniform(*spec.setpoint_range, (2, 200))
    state, got = spec.init(y[0]), []
    for r_k, y_k in zip(r, y, strict=True):
        state, r_tilde = spec.act(state, r_k, y_k)
        got.append(float(r_tilde))
    assert np.ptp(got) > 0.01 * (high - low)
    np.testing.assert_allclose(got, chosen(policy, params, r, y), atol=1e-5 * (high - low))


def test_a_file_holds_it_all(tmp_path):
    *_, spec = learned("pitch")
    spec.save(tmp_path / "controller.npz")
    again = ControllerSpec.load(tmp_path / "controller.npz")
    for name, value in vars(spec).items():
        np.testing.assert_equal(getattr(again, name), value)
    assert [w.dtype for w in again.weights] == [np.float32] * len(spec.weights)


def test_what_is_no_controller_is_refused(tmp_path):
    path = tmp_path / "controller.npz"
    with pytest.raises(ValueError, match=r"controller\.npz is not a controller exported as npz"):
        ControllerSpec.load(path)
    *_, spec = learned("pitch")
    spec.save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="not a controller"):
        ControllerSpec.load(path)
    with pytest.raises(ValueError, match="the layers have shapes"):
        dataclasses.replace(spec, weights=spec.weights[:1])


def test_it_needs_no_jax():
    code = "import sys, jaxouter.exports.spec; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
