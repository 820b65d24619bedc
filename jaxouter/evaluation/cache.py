"""A folder of results that depend on code and configuration alone, so that they are computed once."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import platformdirs

import jaxouter
from jaxouter import terminal
from jaxouter.plants import registry

PACKAGE = Path(jaxouter.__file__).parent
FOLDERS = ("plants", "loop", "identification", "agents", "tasks", "training", "evaluation/baselines")
FILES = ("metrics.py", "rollout.py", "scenarios.py", "sweeps.py", "stability.py", "jobs.py", "cache.py")


class Tuned(NamedTuple):
    """What identification and tuning found: plain values, from which the policy is built, and what that cost."""

    settings: dict[str, Any]  # as JSON
    arrays: dict[str, np.ndarray]
    steps: int  # environment steps
    seconds: float = 0.0  # that it took when it was made; `cached` says


def folder() -> Path | None:
    """The user's cache folder of jaxouter; None where the user has none."""
    try:
        path = Path(platformdirs.user_cache_dir("jaxouter", appauthor=False))
    except RuntimeError:
        return None
    return path if path.is_absolute() else None


def usable() -> Path | None:
    """The cache folder, made, if files can be written there; warns once where not."""
    return _usable(folder())


@lru_cache(maxsize=4)
def _usable(path: Path | None) -> Path | None:
    if path is None:
        return _unusable("there is no cache folder, for want of a home and of an absolute XDG_CACHE_HOME")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as file:
            file.write(bytes(1 << 16))  # more than a full disk takes
    except OSError as error:
        return _unusable(f"the cache folder {path} can't be written ({error.strerror})")
    return path


def _unusable(why: str) -> None:
    warnings.warn(f"{why}; nothing that is compiled or tuned is kept, and the next start takes as long", stacklevel=4)


def use_compilation_cache() -> None:
    """Keep compiled functions in the user's cache folder, unless JAX is configured otherwise."""
    terminal.mend_cache()
    if not jax.config.values["jax_compilation_cache_dir"] and (folder := usable()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # there are many small ones


@lru_cache(maxsize=1)
def code() -> str:
    """Hash of all source that results depend on, and of the version of JAX."""
    paths = [path for part in FOLDERS for path in sorted((PACKAGE / part).glob("*.py"))]
    paths += [PACKAGE / "evaluation" / name for name in FILES]
    return hashlib.sha256(b"\0".join([jax.__version__.encode(), *(path.read_bytes() for path in paths)])).hexdigest()


def cached(name: str, key: Mapping[str, Any], make: Callable[[], Tuned]) -> Tuned:
    """What `make` gives, from the cache where the same was made before.

    Args:
        name: of the file, for people.
        key: JSON values that the result depends on, beside the code.
        make: makes it.
    """
    own = {name: repr(known) for name, known in registry.REGISTRATIONS.items()}
    text = json.dumps({"code": code(), **key} | ({"plants": own} if own else {}), sort_keys=True)
    kept = Path("baselines") / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    if (there := folder()) is not None:
        with suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # absent or damaged: made again
            return _read(there / kept)
    begin = time.perf_counter()
    made = make()
    made = made._replace(seconds=time.perf_counter() - begin)
    if (there := usable()) is not None:
        try:
            _write(there / kept, made)
        except OSError as error:
            warnings.warn(
                f"{there / kept} can't be written ({error.strerror}); it is made anew next time", stacklevel=2
            )
    return made


def _read(path: Path) -> Tuned:
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
        return Tuned(arrays={name: file[name] for name in file.files if name != "header"}, **header)


def _write(path: Path, made: Tuned) -> None:
    """Whole or not at all."""
    path.parent.mkdir(exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}-{threading.get_ident()}")
    header = json.dumps({"settings": made.settings, "steps": made.steps, "seconds": made.seconds})
    try:
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, header=np.asarray(header), **made.arrays)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
