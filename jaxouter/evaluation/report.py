"""The report of a comparison: one HTML page that needs nothing but itself."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
import scipy

from jaxouter.evaluation.figures import symbol
from jaxouter.evaluation.metrics import significant
from jaxouter.evaluation.results import Comparison, LineSummary, StabilityRow, Summary
from jaxouter.evaluation.statistics import Line, lines, scenarios
from jaxouter.plants.base import in_words

KIND_NAMES = {
    "learned": "learned",
    "user": "user's",
    "baseline": "baseline",
    "limit": "limit, not ranked",
    "preview": "with preview, not ranked",
}
SCALE = 0.75  # of the pixels of a picture
SCRIPT = """
const select = document.getElementById("scenario"), image = document.getElementById("response");
const show = () => {
  const { uri, width, height } = select.selectedOptions[0].dataset;
  for (const table of document.querySelectorAll(".merits")) table.hidden = table.dataset.scenario !== select.value;
  if (!image) return;
  const figure = image.closest("figure"), name = select.selectedOptions[0].text;
  figure.hidden = !uri;
  if (!uri) return;
  image.src = uri; image.width = width; image.height = height;
  image.style.setProperty("--width", width + "px");
  const caption = `y of every policy with r and the limits, and r\\u0303 below: ${name}, first episode.`;
  image.alt = figure.querySelector("figcaption").textContent = caption;
};
select.addEventListener("change", show);
for (const link of document.querySelectorAll("[data-choose]"))
  link.addEventListener("click", () => { select.value = link.dataset.choose; show(); });
show();
"""
TERMS = (
    (
        "limit",
        "the least MAE of the policies within the limits that are made from the true plant, and of r̃ = r and static",
    ),
    ("with preview", "the least error of any r̃ within the bounds, knowing plant, state, noise and the whole reference"),
    ("outside the limits", "the limit of y, or of its change, is left in more than 0.1 % of the steps"),
    ("rank", "by MAE, among the learned, the users' and the baseline policies that keep the limits and do not diverge"),
)


class Merit(NamedTuple):
    """A figure of merit as the page shows it."""

    key: str
    title: str
    unit: str
    meaning: str


class Image(NamedTuple):
    """A picture as the page holds it, and the size at which it is shown: letters as large as the text beside it."""

    uri: str
    width: int
    height: int


class Cell(NamedTuple):
    """One field of the table of errors."""

    mae: float | None
    ratio: float | None
    out: bool
    mark: str  # class: best, out, diverged, or none
    why: str


class TableLine(NamedTuple):
    """One line of the table of errors."""

    label: str
    kind: str
    remark: str
    cells: list[Cell]
    mean_rank: float | None


class Radius(NamedTuple):
    """One field of the table of local stability."""

    radius: float | None  # the largest over set-points
    unstable: bool
    notes: list[int]  # numbers of the notes, from 1


class Radii(NamedTuple):
    """The table of local stability."""

    scenarios: list[str]
    cells: dict[str, list[Radius]]  # by policy
    notes: list[str]


def merits(y_unit: str, time_unit: str) -> list[Merit]:
    """The figures of merit in the order in which the page shows and defines them."""
    y, t = symbol(y_unit), time_unit
    return [
        Merit("mae", "MAE", y, "mean of e over steps and episodes"),
        Merit("ratio_to_limit", "ratio to the limit", "", "MAE over that of the limit"),
        Merit("ratio_to_bound", "ratio to the bound", "", "MAE over that of the policy with preview, a lower bound"),
        Merit("improvement", "improvement", "%", "of the MAE over the inner loop alone; not where that is unstable"),
        Merit("worse_than_static", "worse than static", "share", "share of the episodes whose MAE is above static's"),
        Merit("iae", "IAE", f"{y} {t}", "integral of e over an episode"),
        Merit("ise", "ISE", f"{y}² {t}", "integral of e²"),
        Merit("itae", "ITAE", f"{y} {t}²", "integral of t e over a set-point, t from its start"),
        Merit("overshoot", "overshoot", "%", "beyond the set-point, of the step; median over set-points"),
        Merit("settling_time", "settling time", t, "until e stays within 5 % of the step; median over set-points"),
        Merit("steady_state_error", "steady-state error", y, "|mean of r − y| over the last tenth of a set-point"),
        Merit("violation_time", "violation time", "share", "share of steps outside the limits of y or of its change"),
        Merit("violation_max", "largest violation", y, "largest excess over the limits"),
        Merit("swing", "swing", y, "standard deviation of r̃ over the second half of a set-point; the largest of them"),
        Merit("r_tilde_tv", "variation of r̃", y, "sum of |r̃ₖ − r̃ₖ₋₁| over an episode, the first move included"),
        Merit("episode_return", "return", "", "sum of the rewards of an episode"),
    ]


def figure(value: float | None) -> str:
    """A number with three digits; a dash where there is none."""
    return "–" if value is None else significant(value, 3)


def ratio(value: float | None) -> str:
    """A number as a multiple."""
    return "–" if value is None else f"{figure(value)}×"


def setting(value: Any) -> str:
    """A setting, numbers without digits that say nothing."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def short(scenario: str) -> str:
    """A scenario without its plant."""
    return scenario.split("/", 1)[-1]


