"""`python -m jaxouter.export`: export the controller of a run as a file for other tools."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxouter import cli
from jaxouter.exports import c, fmu, verify
from jaxouter.exports.spec import ControllerSpec
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from jaxouter.training.run import add_agent, add_plant, open_run

FORMATS = ("onnx", "npz", "stablehlo", "c", "fmu")


@dataclass(frozen=True)
class Options:
    """Export the controller that a run has learned: history, scaling, network and bounds, with explicit state.

    Formats: onnx (a graph; needs the extra onnx), npz (the numbers, for jaxouter.runtime.Controller in NumPy),
    stablehlo (for jax.export), c (C99 without memory allocation: a .c and a .h file) and fmu (FMI 2.0 co-simulation;
    needs a C compiler). The file is verified against the policy before it is written to its place.
    """

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Run folder (its median seed is exported), or the folder of one seed in it."""
    plant: str | None = None
    """The run's plant, if your own: FILE.py:NAME, gym:ID, fmu:FILE, log:FILE; its options come from the run."""
    agent: str | None = None
    """The run's agent, if your own: FILE.py:CLASS."""
    format: str | None = None
    """onnx, npz, stablehlo, c or fmu."""
    out: Path | None = None
    """File to write, which must not exist; default: controller.FORMAT in the folder."""
    force: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Export even if the run found its policy worse than r~ = r or the static prefilter."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors(arguments), ExitStack() as stack:
        options = tyro.cli(Options, prog="python -m jaxouter.export", args=arguments)
        run_path, kind, out = check(options)
        run, seed, _ = open_run(run_path)
        cli.use_compilation_cache()
        policy, params = run.policy(seed)
        spec = ControllerSpec.of(policy, params, run.trainer[0].env.plant)
        progress = stack.enter_context(cli.progress())
        place = stack.enter_context(tempfile.TemporaryDirectory(prefix=".export-", dir=out.parent))
        made = Path(place) / out.name
        progress.phase("writing")
        write(kind, made, spec, policy, params)
        progress.phase("verifying")
        found = verified(kind, made, spec, policy, params)
        for path in written(kind, made):
            path.replace(out.with_name(path.name))
    low, high = spec.r_tilde_bounds
    print(
        f"{spec.plant}, seed {seed}: r~ in [{low:g}, {high:g}] {spec.y_unit} from r and y in {spec.y_unit}, once every "
        f"{spec.control_step:g} {spec.time_unit}; state: {spec.history} past y, {spec.history} past r~, integral"
    )
    for path in written(kind, out):
        print(f"written: {path} ({path.stat().st_size / 1000:.1f} kB)")
    print(found)


def check(options: Options) -> tuple[Path, str, Path]:
    """Check everything that can be checked quickly.

    Returns:
        Folder of the run, format, and the file to write.

    Raises:
        ValueError: an option names something that is missing, exists already, or can't be made here.
    """
    kind, run = options.format, options.run
    if run is None:
        raise ValueError("say what to export: a run folder, or the folder of one seed in it")
    if kind not in FORMATS:
        asked = "say --format" if kind is None else f"there is no format {kind!r}"
        raise ValueError(f"{asked}; the formats are: {', '.join(FORMATS)}")
    out = run / f"controller.{kind}" if options.out is None else options.out
    add_agent(options.agent)
    named = None if options.plant is None else add_plant(options.plant, run)
    opened, seed, _ = open_run(run)
    made_on = opened.config.plant
    if named not in (None, made_on):
        raise ValueError(f"{run} is a run on {made_on}, not on {named}")
    if out.suffix != f".{kind}":
        raise ValueError(f"--out is {out}; for the format {kind} its name must end in .{kind}")
    verdict = opened.verdict()
    if seed in verdict.get("worse", ()) and not options.force:
        raise ValueError(f"{run}, seed {seed}: {verdict['text']}")
    for path in written(kind, out):
        if path.exists():
            raise ValueError(f"{path} exists; remove it, or choose another --out")
    if not (out.parent.is_dir() and os.access(out.parent, os.W_OK)):
        raise ValueError(f"{out} can't be written: {out.parent} must be a folder that you may write to")
    try:
        needed(kind)
    except (ImportError, FileNotFoundError) as error:
        raise ValueError(f"--format {kind} can't be made here: {error}") from None
    return run, kind, out


def written(kind: str, out: Path) -> list[Path]:
    """The files of an export."""
    return [out, out.with_suffix(".h")] if kind == "c" else [out]


def needed(kind: str) -> None:
    """Raises ImportError or FileNotFoundError if a requirement of the format is not installed."""
    if kind == "onnx":
        from jaxouter.exports import onnx  # noqa: F401
    elif kind == "stablehlo":
        from jaxouter.exports import stablehlo  # noqa: F401
    elif kind == "fmu":
        c.compiler()
        fmu.platform_folder()


def write(kind: str, path: Path, spec: ControllerSpec, policy: LearnedPolicy, params: LearnedParams) -> None:
    """Write the controller in a format."""
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


def verified(kind: str, path: Path, spec: ControllerSpec, policy: LearnedPolicy, params: LearnedParams) -> str:
    """Verify the file; returns the result in one line.

    Raises:
        SystemExit: it differs from the policy.
    """
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
        raise SystemExit(f"error: nothing is written: {text}; allowed are {allowed}")
    return f"verified: {text}"


if __name__ == "__main__":
    cli.run(main)
