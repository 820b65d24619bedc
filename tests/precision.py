"""The precision in which the suite runs: single, or double under JAX_ENABLE_X64=1."""

import jax
import numpy as np
import pytest

X64 = bool(jax.config.read("jax_enable_x64"))
FLOAT = np.dtype(np.float64 if X64 else np.float32)

makes_nan = pytest.mark.skipif(bool(jax.config.jax_debug_nans), reason="NaN is what it is about")
of_single_draws = pytest.mark.skipif(X64, reason="its figures are those of what is drawn in single precision")
