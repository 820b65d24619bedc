"""What the tests of several baselines share."""

from dataclasses import replace

import jax.numpy as jnp
import pytest

from jaxouter import plants
from jaxouter.evaluation import scenarios
from tests import lag


@pytest.fixture(scope="package", autouse=True)
def known():
    """The plants of these tests have presets, as registered ones do."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("lag", "kind"):
            patch.setitem(plants.REGISTRY, name, lag.make)
        yield


@pytest.fixture(scope="module")
def steps():
    """Set-points of either sign, near and far, from rest."""
    scenario = scenarios.get("lag/steps", 8)
    far = jnp.array([-1.0, -0.5, -0.2, -0.1, 0.1, 0.3, 0.6, 1.0])
    return replace(scenario, r=jnp.broadcast_to(far[:, None], scenario.r.shape))