def leaders(summary: Summary) -> tuple[str | None, str | None]:
    """The line that the answer is about, the best learned one if there is any, and the best of all others."""
    ranks = {label: line.mean_rank for label, line in summary.lines.items() if line.mean_rank is not None}
    by_rank = sorted(ranks, key=ranks.__getitem__)
    learned = [label for label in by_rank if summary.lines[label].kind == "learned"]
    about = next(iter(learned or by_rank), None)
    others = (label for label in by_rank if label not in (learned or [about]))
    return about, next(others, None)


def answer(summary: Summary, count: int) -> str:
    """Two sentences: which policy is best on so many scenarios, and how far from the limit it is."""
    ranked = {label: (line, line.mean_rank) for label, line in summary.lines.items() if line.mean_rank is not None}
    about, other = leaders(summary)
    if about is None:
        return "No policy was ranked. There is nothing to compare the limit with."
    own, rank = ranked[about]
    place = f"the lowest MAE within the limits in {own.first} of {_count(count, 'scenario')}, mean rank {figure(rank)}"
    if other is None:
        first = f"{about} has {place}; nothing else was ranked"
    else:
        theirs, their_rank = ranked[other]
        better, equal = rank < their_rank, rank == their_rank
        verdict = "is the best on the whole" if better else "shares the first place" if equal else "is not the best"
        which = "the next" if better else "its equal" if equal else "the best"
        against = f"{other}, {which}: {theirs.first}, mean rank {figure(their_rank)}"
        first = f"{about} {verdict}: {place} ({against})"
    if own.unranked:
        first += f"; it leaves the limits or diverges in {own.unranked}"
    return f"{first}. {_distance(own)}"


def conduct(own: Line, other: Line | None, unit: str) -> str:
    """How a policy rests, moves r~ and keeps the limits, beside another one."""
    names = [name for name in own.rows if other is None or name in other.rows]
    said, rest = [], next((name for name in names if short(name) == "rest"), "")
    swing = own.median(rest, "swing")
    if swing is not None:
        theirs = None if other is None else other.median(rest, "swing")
        beside = "" if other is None or theirs is None else f" ({other.label}: {figure(theirs)})"
        said.append(f"At rest its r̃ swings by {figure(swing)}{in_words(unit)}{beside}.")
    outside = {name: own.median(name, "violation_time") or 0.0 for name in own.rows}
    worst = max(outside, key=outside.__getitem__)
    kept = f"is outside the limits in up to {figure(100 * outside[worst])} % of the steps ({short(worst)})"
    kept = kept if outside[worst] else "never leaves the limits where it does not diverge"
    if other is not None:
        pairs = [(own.median(name, "r_tilde_tv"), other.median(name, "r_tilde_tv")) for name in names]
        moved = [one / two for one, two in pairs if one and two]
        if moved:
            kept = f"moves r̃ {ratio(float(scipy.stats.gmean(moved)))} as much as {other.label}, and {kept}"
    return " ".join([*said, f"It {kept}."])


def _distance(line: LineSummary) -> str:
    """The sentence about the limit."""
    ratios = {short(name): found.median for name, found in line.scenarios.items() if found.median is not None}
    if not ratios:
        return "How far it is from the limit is not known: the limit was not computed."
    least, most = min(ratios, key=ratios.__getitem__), max(ratios, key=ratios.__getitem__)
    if len(ratios) == 1:
        return f"Its MAE is {ratio(ratios[least])} the limit's ({least})."
    middle = ratio(float(np.median(list(ratios.values()))))
    lost = f"; it diverged in {len(line.scenarios) - len(ratios)}" if len(line.scenarios) > len(ratios) else ""
    return (
        f"Its MAE is {middle} the limit's in the median scenario, from {ratio(ratios[least])} ({least}) "
        f"to {ratio(ratios[most])} ({most}){lost}."
    )


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" + "s" * (n != 1)


def _table(comparison: Comparison, every: list[Line]) -> list[list[TableLine]]:
    """The table of errors: learned and users' policies, baselines, and those that are not ranked."""
    names = scenarios(comparison.rows)
    groups: list[list[TableLine]] = [[], [], []]
    for line in every:
        found = comparison.statistics.lines[line.label]
        remarks = {"limit": "the limit", "preview": "with preview"}
        remark = remarks.get(line.kind, f"{found.seeds} seeds" if found.seeds > 1 else "")
        cells = [_cell(line, name) for name in names]
        where = {"learned": 0, "user": 0, "baseline": 1}.get(line.kind, 2)
        groups[where].append(TableLine(line.label, line.kind, remark, cells, found.mean_rank))
    return groups


