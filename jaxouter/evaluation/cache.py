"""A folder of results that depend on code and configuration alone, so that they are computed once."""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
import zipfile
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxouter
from jaxouter.plants import sources

PACKAGE = Path(jaxouter.__file__).parent
SOURCES = ("plants", "loop", "agents", "training", "evaluation/rivals")
FILES = ("metrics.py", "rollout.py", "scenarios.py", "sweeps.py", "certificate.py", "board.py", "cache.py")


class Tuned(NamedTuple):
    """What identification and tuning found: plain values, from which the policy is built, and what that cost."""

    settings: dict[str, Any]  # as JSON
    arrays: dict[str, np.ndarray]
    steps: int  # environment steps
    seconds: float = 0.0  # that it took when it was made; `cached` says


def folder() -> Path:
    """The user's cache folder of jaxouter."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxouter"


@lru_cache(maxsize=1)
def code() -> str:
    """Hash of all source that results depend on, and of the version of JAX."""
    paths = [path for part in SOURCES for path in sorted((PACKAGE / part).glob("*.py"))]
    paths += [PACKAGE / "evaluation" / name for name in FILES]
    return hashlib.sha256(b"\0".join([jax.__version__.encode(), *(path.read_bytes() for path in paths)])).hexdigest()


def cached(name: str, key: Mapping[str, Any], make: Callable[[], Tuned]) -> Tuned:
    """What `make` gives, from the cache where the same was made before.

    Args:
        name: of the file, for people.
        key: JSON values that the result depends on, beside the code.
        make: makes it.
    """
    own = {name: repr(source) for name, source in sources.SOURCES.items()}
    text = json.dumps({"code": code(), **key} | ({"plants": own} if own else {}), sort_keys=True)
    path = folder() / "rivals" / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            arrays = {name: file[name] for name in file.files if name != "header"}
            return Tuned(arrays=arrays, **header)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        pass  # absent or damaged: made again
    begin = time.perf_counter()
    made = make()
    made = made._replace(seconds=time.perf_counter() - begin)
    partial = path.with_suffix(f".{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"the cache folder {path.parent} can't be made: {error.strerror}") from None
    with partial.open("wb") as file:
        header = json.dumps({"settings": made.settings, "steps": made.steps, "seconds": made.seconds})
        np.savez(file, allow_pickle=False, header=np.asarray(header), **made.arrays)
    partial.replace(path)
    return made
