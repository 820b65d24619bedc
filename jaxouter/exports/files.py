"""A controller as a file: its format, what that needs, how it is written and verified."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from jaxouter.exports import c, fmu, verify
from jaxouter.exports.spec import ControllerSpec
from jaxouter.progress import Progress
from jaxouter.training.policy import LearnedParams, LearnedPolicy

FORMATS = ("onnx", "npz", "stablehlo", "c", "fmu")


def check(path: Path) -> str:
    """Check everything about the file that can be checked quickly; returns its format.

    Raises:
        ValueError: the suffix names no format, the file exists, or can't be made here.
    """
    kind = path.suffix.removeprefix(".")
    if kind not in FORMATS:
        raise ValueError(f"{path} must end in the name of a format; the formats are: {', '.join(FORMATS)}")
    for each in written(path):
        if each.exists():
            raise ValueError(f"{each} exists; remove it, or choose another file")
    if not (path.parent.is_dir() and os.access(path.parent, os.W_OK)):
        raise ValueError(f"{path} can't be written: {path.parent} must be a folder that you may write to")
    try:
        _needed(kind)
    except (ImportError, FileNotFoundError) as error:
        raise ValueError(f"format {kind} can't be made here: {error}") from None
    return kind


def written(path: Path) -> list[Path]:
    """The files of an export."""
    return [path, path.with_suffix(".h")] if path.suffix == ".c" else [path]


def export(spec: ControllerSpec, policy: LearnedPolicy, params: LearnedParams, path: Path, progress: Progress) -> str:
    """Write a controller in the format that the suffix names, verified against the policy before it is in its place.

    Returns:
        The result of the verification in one line.

    Raises:
        ValueError: see `check`.
        ArithmeticError: it differs from the policy; nothing is written.
    """
    kind = check(path)
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as place:
        made = Path(place) / path.name
        progress.phase("writing")
        _write(kind, made, spec, policy, params)
        progress.phase("verifying")
        found = _verified(kind, made, spec, policy, params)
        for each in written(made):
            each.replace(path.with_name(each.name))
    return found


def _needed(kind: str) -> None:
    """Raises ImportError or FileNotFoundError if a requirement of the format is not installed."""
    if kind == "onnx":
        from jaxouter.exports import onnx  # noqa: F401
    elif kind == "stablehlo":
        from jaxouter.exports import stablehlo  # noqa: F401
    elif kind == "fmu":
        c.compiler()
        fmu.platform_folder()


def _write(kind: str, path: Path, spec: ControllerSpec, policy: LearnedPolicy, params: LearnedParams) -> None:
    match kind:
        case "onnx":
            from jaxouter.exports import onnx

            onnx.save(spec, path)
        case "npz":
            spec.save(path)
        case "stablehlo":
            from jaxouter.exports import stablehlo

            stablehlo.save(policy, params, path)
        case "c":
            c.save(spec, path)
        case "fmu":
            fmu.save(spec, path)


def _verified(kind: str, path: Path, spec: ControllerSpec, policy: LearnedPolicy, params: LearnedParams) -> str:
    try:
        found = verify.verify(kind, path, spec, policy, params)
    except (ImportError, FileNotFoundError) as error:
        return f"not verified: {error}"
    text = (
        f"largest deviations from the policy in {verify.STEPS:,} steps, as shares of the range of r~: "
        f"{found.at_a_step:.1e} at a step, {found.in_closed_loop:.1e} in closed loop"
    )
    if not found.small:
        allowed = f"{verify.AT_A_STEP:.0e} and {verify.IN_CLOSED_LOOP:.0e}"
        raise ArithmeticError(f"nothing is written: {text}; allowed are {allowed}")
    return f"verified: {text}"
