"""Pictures of a comparison: errors, effort, sweeps, local stability and time responses of every policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from jaxouter.evaluation.drawing import Axes, Figure, Line2D, LogNorm, SubFigure
from jaxouter.evaluation.figures import (
    LIMIT,
    REFERENCE,
    keep,
    legend,
    log_axis,
    output_range,
    styled,
    symbol,
    times,
)
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.results import Comparison, StabilityRow, SweepErrors
from jaxouter.evaluation.rollout import Traces
from jaxouter.evaluation.scenarios import Scenario, reported
from jaxouter.evaluation.statistics import Line, lines, on_grid, scenarios
from jaxouter.loop.references import FAMILIES
from jaxouter.plants.base import in_words
from jaxouter.tasks import Axis


class Style(NamedTuple):
    """How a policy is drawn, the same in every figure."""

    color: str
    ls: Any
    marker: str
    lw: float = 1.3
    zorder: float = 3.0


GAPS = (7, 14, 24, 36, 50)  # between a point and its label, in points of the printer
DASHED, DOTTED, DASHDOT, DASHDOTDOT = (0, (5, 2)), (0, (1, 1.3)), (0, (6, 1.5, 1.2, 1.5)), (0, (4, 1.2, 1, 1.2, 1, 1.2))
STYLES = {  # after Okabe and Ito, which the colour-blind tell apart; line and marker differ too
    "learned": Style("#0b6fb8", "-", "o", 2.6, 5.0),
    "none": Style("#8a8a8a", "-", "X"),
    "static": Style("#c98500", DASHED, "s"),
    "lq": Style("#b2182b", "-", "^"),
    "lq-return": Style("#e08a7d", DASHED, "<"),
    "pi": Style("#009e73", DASHDOT, "^"),
    "mpc": Style("#c4548f", "-", "D"),
    "deepc": Style("#d55e00", DASHDOTDOT, "v"),
    "inverse": Style("#7b5bb5", DASHED, "P"),
    "oracle": Style("#111111", DASHED, "*", 1.5, 4.0),
    "lq-exact": Style("#555555", DASHED, "1", 1.5, 4.0),
    "mpc-exact": Style("#555555", DASHDOT, "2", 1.5, 4.0),
    "clairvoyant": Style("#111111", DOTTED, "d", 1.5, 4.0),
}
LEARNED = (  # further runs of the learned policy
    STYLES["learned"],
    Style("#56b4e9", "-", "h", 2.2, 4.8),
    Style("#1d3f72", DASHED, "p", 2.2, 4.7),
    Style("#4a90b8", DASHDOT, "8", 2.2, 4.6),
)
OTHERS = (  # users' policies
    Style("#882255", DASHDOT, "<"),
    Style("#7a8b00", DASHED, ">"),
    Style("#8c510a", DASHDOTDOT, "H"),
    Style("#44aa99", "-", "p"),
)


def styles(names: Sequence[str]) -> dict[str, Style]:
    """The style of each policy or line of a comparison; give all names, so that the rest keep theirs."""
    learned, others = cycle(LEARNED), cycle(OTHERS)
    found = {}
    for name in dict.fromkeys(names):
        rest = learned if name.split(" ")[0] == "learned" else others
        found[name] = STYLES[name] if name in STYLES else next(rest)
    return found


def _styles(comparison: Comparison) -> dict[str, Style]:
    labels = [line.label for line in lines(comparison.rows, comparison.policies)]
    others = [name for sweep in comparison.sweeps.values() for name in sweep.policies]
    return styles([*labels, *others, *(row.policy for row in comparison.stability)])


def _plain(name: str) -> str:
    """A name as figures print it: it may be a file's, with dollars, or an underscore that would hide it."""
    return (" " if name.startswith("_") else "") + name.replace("$", r"\$")


def _short(scenario: str) -> str:
    return scenario.split("/", 1)[-1]


def _legend(
    figure: Figure, shown: Mapping[str, Style], lines_too: bool = True, more: Sequence[Any] = (), most: int = 6
) -> None:
    """One legend for the whole figure: the policies, and `more`."""
    handles = [
        Line2D([], [], color=s.color, ls=s.ls if lines_too else "", lw=s.lw, marker=s.marker, ms=6, label=_plain(name))
        for name, s in shown.items()
    ]
    legend(figure, [*handles, *more], most)


