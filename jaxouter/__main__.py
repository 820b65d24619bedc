"""`jaxouter COMMAND ...`: the commands as one program; `jaxouter train` is `python -m jaxouter.train`."""

from __future__ import annotations

import importlib
import sys

import jaxouter

COMMANDS = {
    "train": "learn an outer loop on a plant, and evaluate it",
    "evaluate": "evaluate a run or a baseline on scenarios that training never saw",
    "compare": "compare runs with baselines, limit and bound; writes a report",
    "check": "test whether a plant of your own implements the interface",
    "export": "write the controller of a run as NumPy, ONNX, StableHLO, C or FMU",
    "live": "run an outer loop around a function step(r~) -> y in real time, and learn from it",
    "doctor": "look at versions, devices, folders and optional packages, and say what is wrong",
}


def main(arguments: list[str] | None = None) -> None:
    """Call the command that is named first with the rest of the arguments."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        lines = [f"  {command:<10}{what}" for command, what in COMMANDS.items()]
        end = "jaxouter COMMAND --help shows its options, jaxouter --version the version."
        print("\n".join(["usage: jaxouter COMMAND ...", "", *lines, "", end]))
        return
    if name == "--version":
        print(jaxouter.__version__)
        return
    if name not in COMMANDS:
        print(f"error: there is no command {name!r}; the commands are: {', '.join(COMMANDS)}", file=sys.stderr)
        raise SystemExit(2)
    from jaxouter import cli

    command = importlib.import_module(f"jaxouter.{name}")
    cli.run(lambda: command.main(rest))


if __name__ == "__main__":
    main()
