"""JAX computes rightly here, and who has a version known to be wrong is told."""

import importlib
import re
import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import jaxouter
from jaxouter import versions
from tests.precision import FLOAT, X64

ROOT = Path(__file__).parents[1]


def test_the_last_row_of_a_large_batch_is_right():
    """Jax issue 39103: jaxlib 0.10.2 got it wrong on a CPU from so many rows on."""
    rows, size = 16_385 if X64 else 32_769, 3
    rng = np.random.default_rng(0)
    M, x = rng.standard_normal((size, size)).astype(FLOAT), rng.standard_normal((rows, size)).astype(FLOAT)
    found = jax.jit(jax.vmap(lambda row: jnp.sum((M @ row) ** 2)))(x)
    np.testing.assert_allclose(found[-1], np.sum((M @ x[-1]) ** 2), rtol=1e-5)


@pytest.mark.parametrize("version", ["0.10.2", "0.11.1"])
def test_whoever_imports_jaxouter_with_a_version_known_to_be_wrong_is_told_the_cure(version, monkeypatch):
    monkeypatch.setattr(versions, "version", lambda name: version)
    with pytest.warns(UserWarning, match=rf"jaxlib {version} .*jax issue.*; install another: python -m pip"):
        importlib.reload(jaxouter)


def test_other_versions_and_none_are_no_matter(monkeypatch):
    for version in ("0.10.1", "0.12.0.1"):
        monkeypatch.setattr(versions, "version", lambda name, version=version: version)
        versions.warn()  # a warning would be an error here

    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(versions, "version", missing)
    versions.warn()


JAX = {  # Python: versions that are right there, and others
    "3.11": (["0.10.1"], ["0.10.2", "0.11.2"]),
    "3.12": (["0.11.2", "0.12.0.1"], ["0.10.1", "0.11.1"]),
    "3.14": (["0.11.2", "0.12.0.1"], ["0.10.2", "0.11.1"]),
}


@pytest.mark.parametrize("python", JAX)
def test_each_python_gets_a_jax_that_is_right(python):
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    right, wrong = JAX[python]
    given = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert SpecifierSet(given["requires-python"]).contains(f"{python}.0")

    def of(name: str, lines: Iterable[str]) -> SpecifierSet:
        every = (Requirement(line.strip(" \\")) for line in lines if re.match(rf"{name}\b", line))
        (found,) = (each for each in every if each.marker is None or each.marker.evaluate(environment))
        return found.specifier

    wanted, lock = of("jax", given["dependencies"]), (ROOT / "requirements.lock").read_text().splitlines()
    assert [version for version in right + wrong if version in wanted] == right
    for name in ("jax", "jaxlib"):
        (pin,) = of(name, lock)
        assert pin.version in right