def errors(path: Path, comparison: Comparison, unstable: Sequence[str] = ()) -> Path:
    """MAE of every policy on every scenario as a multiple of the limit (without a limit: the MAE itself).

    Args:
        path: PNG.
        comparison: what is drawn.
        unstable: scenarios whose plant is unstable alone. They stand apart, with an axis of their own.
    """
    every = lines(comparison.rows, comparison.policies)
    look = _styles(comparison)
    limited = any(row.ratio_to_limit is not None for row in comparison.rows)
    key = "ratio_to_limit" if limited else "mae"
    every = [line for line in every if not (limited and line.kind == "limit")]  # 1 by definition
    every_name = scenarios(comparison.rows)
    apart = [name for name in every_name if name in unstable]
    groups = list(filter(None, ([name for name in every_name if name not in apart], apart)))
    heights = [len(names) for names in groups]
    figure = Figure(figsize=(9, 1.6 + 0.46 * sum(heights) + 0.6 * len(apart[:1])), layout="constrained")
    offsets = np.linspace(-0.3, 0.3, len(every)) if len(every) > 1 else [0.0]
    grid = figure.subplots(len(groups), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axes, names in zip(grid, groups, strict=True):
        for i, name in enumerate(names):
            axes.axhspan(i - 0.5, i + 0.5, color="#f3f3f3" if i % 2 == 0 else "#ffffff", lw=0, zorder=0)
            for offset, line in zip(offsets, every, strict=True):
                _dot(axes, line, look[line.label], name, key, i + offset)
        log_axis(axes, "x")
        if limited:
            axes.axvline(1.0, color="#111111", ls=DASHED, lw=1.2, zorder=2)
        axes.set_yticks(range(len(names)), [_short(name) for name in names])
        axes.set_ylim(len(names) - 0.5, -0.5)
        if names == apart:
            axes.set_title("unstable alone", fontsize=10, loc="left")
    grid[-1].set_xlabel("MAE as a multiple of the limit's" if limited else f"MAE [{symbol(comparison.y_unit)}]")
    hollow = Line2D([], [], color="#555555", marker="o", mfc="white", ls="", ms=6, label="hollow: outside the limits")
    limit = [Line2D([], [], color="#111111", ls=DASHED, lw=1.2, label="the limit")] if limited else []
    diverged = Line2D([], [], ls="", marker="$\\rightarrow$", color="#555555", ms=8, label="diverged")
    shown = {line.label: look[line.label] for line in every}
    _legend(figure, shown, lines_too=False, more=[*limit, hollow, diverged], most=5)
    return keep(styled(figure), path)


def _dot(axes: Axes, line: Line, style: Style, scenario: str, key: str, height: float) -> None:
    """Median over seeds with their range; an arrow at the right edge where diverged."""
    values, middle = line.values(scenario, key), line.median(scenario, key)
    size = 9 if line.kind == "learned" else 6.5
    if len(values) == 0 or np.isnan(values).all():
        return
    if middle is None:
        edge = axes.get_yaxis_transform()
        axes.plot(
            [0.985], [height], marker="$\\rightarrow$", color=style.color, ms=size, transform=edge, zorder=style.zorder
        )
        return
    finite = values[np.isfinite(values)]
    axes.plot([finite.min(), finite.max()], [height, height], color=style.color, lw=1.5, zorder=style.zorder)
    face = style.color if line.within_limits(scenario) else "white"
    axes.plot(
        [middle], [height], color=style.color, marker=style.marker, ms=size, mfc=face, mew=1.3, zorder=style.zorder + 1
    )


def effort(path: Path, comparison: Comparison) -> Path:
    """Total variation of r~ against MAE: a panel for each of the paper's scenarios, for the families and for the rest.

    Where a panel stands for several scenarios it shows geometric means over them.
    """
    every, look = lines(comparison.rows, comparison.policies), _styles(comparison)
    panels = _panels(comparison)
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.9 * columns, 3.5 * rows), layout="constrained")
    grid = np.ravel(figure.subplots(rows, columns, squeeze=False))
    unit = symbol(comparison.y_unit)
    shown = []
    for axes, (title, names) in zip(grid, panels.items(), strict=False):
        points, missing = {}, []
        for line in every:
            x, y = (_mean_over(line, names, key) for key in ("mae", "r_tilde_tv"))
            if x is None or y is None:
                missing += [line.label]
                continue
            points[line.label] = x, y
            style, size = look[line.label], 9 if line.kind == "learned" else 6.5
            axes.plot(x, y, marker=style.marker, color=style.color, ms=size, ls="", zorder=style.zorder)
        axes.margins(0.16)
        log_axis(axes, "x")
        log_axis(axes, "y")
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_xlabel(f"MAE [{unit}]" + "\ndiverged: " * bool(missing) + ", ".join(map(_plain, missing)))
        axes.set_ylabel(f"variation of r̃ an episode [{unit}]")
        shown.append((axes, points))
    for axes in grid[len(panels) :]:
        figure.delaxes(axes)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # labels find their places in a layout that stays
    for axes, points in shown:
        _label(figure, axes, points, look)
    return keep(styled(figure), path)


