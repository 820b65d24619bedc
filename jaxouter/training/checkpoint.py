"""Checkpoints: a pytree as named host arrays and a JSON header in one npz file, without pickle."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

FORMAT = 1
Tree = TypeVar("Tree")


def _named(tree: Any) -> dict[str, Any]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def save(path: Path, tree: Any, **header: Any) -> None:
    """Write `tree` to `path`, whole or not at all.

    Args:
        path: file, replaced where it exists.
        tree: pytree of arrays; PRNG keys are stored as their data.
        **header: JSON values kept with it.
    """
    arrays = {name: np.asarray(jax.random.key_data(x) if _is_key(x) else x) for name, x in _named(tree).items()}
    shapes = {name: [list(array.shape), str(array.dtype)] for name, array in arrays.items()}
    text = json.dumps({"format": FORMAT, "jax": jax.__version__, "arrays": shapes, **header})
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez(file, allow_pickle=False, header=np.asarray(text), **arrays)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def load(path: Path, like: Tree) -> tuple[Tree, dict[str, Any]]:
    """Read what `save` wrote.

    Args:
        path: file.
        like: pytree of the same structure; arrays or `jax.ShapeDtypeStruct`.

    Returns:
        The tree on the default device, and the header.

    Raises:
        ValueError: the file is not readable, damaged, of another format or of another configuration.
    """
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            arrays = {name: file[name] for name in file.files if name != "header"}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not a readable checkpoint ({error})") from None
    if header.get("format") != FORMAT:
        raise ValueError(f"{path} has format {header.get('format')}; this version reads format {FORMAT}")
    wanted = _named(like)
    if set(wanted) != set(arrays):
        raise ValueError(f"{path} belongs to another configuration: {sorted(set(wanted) ^ set(arrays))[0]} differs")
    leaves = []
    for name, leaf in wanted.items():
        array = jnp.asarray(arrays[name])
        array = jax.random.wrap_key_data(array) if _is_key(leaf) else array
        if array.shape != leaf.shape or array.dtype != leaf.dtype:
            raise ValueError(f"{path}: {name} is {array.dtype}{array.shape}, expected {leaf.dtype}{leaf.shape}")
        leaves.append(array)
    return jax.tree.unflatten(jax.tree.structure(like), leaves), header
