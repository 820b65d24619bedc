"""`python -m jaxouter.export`: export the controller of a run as a file for other tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxouter import cli
from jaxouter.api import Run, load
from jaxouter.exports import files
from jaxouter.exports.files import FORMATS
from jaxouter.plants.base import in_words
from jaxouter.progress import showing


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
    """onnx, npz, stablehlo, c or fmu; default: that of --out."""
    out: Path | None = None
    """File to write, which must not exist; default: controller.FORMAT in the folder."""
    force: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Export even if the run found its policy worse than r~ = r or the static prefilter."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors(arguments):
        options = tyro.cli(Options, prog=cli.program("export"), args=arguments)
        with showing(True):
            out, run = check(options)
        try:
            found = run.export(out, force=options.force)
        except ArithmeticError as error:
            raise SystemExit(f"error: {error}") from None
    spec = run.policy.spec
    low, high = spec.r_tilde_bounds
    print(
        f"{spec.plant}, seed {run.seed}: r~ in [{low:g}, {high:g}]{in_words(spec.y_unit)} from r and y"
        f"{in_words(spec.y_unit, ' in {}')}, once every {spec.control_step:g} {spec.time_unit}; state: "
        f"{spec.remembered} past y, {spec.remembered} past r~, integral"
        + (f", how well the models of {spec.laws} laws predict, which law acts" if spec.laws > 1 else "")
    )
    for path in files.written(out):
        print(f"written: {path} ({path.stat().st_size / 1000:.1f} kB)")
    print(found)


def check(options: Options) -> tuple[Path, Run]:
    """The file to write, and the run.

    Raises:
        ValueError: an option is missing, or names something that does not exist.
    """
    kind = options.format
    if options.run is None:
        raise ValueError("say what to export: a run folder, or the folder of one seed in it")
    if kind is None and options.out is not None:
        kind = options.out.suffix.removeprefix(".")
    if kind not in FORMATS:
        asked = "say --format" if not kind else f"there is no format {kind!r}"
        raise ValueError(f"{asked}; the formats are: {', '.join(FORMATS)}")
    out = options.run / f"controller.{kind}" if options.out is None else options.out
    if out.suffix != f".{kind}":
        raise ValueError(f"--out is {out}; for the format {kind} its name must end in .{kind}")
    return out, load(options.run, plant=options.plant, agent=options.agent)


if __name__ == "__main__":
    cli.run(main)