def _mean_over(line: Line, names: Sequence[str], key: str) -> float | None:
    """Geometric mean over scenarios of the medians over seeds; None where one is missing."""
    values = [line.median(name, key) for name in names]
    if any(value is None for value in values):
        return None
    return float(scipy.stats.gmean(np.array(values, float)))


def _panels(comparison: Comparison) -> dict[str, list[str]]:
    """Scenarios of each panel, by title."""
    names = scenarios(comparison.rows)
    families = [name for name in names if _short(name) in FAMILIES]
    paper = [name for name in names if name in reported(comparison.plant) and name not in families]
    rest = [name for name in names if name not in families + paper]
    panels = {_short(name): [name] for name in paper}
    for title, group in (("families", families), ("others", rest)):
        if group:
            panels[f"{title}: mean of {len(group)}" if len(group) > 1 else _short(group[0])] = group
    return panels


def _label(figure: Figure, axes: Axes, points: Mapping[str, tuple[float, float]], look: Mapping[str, Style]) -> None:
    """Names near their points, each at the nearest free place, with a thin line where that is not beside it."""
    pixel = figure.dpi / 72
    spots = {name: axes.transData.transform(point) for name, point in points.items()}
    taken = [np.concatenate([spot - 5 * pixel, spot + 5 * pixel]) for spot in spots.values()]
    frame = np.array(axes.get_window_extent().extents)
    for name, spot in spots.items():
        leader = {"arrowstyle": "-", "lw": 0, "color": look[name].color}
        text = axes.annotate(_plain(name), points[name], xytext=(0, 0), textcoords="offset points", arrowprops=leader)
        bold = "bold" if name.split(" ")[0] == "learned" else "normal"
        text.set(ha="center", va="center", fontsize=8.5, color=look[name].color, fontweight=bold, zorder=7)
        extent = text.get_window_extent()
        half = np.array([extent.width, extent.height]) / 2
        centre, gap = _free_place(spot, half, taken, frame, pixel)
        taken.append(np.concatenate([centre - half, centre + half]))
        text.xyann = tuple((centre - spot) / pixel)
        if text.arrow_patch is not None and gap > GAPS[0]:
            text.arrow_patch.set(lw=0.6)


def _free_place(
    spot: np.ndarray, half: np.ndarray, taken: Sequence[np.ndarray], frame: np.ndarray, pixel: float
) -> tuple[np.ndarray, float]:
    """Centre of a label of half-size `half` (2,) around `spot` (2,), and its gap to it in points."""
    best, least = (spot, GAPS[0]), np.inf
    for gap in GAPS:
        for turn in np.linspace(0, 2 * np.pi, 24, endpoint=False):
            way = np.array([np.cos(turn), np.sin(turn)])
            centre = spot + way * gap * pixel + way / np.abs(way).max() * half
            area = np.concatenate([centre - half, centre + half])
            outside = (area[:2] < frame[:2]).any() or (area[2:] > frame[2:]).any()
            cost = sum(_overlap(area, other) for other in taken) + 1e5 * outside + gap * pixel
            if cost < least:
                best, least = (centre, gap), cost
    return best


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def sweep(path: Path, comparison: Comparison, identifier: str) -> Path:
    """MAE over a swept parameter, relative to the policy's own nominal and to the best baseline there."""
    content = comparison.sweeps[identifier]
    draw = _curves if len(content.axes) == 1 else _maps
    return keep(styled(draw(content, _styles(comparison))), path)


