"""The README's badges, as files that need no network: Python versions, version, licence.

python scripts/badges.py
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import tyro

import jaxouter
from jaxouter import cli

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "badges"
LETTER, MARGIN, HEIGHT = 6.6, 12, 20  # px
BADGE = """\
<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" role="img" aria-label="{name}: {value}">
<title>{name}: {value}</title>
<clipPath id="round"><rect width="{width}" height="{height}" rx="3"/></clipPath>
<g clip-path="url(#round)"><rect width="{left}" height="{height}" fill="#555"/>
<rect x="{left}" width="{right}" height="{height}" fill="#1f5f99"/></g>
<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11" text-anchor="middle">
<text x="{of_name}" y="14">{name}</text><text x="{of_value}" y="14">{value}</text></g>
</svg>
"""


def badges() -> dict[str, str]:
    """SVG of each badge, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    least, above = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", project["requires-python"]).groups()
    python = f"3.{least} to 3.{int(above) - 1}"
    values = {"python": python, "version": jaxouter.__version__, "licence": project["license"]}
    return {name: badge(name, value) for name, value in values.items()}


def badge(name: str, value: str) -> str:
    """SVG of a badge."""
    left, right = (round(LETTER * len(text)) + MARGIN for text in (name, value))
    places = {"left": left, "right": right, "of_name": left / 2, "of_value": left + right / 2}
    return BADGE.format(name=name, value=value, width=left + right, height=HEIGHT, **places)


def main() -> None:
    """The command."""
    FOLDER.mkdir(exist_ok=True)
    for name, svg in badges().items():
        (FOLDER / f"{name}.svg").write_text(svg)


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
