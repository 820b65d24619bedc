"""The site: it builds, says where all of it is, and needs no network; its code blocks are found and run."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.load import ROOT, load

badges = load("scripts", "badges")
docs = load("scripts", "docs")
pages = load("scripts", "pages")
published = load("scripts", "published")
FROM_ELSEWHERE = re.compile(
    r"""<(?:script|link|img|iframe)[^>]*\b(?:src|href)="?(?:https?:)?//|url\(["']?https?:|@import"""
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built strictly: a link, an anchor or a page of nav that is missing ends it."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    return folder


@pytest.mark.slow
def test_every_page_is_in_nav(site):
    nav = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text())
    found = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    assert set(nav) == found | {"reference/commands.md"}
    assert all((site / page).with_suffix(".html").is_file() for page in nav)


@pytest.mark.slow
def test_no_page_asks_the_network(site):
    for path in [*site.rglob("*.html"), *site.rglob("*.css")]:
        assert FROM_ELSEWHERE.findall(path.read_text()) == [], path


@pytest.mark.slow
def test_what_is_kept_elsewhere_is_shown(site):
    commands = (site / "reference" / "commands.html").read_text()
    assert all(f'id="{name}"' in commands for name in ("check", "compare", "evaluate", "export", "train"))
    assert "--pretraining.gradient-steps" in commands
    assert (site / "results" / "heaters-default.png").is_file()
    reproduction, explanation = ((site / f"{name}.html").read_text() for name in ("reproduction", "explanation"))
    assert "pitch/delay-swapped</td>" in reproduction
    assert "{{" not in re.sub(r"<code.*?</code>", "", reproduction + explanation, flags=re.DOTALL)
    plants = (site / "reference" / "plants.html").read_text()
    assert "thermal mass of the air, kWh/degC" in plants  # a comment of a field


def test_a_figure_that_is_not_there_ends_the_build():
    assert pages.figure("mae", "none", "pitch/paper") == "10.9"
    with pytest.raises(ValueError, match="there is no mae of magic on pitch/paper"):
        pages.figure("mae", "magic", "pitch/paper")


def test_what_is_shown_is_there_and_has_a_command_that_makes_it():
    shown = published.shown()
    assert {"animation.webp", "compare-pitch.csv", "pitch-paper.json", "robust-heaters.md"} <= set(shown)
    assert [name for name in shown if not (published.RESULTS / name).is_file()] == []
    commands = {name: published.maker(name) for name in shown}
    assert [name for name, command in commands.items() if command is None] == []
    for path in re.findall(r"python ((?:benchmarks|scripts)/\w+\.py)", " ".join(map(str, commands.values()))):
        assert (ROOT / path).is_file(), path
    assert "README.md" in shown["paper-cases.md"]
    assert f"Made on {published.made('unstable.md')} on " in (published.RESULTS / "unstable.md").read_text()


def test_badges_say_what_the_project_declares():
    assert {path.stem: path.read_text() for path in badges.FOLDER.glob("*.svg")} == badges.badges()


PAGE = """# Page

```bash
echo one >file
```

```text
nothing
```

<!-- not run: it fails -->
```python
1 / 0
```

```python
a = open("file").read().strip()
```

```bash
cat file
```

```python
print(a, __name__)
```
"""


def run(markdown, tmp_path):
    program = docs.program(Path("page.md"), docs.blocks(markdown))
    return subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=60)


