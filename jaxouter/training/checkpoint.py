"""Checkpoints: a pytree as named arrays, with a JSON header, in one npz file with a checksum; no pickle."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

FORMAT = 2
MARK = b"jaxouter sha256:"  # at the end of the file, followed by the digest of everything before it
Tree = TypeVar("Tree")


def _named(tree: Any) -> dict[str, Any]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def write(path: Path, content: bytes | memoryview) -> None:
    """Write a file atomically, even if the power fails: to a temporary file, which is then renamed.

    Raises:
        OSError: it can't be written; `path` is unchanged.
    """
    partial = path.with_suffix(".partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)  # make room on a full disk
        raise
    if os.name == "posix":  # elsewhere folders can't be opened
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # makes the new name durable
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems can't
                raise
        finally:
            os.close(folder)


def save(path: Path, tree: Any, **header: Any) -> None:
    """Write `tree` to `path` atomically.

    Args:
        path: file; replaced if it exists.
        tree: pytree of arrays; PRNG keys are stored as their data.
        **header: JSON values stored with it.

    Raises:
        OSError: it can't be written; `path` is unchanged.
    """
    arrays = {name: np.asarray(jax.random.key_data(x) if _is_key(x) else x) for name, x in _named(tree).items()}
    shapes = {name: [list(array.shape), str(array.dtype)] for name, array in arrays.items()}
    text = json.dumps({"format": FORMAT, "jax": jax.__version__, "arrays": shapes, **header})
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, header=np.asarray(text), **arrays)
    buffer.write(MARK + hashlib.sha256(buffer.getbuffer()).digest())
    write(path, buffer.getbuffer())


def load(path: Path, like: Tree) -> tuple[Tree, dict[str, Any]]:
    """Read a file that `save` wrote.

    Args:
        path: file.
        like: pytree of the same structure; arrays or `jax.ShapeDtypeStruct`.

    Returns:
        The tree on the default device, and the header.

    Raises:
        ValueError: the file is not readable, damaged, of another format or of another configuration.
    """
    header, arrays = read(path)
    wanted = _named(like)
    if set(wanted) != set(arrays):
        raise ValueError(f"{path} belongs to another configuration: {sorted(set(wanted) ^ set(arrays))[0]} differs")
    leaves = []
    for name, leaf in wanted.items():
        array, stored = arrays[name], jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        if array.shape != stored.shape or array.dtype != stored.dtype:
            of_x64 = array.shape == stored.shape and {"float32", "float64"} == {str(array.dtype), str(stored.dtype)}
            why = "; JAX_ENABLE_X64 was another one when it was saved" if of_x64 else ""
            raise ValueError(
                f"{path}: {name} is {array.dtype}{array.shape}, expected {stored.dtype}{stored.shape}{why}"
            )
        leaves.append(jax.random.wrap_key_data(jnp.asarray(array)) if _is_key(leaf) else jnp.asarray(array))
    return jax.tree.unflatten(jax.tree.structure(like), leaves), header


def read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays by name, after a check of the checksum.

    Raises:
        ValueError: the file is not readable, damaged or of another format.
    """
    try:
        content = path.read_bytes()
        body, mark, digest = content[: -len(MARK) - 32], content[-len(MARK) - 32 : -32], content[-32:]
        if mark != MARK:
            raise ValueError("it has no checksum: it is not whole, or not of this version")
        if hashlib.sha256(body).digest() != digest:
            raise ValueError("its checksum differs: it is damaged")
        with np.load(io.BytesIO(body), allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            arrays = {name: file[name] for name in file.files if name != "header"}
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}, the one that this version reads")
    # A correct checksum does not make a valid file, and zipfile and NumPy raise more than they document.
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} is not a readable checkpoint ({error})") from None
    except (
        NotImplementedError,
        RuntimeError,
        AttributeError,
        TypeError,
        OverflowError,
        MemoryError,
    ) as error:
        raise ValueError(f"{path} is not a readable checkpoint ({error})") from None
    return header, arrays
