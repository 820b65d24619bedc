"""`python -m jaxouter.doctor`: what this installation can do, and the cure for what it can't."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxouter
from jaxouter import cli, versions
from jaxouter.evaluation import cache
from jaxouter.exports import c
from jaxouter.plants.registry import missing_platform
from jaxouter.terminal import console

ROWS = 32_769  # from so many rows of a batch on jaxlib 0.10.2 is wrong (jax issue 39103)
FREE = 1e9  # bytes, that a training with checkpoints and figures may need
EXTRAS = {  # module: extra, and what needs it
    "gymnasium": ("gymnasium", "plants gym:ID, jaxouter.runtime.gymnasium"),
    "fmpy": ("fmu", "plants fmu:FILE"),
    "onnx": ("onnx", "export --format onnx"),
    "pyarrow": ("parquet", "plants log:FILE.parquet"),
    "tensorboardX": ("tensorboard", "train --tensorboard"),
    "wandb": ("wandb", "train --wandb"),
}
SLOW = ("JAX_DISABLE_JIT", "JAX_ENABLE_X64", "JAX_DEBUG_NANS", "XLA_FLAGS")  # variables by which all may be slower


class Finding(NamedTuple):
    """One line of what was looked at."""

    what: str
    cure: str = ""  # '': all is well
    wrong: bool = True  # else something optional is missing


@dataclass(frozen=True)
class Options:
    """Look at versions, devices, folders, compilers and optional packages; say what is wrong, and the cure.

    The exit status is 1 if something is wrong. What is optional and missing is no error.
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors(arguments):
        tyro.cli(Options, prog=cli.program("doctor"), args=arguments)
        wrong = False
        for found in findings():
            sign = "ok" if not found.cure else "WRONG" if found.wrong else "-"
            console.print(f"{sign:<7}{found.what}", markup=False, highlight=False, soft_wrap=True)
            if found.cure:
                console.print(f"       -> {found.cure}", markup=False, highlight=False, soft_wrap=True)
            wrong |= sign == "WRONG"
    if wrong:
        raise SystemExit(1)


def findings() -> Iterator[Finding]:
    """All that is looked at, in the order in which it matters."""
    yield Finding(f"jaxouter {jaxouter.__version__}, Python {platform.python_version()}, {platform.platform()}")
    yield packages()
    yield devices()
    yield computes()
    yield from variables()
    yield Finding(f"{os.cpu_count()} processors")
    # Without a cache all works, and starts as slowly each time.
    cached = folder("cache folder", cache.folder(), "set XDG_CACHE_HOME to a folder that can be written")
    yield cached._replace(wrong=False)
    yield folder("working folder", Path.cwd(), "change to a folder that can be written; runs are made in it")
    yield compiler()
    for module, (extra, use) in EXTRAS.items():
        yield optional(module, extra, use)


def packages() -> Finding:
    """Versions of what results depend on."""
    found = {name: version(name) for name in ("jax", "jaxlib", "flax", "optax", "numpy", "scipy")}
    what, cure = ", ".join(f"{name} {number}" for name, number in found.items()), ""
    if found["jaxlib"] in versions.FAULTS:
        cure = f"jaxlib {found['jaxlib']} {versions.FAULTS[found['jaxlib']]}: {versions.CURE}"
    return Finding(what, cure)


def devices() -> Finding:
    """The devices that JAX uses, and whether there is an NVIDIA GPU that it does not."""
    if (message := missing_platform()) is not None:
        return Finding("devices", message)
    there = jax.devices()
    what = f"devices: {', '.join(map(str, there))} ({there[0].device_kind})"
    if there[0].platform == "cpu" and shutil.which("nvidia-smi"):
        cure = f"there is an NVIDIA GPU that JAX does not use: python -m pip install 'jax[cuda13]=={version('jax')}'"
        return Finding(what, cure, wrong=False)
    return Finding(what)


def computes() -> Finding:
    """Whether a large batch is computed rightly, to its last row."""
    rng = np.random.default_rng(0)
    M, x = rng.standard_normal((3, 3)).astype(np.float32), rng.standard_normal((ROWS, 3)).astype(np.float32)
    found = np.asarray(jax.jit(jax.vmap(lambda row: jnp.sum((M @ row) ** 2)))(x))
    right = np.allclose(found[-1], np.sum((M @ x[-1]) ** 2), rtol=1e-4)
    return Finding("JAX computes rightly", "" if right else f"JAX computes wrongly here: {versions.CURE}")


def variables() -> Iterator[Finding]:
    """Variables that make everything slower, or results other than those of the documentation."""
    for name in SLOW:
        if value := os.environ.get(name):
            yield Finding(f"{name} is {value!r}", f"unset {name}, unless you need it", wrong=False)


def folder(what: str, path: Path | None, cure: str) -> Finding:
    """Whether files can be written there, and how much is free."""
    if path is None:
        return Finding(f"no {what}: nothing that is compiled or tuned is kept", cure)
    existing = next(each for each in (path, *path.parents) if each.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        return Finding(f"{what} {path} can't be written ({error.strerror})", cure)
    free = shutil.disk_usage(existing).free
    return Finding(f"{what} {path}, {free / 1e9:.0f} GB free", f"{cure}, or free some space" if free < FREE else "")


def compiler() -> Finding:
    """The C compiler, which few need."""
    use = "for export --format fmu, and to verify C"
    try:
        return Finding(f"{c.compiler()}, {use}")
    except FileNotFoundError as error:
        return Finding(f"no C compiler, {use}", str(error), wrong=False)


def optional(module: str, extra: str, use: str) -> Finding:
    """An optional package: its version, or how to install it."""
    if importlib.util.find_spec(module) is None:
        return Finding(f"no {module}, for {use}", f"{sys.executable} -m pip install 'jaxouter[{extra}]'", wrong=False)
    try:
        return Finding(f"{module} {version(module)}, for {use}")
    except PackageNotFoundError:  # a module of that name, which no installer knows
        return Finding(f"{module}, for {use}")


if __name__ == "__main__":
    cli.run(main)