def test_blocks_are_run_in_their_order_and_share_names(tmp_path):
    assert [block[2:] for block in docs.blocks(PAGE) if block.language == "python"] == [
        (13, "it fails"), (17, ""), (25, "")
    ]  # fmt: skip
    done = run(PAGE, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "-- page.md:13 not run: it fails" in done.stdout
    assert "one\n" in done.stdout.split("page.md:21")[1]
    assert done.stdout.endswith("one __main__\n")


@pytest.mark.parametrize(
    ("block", "text"),
    [("bash\nfalse\ntrue", "page.md:2 failed"), ("bash\nfalse | cat", "page.md:2 failed"), ("python\n1 / 0", "line 2")],
)
def test_a_block_that_fails_ends_its_page(tmp_path, block, text):
    done = run(f"```{block}\n```\n\n```bash\necho more\n```\n", tmp_path)
    assert done.returncode == 1
    assert text in done.stderr
    assert "more" not in done.stdout


def test_a_page_is_run_in_a_copy_of_its_own(tmp_path):
    markdown = "```bash\ntest -f jaxouter/train.py\n! test -e runs\nmkdir runs\n```\n"
    for _ in range(2):
        done = docs.outcome(Path("page.md"), docs.blocks(markdown), tmp_path)
        assert (done.run, done.failed) == (1, False)


NOTEBOOK = {
    "cells": [
        {"cell_type": "markdown", "id": "a", "metadata": {}, "source": ["# Page"]},
        {"cell_type": "code", "id": "b", "metadata": {}, "source": ["a = 1\n", "open('new', 'w').close()"]},
        {"cell_type": "code", "id": "c", "metadata": {"tags": ["remove-output"]}, "source": ["print(a)"]},
        {"cell_type": "code", "id": "d", "metadata": {}, "source": ["2 / a"]},
    ],
    "metadata": {"kernelspec": {"name": "python3", "display_name": "mine"}},
    "nbformat": 4,
    "nbformat_minor": 5,
}  # fmt: skip


def notebook(folder, last="2 / a"):
    """A notebook in this folder, before it has run."""
    cells = [each | {"outputs": [], "execution_count": None} for each in NOTEBOOK["cells"][1:]]
    cells[-1]["source"] = [last]
    path = folder / "page.ipynb"
    path.write_text(json.dumps(NOTEBOOK | {"cells": [NOTEBOOK["cells"][0], *cells]}))
    return path


def test_cells_of_a_notebook_are_its_code():
    found = docs.cells(json.dumps(NOTEBOOK))
    assert [(block.language, block.text, block.line) for block in found] == [
        ("python", "a = 1\nopen('new', 'w').close()", 2), ("python", "print(a)", 3), ("python", "2 / a", 4)
    ]  # fmt: skip


@pytest.mark.slow
def test_a_notebook_is_run_in_its_folder_and_kept_without_what_differs(tmp_path, monkeypatch):
    pytest.importorskip("nbclient")
    monkeypatch.setattr(docs, "ROOT", tmp_path)
    (tmp_path / "docs").mkdir()
    page = notebook(tmp_path / "docs")
    kept = []
    for last, failed in (("2 / a", False), ("2 / a", False), ("a / 0", True)):
        monkeypatch.setattr(docs, "copied", lambda copy, last=last: notebook(made(copy / "docs"), last))
        done = docs.outcome(Path("docs/page.ipynb"), docs.cells(page.read_text()), tmp_path / "place", write=True)
        assert (done.run, done.failed) == (3, failed)
        kept.append(page.read_text())
    assert kept[0] == kept[1] == kept[2]
    _, first, silent, last = json.loads(kept[0])["cells"]
    assert (first["outputs"], silent["outputs"], last["outputs"][0]["data"]) == ([], [], {"text/plain": ["2.0"]})
    assert (last["id"], last["metadata"]) == ("cell-4", {})
    assert "mine" not in kept[0]


def made(folder):
    """The folder, made."""
    folder.mkdir(parents=True)
    return folder


@pytest.mark.parametrize("path", sorted((ROOT / "docs").rglob("*.ipynb")), ids=lambda path: path.name)
def test_notebooks_are_small_and_name_no_machine(path):
    text = path.read_text()
    assert len(text) < 300_000
    assert docs.stable(json.loads(text)) == text
    assert not re.search(r"/(tmp|home|root|Users)/|iopub|20\d\d-\d\d-\d\dT", text)


def test_pages_that_are_none_are_refused(capsys):
    with pytest.raises(SystemExit):
        docs.main(["/etc/passwd"])
    assert "/etc/passwd is not a file of this checkout" in capsys.readouterr().err
