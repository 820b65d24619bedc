"""Shared by the commands: readable errors, lists, tables."""

from __future__ import annotations

import ast
import gc
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich import box
from rich.table import Table
from rich.text import Text
from tyro.conf import UseAppendAction

from jaxouter import agents, plants, tasks
from jaxouter.api.learning import ChoiceWarning
from jaxouter.evaluation import scenarios, sweeps
from jaxouter.evaluation.baselines import NAMES
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.plants.registry import FORMS, own_errors
from jaxouter.terminal import console, last, show
from jaxouter.training.run import RunWarning

DEBUG = "--debug"
Settings = Annotated[tuple[tuple[str, ...], ...], UseAppendAction, tyro.conf.arg(metavar="NAME VALUE ...")]
"""Option for parameters of the plant: names, each followed by its values; may be repeated."""


@contextmanager
def user_errors(arguments: Sequence[str] | None = None) -> Iterator[None]:
    """Report a ValueError, a mistake of the user or of a plant, as one message with exit status 2.

    Args:
        arguments: of the command; None: those of the program. With `--debug` the traceback is shown too.
    """
    warnings.simplefilter("always", RunWarning)
    warnings.simplefilter("always", ChoiceWarning)
    warnings.simplefilter("once", IdentificationWarning)
    warnings.showwarning = show
    try:
        with own_errors():
            yield
    except ValueError as error:
        if DEBUG in (sys.argv[1:] if arguments is None else arguments):
            traceback.print_exception(error)
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def run(main: Callable[[], None]) -> None:
    """Run a command as a program: Ctrl-C, if not handled elsewhere, ends it silently with status 130.

    A file that can't be read or written is reported in one line, with status 1.
    """
    last()
    gc.set_threshold(50_000, 20, 50)  # else a quarter of the time in which JAX traces goes into collections
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except OSError as error:
        raise SystemExit(f"error: {error}") from None


def program(command: str) -> str:
    """How the user has called the command."""
    return f"jaxouter {command}" if Path(sys.argv[0]).stem == "jaxouter" else f"python -m jaxouter.{command}"


def settings(options: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Parameters of the plant from `--set NAME VALUE ... NAME VALUE ...`: a number each, or a tuple of numbers.

    Raises:
        ValueError: a value has no name, or a name no value.
    """
    found: dict[str, list[Any]] = {}
    for words in options:
        name = None
        for word in words:
            try:
                value = ast.literal_eval(word)
            except (ValueError, SyntaxError):
                name, found[word] = word, []
                continue
            if name is None:
                raise ValueError(f"--set {' '.join(words)}: {word} has no name; write --set NAME VALUE ...")
            found[name].append(value)
    for name, values in found.items():
        if not values:
            raise ValueError(f"--set {name}: there is no value, or it is not a number; write --set NAME VALUE ...")
    return {name: values[0] if len(values) == 1 else tuple(values) for name, values in found.items()}


def print_lists() -> None:
    """Plants, presets, scenarios, sweeps, agents and policies."""
    for name in plants.REGISTRY:
        console.print(f"[bold]{name}[/bold]")
        console.print("  presets:   " + ", ".join(tasks.presets(name)))
        console.print("  scenarios: " + ", ".join(scenarios.catalogue(name)))
        console.print("  sweeps:    " + ", ".join(sweeps.catalogue(name)))
    console.print("plants of your own: " + FORMS)
    console.print("agents: " + ", ".join(agents.AGENTS) + ", FILE.py:CLASS")
    console.print("policies: a run folder, " + ", ".join(NAMES))


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; the first column is left-aligned, the others right-aligned.

    Nothing is cut: a table that is too wide loses its box and, if need be, is printed in parts.
    """
    plain = [[Text.from_markup(row[i]).plain for row in (columns, *rows)] for i in range(len(columns))]
    least = [
        max(map(len, plain[0])),
        *(max((len(word) for cell in cells for word in cell.split()), default=1) for cells in plain[1:]),
    ]
    room, rest = console.width, [*range(1, len(columns))]
    boxed = sum(least) + 3 * len(least) + 1 <= room
    style: dict[str, Any] = {} if boxed else dict(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    least = [min(width, room // 2 - 2) for width in least]
    while rest:
        shown, free = [0], room - 1 - 3 - least[0] if boxed else room - 2 - least[0]
        while rest and (len(shown) == 1 or least[rest[0]] + 3 <= free):
            free -= least[rest[0]] + (3 if boxed else 2)
            shown.append(rest.pop(0))
        out = Table(title=title, title_justify="left", header_style="bold", **style)
        for i in shown:
            wider = min(max(map(len, plain[i])) - least[i], max(0, free))
            free -= wider
            justify = "right" if i else "left"
            out.add_column(columns[i], justify=justify, overflow="fold", width=least[i] + max(0, wider))
        for row in rows:
            out.add_row(*(row[i] for i in shown))
        console.print(out)
