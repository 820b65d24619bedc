"""Run the code blocks of the documentation, each page in a fresh copy of this checkout.

    python scripts/docs.py                             # all pages and notebooks of docs
    python scripts/docs.py docs/tutorial.md            # one of them
    python scripts/docs.py --write docs/notebooks/outer-loop.ipynb   # and keep its outputs

Blocks of `bash` and `python` run in order, in one process per page. Python blocks share a namespace; a Bash block ends
at the first command that fails. Blocks in other languages, and those below a comment `<!-- not run: WHY -->`, are not
run. The cells of a notebook run in a kernel, in the notebook's folder. If a block fails, the rest of its page is
skipped, other pages still run, and the exit status is 1.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from jaxouter import cli

ROOT = Path(__file__).resolve().parents[1]
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NOT_RUN = re.compile(r"<!-- not run: (.+?) -->\s*\Z")
RUN = ("bash", "python")
NOTEBOOK = ".ipynb"
CELL_SECONDS = 1200
SILENT = "remove-output"  # tag of cells whose outputs are not kept: progress, which differs each time


@dataclass(frozen=True)
class Options:
    """Run the code blocks of the documentation, each page in a fresh copy of this checkout."""

    pages: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Markdown files and notebooks of this checkout; default: all in docs."""
    write: bool = False
    """Keep the outputs of notebooks that did not fail."""


EXECUTE = """
import nbformat
from nbclient import NotebookClient

notebook = nbformat.read({page!r}, as_version=4)
where = dict(metadata=dict(path={folder!r}))
NotebookClient(notebook, timeout={seconds}, kernel_name="python3", resources=where).execute()
nbformat.write(notebook, {page!r})
"""


class Block(NamedTuple):
    """A code block of a page."""

    language: str
    text: str
    line: int  # first line of its text, from 1
    why_not: str  # why it is not run; '' if it is


class Outcome(NamedTuple):
    """The result of a page."""

    run: int
    minutes: float
    failed: bool


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    with cli.user_errors():
        given = tyro.cli(Options, prog="python scripts/docs.py", args=arguments)
        every = (page.relative_to(ROOT) for suffix in (".md", NOTEBOOK) for page in ROOT.glob(f"docs/**/*{suffix}"))
        pages = [inside(page) for page in given.pages] or sorted(every)
        listed = {page: (cells if page.suffix == NOTEBOOK else blocks)((ROOT / page).read_text()) for page in pages}
    with tempfile.TemporaryDirectory(prefix="jaxouter-docs-") as place:
        outcomes = [
            outcome(page, found, Path(place), given.write)
            for page, found in listed.items()
            if any(not b.why_not for b in found)
        ]
    failed = sum(each.failed for each in outcomes)
    not_run = sum(bool(block.why_not) for found in listed.values() for block in found)
    print(
        f"{len(outcomes)} pages with {sum(each.run for each in outcomes)} blocks, {failed} failed; "
        f"{not_run} blocks not run; {sum(each.minutes for each in outcomes):.1f} minutes"
    )
    raise SystemExit(failed > 0)


def inside(page: Path) -> Path:
    """The page's path relative to the root of the checkout.

    Raises:
        ValueError: it is not a file of the checkout.
    """
    path = page.resolve()
    if not (path.is_file() and path.is_relative_to(ROOT)):
        raise ValueError(f"{page} is not a file of this checkout; pages lie in docs")
    return path.relative_to(ROOT)


def blocks(markdown: str) -> list[Block]:
    """The Bash and Python blocks of a page."""
    found = []
    for match in FENCE.finditer(markdown):
        why_not = NOT_RUN.search(markdown, 0, match.start())
        line = markdown.count("\n", 0, match.start(2)) + 1
        if match[1] in RUN:
            found.append(Block(match[1], match[2], line, why_not[1] if why_not else ""))
    return found


def cells(notebook: str) -> list[Block]:
    """The code cells of a notebook; `line` is the number of the cell, from 1."""
    every = enumerate(json.loads(notebook)["cells"], 1)
    return [Block("python", "".join(cell["source"]), i, "") for i, cell in every if cell["cell_type"] == "code"]


def program(page: Path, found: Sequence[Block]) -> str:
    """A Python program that runs the blocks of a page; tracebacks name the page's lines or show the cell."""
    if page.suffix == NOTEBOOK:
        return EXECUTE.format(page=str(page), folder=str(page.parent), seconds=CELL_SECONDS)
    lines = ["import subprocess", 'names = {"__name__": "__main__"}']
    for block in found:
        where = f"{page}:{block.line}"
        if block.why_not:
            lines.append(f"print({f'-- {where} not run: {block.why_not}'!r}, flush=True)")
            continue
        lines.append(f"print({f'-- {where}'!r}, flush=True)")
        if block.language == "bash":
            lines.append(f"if subprocess.run(['bash', '-euo', 'pipefail', '-c', {block.text!r}]).returncode:")
            lines.append(f"    raise SystemExit({f'{where} failed'!r})")
        else:
            source = "\n" * (block.line - 1) + block.text
            lines.append(f"exec(compile({source!r}, {str(page)!r}, 'exec'), names)")
    return "\n".join(lines)


def outcome(page: Path, found: Sequence[Block], place: Path, write: bool = False) -> Outcome:
    """Run a page in a fresh copy; only the cache of baselines and compiled functions is shared between pages."""
    print(f"== {page}", flush=True)
    copy, begun = place / "checkout", time.monotonic()
    copied(copy)
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(copy),
        "XDG_CACHE_HOME": str(place / "cache"),
    }
    failed = subprocess.run([sys.executable, "-c", program(page, found)], cwd=copy, env=environment).returncode != 0
    if write and page.suffix == NOTEBOOK and not failed:
        (ROOT / page).write_text(stable(json.loads((copy / page).read_text())))
    shutil.rmtree(copy)
    run = sum(not block.why_not for block in found)
    minutes = (time.monotonic() - begun) / 60
    print(f"== {page} {'FAILED' if failed else 'done'} in {minutes:.1f} minutes", flush=True)
    return Outcome(run, minutes, failed)


def stable(notebook: dict[str, Any]) -> str:
    """A notebook as it is kept: without times and what else differs between machines."""
    for i, cell in enumerate(notebook["cells"], 1):
        tags = cell["metadata"].get("tags")
        cell |= {"id": f"cell-{i}", "metadata": {"tags": tags} if tags else {}}
        if SILENT in (tags or ()):
            cell["outputs"] = []
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook["metadata"] = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return json.dumps(notebook, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


def copied(copy: Path) -> None:
    """Copy the checkout: files tracked by git, and new ones that are not ignored."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    for name in filter(None, listing.stdout.split("\0")):
        if (ROOT / name).is_file():  # else its deletion is not committed yet
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)


if __name__ == "__main__":
    cli.run(main)