def _cell(line: Line, scenario: str) -> Cell:
    rows = line.rows.get(scenario, [])
    mae, limit = (line.median(scenario, key) for key in ("mae", "ratio_to_limit"))
    if mae is None:
        return Cell(None, None, False, "diverged" if rows else "", "")
    outside, lost = sum(not row.within_limits for row in rows), sum(bool(row.diverged) for row in rows)
    out = not line.within_limits(scenario)
    why = [
        f"{n} of {_count(len(rows), 'seed')} {what}"
        for n, what in ((outside, "outside the limits"), (lost, "diverged"))
    ]
    best = any(row.best for row in rows)
    said = "; ".join(text for text, n in zip(why, (outside, lost), strict=True) if n)
    return Cell(mae, limit, out, "best" if best else "out" if out else "", said)


def _radii(stability: Sequence[StabilityRow]) -> Radii | None:
    """The table of local stability; None where there is nothing to say."""
    if not stability:
        return None
    policies, names = dict.fromkeys(row.policy for row in stability), dict.fromkeys(row.scenario for row in stability)
    notes = list(dict.fromkeys(row.note for row in stability if row.note))
    cells: dict[str, list[Radius]] = {}
    for policy in policies:
        for name in names:
            rows = [row for row in stability if (row.policy, row.scenario) == (policy, name)]
            largest = max((row.spectral_radius for row in rows if row.spectral_radius is not None), default=None)
            own = sorted({notes.index(row.note) + 1 for row in rows if row.note})
            cells.setdefault(policy, []).append(Radius(largest, largest is not None and largest >= 1, own))
    return Radii(list(names), cells, notes)


def _machine(machine: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What the results depend on, as pairs of text."""
    found = []
    for key, value in machine.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{name} {item}" for name, item in value.items() if item not in ("", None))
        found.append((key, str(value)))
    return found


def _image(path: Path) -> Image:
    data = path.read_bytes()
    width, height = (int.from_bytes(data[i : i + 4], "big") for i in (16, 20))  # the PNG's header
    return Image(
        "data:image/png;base64," + base64.b64encode(data).decode(), round(SCALE * width), round(SCALE * height)
    )


def _contents(comparison: Comparison, figures: Mapping[str, Path]) -> list[tuple[str, str]]:
    """Anchors and titles of the sections that are there."""
    sections = {
        "errors": "Errors",
        "statistics": "Over seeds",
        "responses": "Time responses",
        "effort": "Effort" if "effort" in figures else "",
        "sweeps": "Sweeps" if any(name.startswith("sweep ") for name in figures) else "",
        "stability": "Stability" if comparison.stability else "",
        "policies": "Policies",
        "definitions": "Definitions",
        "made": "How this was made",
    }
    return [(anchor, title) for anchor, title in sections.items() if title]


def write(path: Path, comparison: Comparison, figures: Mapping[str, Path], responses: Mapping[str, Path]) -> Path:
    """Write the page.

    Args:
        path: HTML file.
        comparison: the content of comparison.json.
        figures: PNGs by the ids of `jaxouter.evaluation.comparison_figures.draw`; another key is a caption.
        responses: PNG of the time responses, by scenario.

    Returns:
        `path`.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxouter.evaluation", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure": figure, "ratio": ratio, "short": short, "setting": setting}
    every = lines(comparison.rows, comparison.policies)
    names = scenarios(comparison.rows)
    about, other = (
        next((line for line in every if line.label == label), None) for label in leaders(comparison.statistics)
    )
    known = {name: figures.get(name) for name in ("errors", "effort", "stability")}
    page = environment.get_template("report.html.j2").render(
        plant=comparison.plant,
        unit=symbol(comparison.y_unit),
        date=comparison.date,
        seconds=comparison.seconds,
        family_seed=comparison.family_seed,
        command=comparison.command,
        machine=_machine(comparison.machine),
        policies=dict(sorted(comparison.policies.items(), key=lambda item: list(KIND_NAMES).index(item[1].kind))),
        kinds=KIND_NAMES,
        statistics=comparison.statistics,
        answer=answer(comparison.statistics, len(names)),
        conduct=conduct(about, other, symbol(comparison.y_unit)) if about else "",
        limited=bool(comparison.statistics.scenarios),
        scenarios=names,
        lines=every,
        table=_table(comparison, every),
        merits=merits(comparison.y_unit, comparison.time_unit),
        terms=TERMS,
        radii=_radii(comparison.stability),
        contents=_contents(comparison, figures),
        figures={name: _image(image) if image else None for name, image in known.items()},
        sweeps=[(key.removeprefix("sweep "), _image(png)) for key, png in figures.items() if key.startswith("sweep ")],
        further=[
            (key, _image(png)) for key, png in figures.items() if key not in known and not key.startswith("sweep ")
        ],
        responses={name: _image(png) for name, png in responses.items()},
        shown=next((name for name in names if name in responses), names[0]),
        script=SCRIPT,
        script_hash="sha256-" + base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    return path
