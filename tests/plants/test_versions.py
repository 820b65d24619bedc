"""JAX computes rightly here, and who has a version known to be wrong is told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.plants import versions
from tests.precision import FLOAT, X64


def test_the_last_row_of_a_large_batch_is_right():
    """Jax issue 39103: jaxlib 0.10.2 got it wrong on a CPU from so many rows on."""
    rows, size = 16_385 if X64 else 32_769, 3
    rng = np.random.default_rng(0)
    M, x = rng.standard_normal((size, size)).astype(FLOAT), rng.standard_normal((rows, size)).astype(FLOAT)
    found = jax.jit(jax.vmap(lambda row: jnp.sum((M @ row) ** 2)))(x)
    np.testing.assert_allclose(found[-1], np.sum((M @ x[-1]) ** 2), rtol=1e-5)


def test_a_version_known_to_be_wrong_is_warned_of_by_number_and_cure():
    for version in ("0.10.2", "0.11.1"):
        with pytest.warns(UserWarning, match=rf"jaxlib {version} .*jax issue.*; install another: python -m pip"):
            versions.warn(version)
    versions.warn("0.10.1")  # a warning would be an error here
    versions.warn("0.12.0.1")