class _Ratios(NamedTuple):
    """MAE of one policy on its own grid, and relative to the best baseline on the grid of the baselines."""

    own: np.ndarray
    baseline: np.ndarray | None


def _ratios(content: SweepErrors, name: str) -> _Ratios:
    """Both ratios; nan where the policy diverged, infinite never. The nominal is the grid's point nearest to it."""
    swept, best = content.policies[name], content.best_baseline
    values = swept.grid
    nearest = tuple(
        int(np.argmin(np.abs(np.array(v) - axis.nominal))) for v, axis in zip(swept.values, content.axes, strict=True)
    )
    baseline = None if best is None else on_grid(swept, best.values) / best.grid
    return _Ratios(values / values[nearest], baseline)


def _axis_label(axis: Axis) -> str:
    return axis.name + in_words(symbol(axis.unit), " [{}]")


def _curves(content: SweepErrors, look: Mapping[str, Style]) -> Figure:
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    axis, names = content.axes[0], list(content.policies)
    panels = [("relative to the policy's own nominal", 0), ("relative to the best baseline there", 1)]
    for axes, (title, which) in zip(figure.subplots(1, 2), panels, strict=True):
        lost = 0
        for name in names:
            s, swept, ratio = look[name], content.policies[name], _ratios(content, name)[which]
            grid = swept if which == 0 else content.best_baseline
            if ratio is None or grid is None:
                continue
            x = np.array(grid.values[0], float)
            mark = max(1, len(x) // 8)
            axes.plot(x, ratio, color=s.color, ls=s.ls, lw=s.lw, zorder=s.zorder, marker=s.marker, ms=4, markevery=mark)
            gone = np.array(swept.values[0], float)[np.isnan(swept.grid)]
            if len(gone):
                lost += 1
                height = np.full(len(gone), 1.0 + 0.028 * lost)
                axes.plot(
                    gone, height, "|", color=s.color, ms=4, mew=1.4, transform=axes.get_xaxis_transform(), clip_on=False
                )
        axes.axhline(1.0, color="#555555", lw=0.8, zorder=1)
        axes.axvline(axis.nominal, color="#555555", lw=0.9, ls=DOTTED, zorder=1)
        axes.annotate(
            "nominal", (axis.nominal, 0.97), xycoords=("data", "axes fraction"), xytext=(3, 0),
            textcoords="offset points", fontsize=7.5, color="#555555",
        )  # fmt: skip
        log_axis(axes, "y")
        if min(axis.values) > 0 and max(axis.values) > 100 * min(axis.values):
            log_axis(axes, "x")
        axes.set_xlabel(_axis_label(axis))
        axes.set_ylabel("MAE ratio")
        axes.set_title(f"MAE {title}", fontsize=10, loc="left", pad=6 + 8 * lost)
    gone = Line2D([], [], ls="", marker="|", color="#555555", ms=6, mew=1.4, label="above the frame: diverged")
    _legend(figure, {name: look[name] for name in names}, more=[gone])
    return figure


def _maps(content: SweepErrors, look: Mapping[str, Style]) -> Figure:
    names = list(content.policies)
    ratios = {name: _ratios(content, name) for name in names}
    own = {name: found.own for name, found in ratios.items()}
    baseline = {name: found.baseline for name, found in ratios.items() if found.baseline is not None}
    columns = min(5, len(names))
    rows = -(-len(names) // columns)
    both = 2 if baseline else 1
    figure = Figure(figsize=(1.9 * columns + 1.3, both * (1.9 * rows + 0.75)), layout="constrained")
    blocks = np.ravel(np.array(figure.subfigures(both, 1, squeeze=False)))
    _block(blocks[0], content, own, look, columns, "MAE relative to the policy's own nominal", "cividis")
    if baseline:
        _block(blocks[1], content, baseline, look, columns, "MAE relative to the best baseline there", "RdBu_r")
    return figure


def _block(
    block: SubFigure,
    content: SweepErrors,
    ratios: Mapping[str, np.ndarray],
    look: Mapping[str, Style],
    columns: int,
    title: str,
    cmap: str,
) -> None:
    """One heat map a policy, with one colour bar: from 1 on, or of a diverging map around 1."""
    flat = np.concatenate([np.ravel(values) for values in ratios.values()])
    flat = np.maximum(flat, 1 / flat)[np.isfinite(flat)]
    top = float(np.clip(np.quantile(flat, 0.98), 1.5, 30.0)) if len(flat) else 1.5
    bottom = 1.0 if cmap == "cividis" else 1 / top
    rows = -(-len(ratios) // columns)
    grid = block.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in np.ravel(grid)[len(ratios) :]:
        block.delaxes(axes)
    for i, (axes, (name, values)) in enumerate(zip(np.ravel(grid), ratios.items(), strict=False)):
        source = content.policies[name] if cmap == "cividis" else content.best_baseline
        assert source is not None
        mesh = _map(axes, content, source.values, values, LogNorm(bottom, top), cmap)
        axes.set_title(_plain(name), fontsize=9.5, loc="left", color=look[name].color, fontweight="bold")
        axes.tick_params(labelsize=8, labelbottom=i + columns >= len(ratios))
        if i == 0:
            bar = block.colorbar(mesh, ax=grid, extend="both", pad=0.015, aspect=12 * rows)
            ticks = [tick for tick in (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20) if bottom <= tick <= top]
            bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
            bar.ax.minorticks_off()
    block.suptitle(title, fontsize=11, x=0.01, ha="left")
    block.supxlabel(_axis_label(content.axes[1]), fontsize=9.5)
    block.supylabel(_axis_label(content.axes[0]), fontsize=9.5)


def _map(
    axes: Axes, content: SweepErrors, grid: Sequence[Sequence[float]], values: np.ndarray, norm: Any, cmap: str
) -> Any:
    """One heat map; hatched grey where there is no value. The first axis goes up, the second to the right."""
    edges = [_edges(np.array(axis, float)) for axis in grid]
    axes.set_facecolor("#d9d9d9")
    axes.patch.set_hatch("////")
    axes.patch.set_edgecolor("#a0a0a0")
    mesh = axes.pcolormesh(edges[1], edges[0], np.ma.masked_invalid(values), norm=norm, cmap=cmap, zorder=2)
    swept = [axis.values for axis in content.axes]  # grids differ from policy to policy, frames must not
    axes.set(xlim=(min(swept[1]), max(swept[1])), ylim=(min(swept[0]), max(swept[0])))
    nominal = [axis.nominal for axis in content.axes]
    axes.plot(nominal[1], nominal[0], marker="+", color="#d1701f", ms=10, mew=2, clip_on=False, zorder=5)
    return mesh


def _edges(centres: np.ndarray) -> np.ndarray:
    """Edges of cells around the centres; the outer ones are as wide as their neighbours' halves."""
    if len(centres) == 1:
        return np.array([centres[0] - 0.5, centres[0] + 0.5])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def responses(path: Path, scenario: Scenario, traces: Mapping[str, Traces], names: Sequence[str] = ()) -> Path:
    """The first episode under every policy: r, y and the limits above, r~ below.

    Args:
        path: PNG.
        scenario: what they ran on.
        traces: by the policy's name.
        names: every name of the comparison, so that colours are those of the other figures.
    """
    look = styles([*(names or traces)])
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1.25, 1.0))
    first = next(iter(traces.values()))
    t, unit, plant = times(scenario, first.r.shape[1]), symbol(scenario.plant.y_unit), scenario.plant
    handles = []
    for name, own in traces.items():
        s = look[name]
        label = _plain(name) + (f" {mae(own):.3g}" if np.isfinite(own.y).all() else ", diverged")
        style: dict[str, Any] = dict(color=s.color, ls=s.ls, lw=s.lw, zorder=s.zorder)
        top.plot(t, np.append(own.y0[0], own.y[0]), **style)
        handles += [Line2D([], [], label=label, **style)]
        bottom.step(t, np.append(own.r_tilde[0], own.r_tilde[0, -1]), where="post", **style | dict(lw=0.8 * s.lw))
    outer = [own for name, own in traces.items() if name != "none"]  # the inner loop alone may leave the picture
    top.set_ylim(*output_range(scenario, outer or [first]))
    (r,) = top.step(t, np.append(first.r[0], first.r[0, -1]), where="post", color=REFERENCE, lw=1.1, zorder=6)
    r.set_label("reference r")
    limits = [] if plant.output_limit is None else [-plant.output_limit, plant.output_limit]
    red: dict[str, Any] = dict(color=LIMIT, ls=DOTTED, lw=1.2)
    for axes, bounds in ((top, limits), (bottom, plant.r_tilde_bounds)):
        for bound in bounds:
            axes.axhline(bound, **red)
    top.set_ylabel(f"y [{unit}]")
    bottom.set_ylabel(f"r̃ [{unit}]")
    bottom.set_xlabel(f"time [{plant.time_unit}]")
    bottom.set_xlim(t[0], t[-1])
    rate = "" if plant.rate_limit is None else f"; |Δy| may be {plant.rate_limit:g} {unit}/{plant.time_unit}"
    top.set_title(f"{scenario.id}, first of {len(first.y)} episodes{rate}", fontsize=10, loc="left")
    handles += [r, Line2D([], [], label="limits of y, bounds of r̃" if limits else "bounds of r̃", **red)]
    title = f"MAE of all episodes [{unit}]"
    figure.legend(handles=handles, loc="outside right upper", fontsize=9, frameon=False, title=title, title_fontsize=9)
    return keep(styled(figure), path)


def stability(path: Path, comparison: Comparison) -> Path:
    """Spectral radius of the linearised closed loop over set-points, a panel a scenario; above 1 it is unstable."""
    rows = [row for row in comparison.stability if row.spectral_radius is not None]
    names, policies = list(dict.fromkeys(row.scenario for row in rows)), dict.fromkeys(row.policy for row in rows)
    look = _styles(comparison)
    columns = min(3, len(names))
    height = -(-len(names) // columns)
    figure = Figure(figsize=(3.4 * columns + 0.2, 2.4 * height + 1.0), layout="constrained")
    grid = figure.subplots(height, columns, squeeze=False, sharex=True)
    for axes in np.ravel(grid)[len(names) :]:
        figure.delaxes(axes)
    for i, (axes, name) in enumerate(zip(np.ravel(grid), names, strict=False)):
        for policy in policies:
            own = [row for row in rows if (row.policy, row.scenario) == (policy, name)]
            if own:
                _radii(axes, own, look[policy])
        low, high = axes.get_ylim()
        low, high = min(low, 1 - 0.1 * (1 - low)), max(high, 1 + 0.12 * (1 - low))
        axes.axhspan(1.0, high, color=LIMIT, alpha=0.08, lw=0)
        axes.axhline(1.0, color=LIMIT, ls=DOTTED, lw=1.2)
        axes.set_ylim(low, high)
        axes.set_title(_short(name), fontsize=10, loc="left")
        if i + columns >= len(names):
            axes.set_xlabel(f"set-point [{symbol(comparison.y_unit)}]")
            axes.tick_params(labelbottom=True)
        if i % columns == 0:
            axes.set_ylabel("spectral radius")
    unstable = Line2D([], [], ls="", marker="o", mfc="white", mec=LIMIT, ms=6, mew=1.4, label="hollow red: unstable")
    _legend(figure, {policy: look[policy] for policy in policies}, more=[unstable])
    return keep(styled(figure), path)


def _radii(axes: Axes, rows: Sequence[StabilityRow], style: Style) -> None:
    x, radius = np.array(sorted((row.set_point, row.spectral_radius) for row in rows)).T
    axes.plot(x, radius, color=style.color, ls=style.ls, lw=style.lw, marker=style.marker, ms=4, zorder=style.zorder)
    bad = radius > 1
    mark: dict[str, Any] = dict(marker=style.marker, ls="", ms=5, mfc="white", mec=LIMIT, mew=1.3)
    axes.plot(x[bad], radius[bad], **mark, zorder=style.zorder + 0.1)


def draw(folder: Path, comparison: Comparison, unstable: Sequence[str] = ()) -> dict[str, Path]:
    """Every figure of a comparison but the time responses, by the id that the report knows it by; see `errors`."""
    found = {"errors": errors(folder / "errors.png", comparison, unstable)}
    found |= {"effort": effort(folder / "effort.png", comparison)}
    for identifier in comparison.sweeps:
        path = folder / f"sweep-{_short(identifier).replace('/', '-')}.png"
        found[f"sweep {identifier}"] = sweep(path, comparison, identifier)
    if any(row.spectral_radius is not None for row in comparison.stability):
        found["stability"] = stability(folder / "stability.png", comparison)
    return found
