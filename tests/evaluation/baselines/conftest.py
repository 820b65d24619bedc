"""What the tests of several baselines share."""

from dataclasses import replace

import jax.numpy as jnp
import pytest

from jaxouter import plants
from jaxouter.evaluation import scenarios
from tests import lag


@pytest.fixture(scope="module")
def steps():
    """Set-points of either sign, near and far, from rest."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(plants.REGISTRY, "lag", lag.make)
        scenario = scenarios.get("lag/steps", 8)
    far = jnp.array([-1.0, -0.5, -0.2, -0.1, 0.1, 0.3, 0.6, 1.0])
    return replace(scenario, r=jnp.broadcast_to(far[:, None], scenario.r.shape))
