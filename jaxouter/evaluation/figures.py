"""Pictures of a run: the learning curve and the time responses, in the manner of the paper's figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from jaxouter.evaluation.drawing import DPI, Axes, Figure, FigureCanvasAgg, LogLocator, NullFormatter, rc_context
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rollout import Traces
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.identification.validation import COHERENT, Validation
from jaxouter.plants import Plant
from jaxouter.plants.base import in_words

INNER, LEARNED, REFERENCE, MODIFIED, LIMIT = "#8a8a8a", "#0b6fb8", "#111111", "#d1701f", "#b3261e"
UNITS = {"degC": "°C"}
HELD_OUT_ROWS = 600  # that are drawn
LIVE_ROWS = 600  # the same, at either end
FAR = 4.0  # levels above so many times the largest MAE are not drawn: the curves would be flat
LETTER, HANDLE = 0.067, 0.62  # widths in a legend, inches
LIMITS: dict[str, Any] = dict(color=LIMIT, ls=":", lw=1.2, label="limits of y, bounds of r̃")
SET_POINT = "reference r"
STAYS = (SET_POINT, str(LIMITS["label"]))  # lines that an animation shows from the beginning
FRAMES, SECONDS = 60, 6  # of an animation
WIDE, NARROW = (dict[str, Any](color=LEARNED, alpha=alpha, lw=0) for alpha in (0.12, 0.25))


def styled(figure: Figure) -> Figure:
    """The figure in the style of all figures."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.6)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write the figure, in the format that the path's suffix names; makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return path


def keep(figure: Figure, path: Path) -> Path:
    """Write a figure of a run or a report as PNG, to the path that is returned, and as SVG beside it."""
    with rc_context({"svg.hashsalt": "jaxouter"}):  # else each time another file
        figure.savefig(save(figure, path).with_suffix(".svg"), metadata={"Date": None})
    return path


def animate(figure: Figure, path: Path) -> Path:
    """Write a figure of responses over time as an animation (.webp), in which they run along from left to right."""
    from PIL import Image  # comes with matplotlib

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = np.array(canvas.buffer_rgba())[..., :3]
    for axes in figure.axes:
        for artist in (*axes.lines, *axes.collections, *axes.texts):
            artist.set_visible(str(artist.get_label()) in STAYS)
    canvas.draw()
    empty, height = np.array(canvas.buffer_rgba())[..., :3], drawn.shape[0]
    frames = []
    for share in np.linspace(0.0, 1.0, FRAMES):
        frame = drawn.copy()
        for box in (axes.bbox for axes in figure.axes):
            begin, rows = int(box.x0 + share * box.width), slice(int(height - box.y1), int(height - box.y0))
            frame[rows, begin : int(box.x1)] = empty[rows, begin : int(box.x1)]
        frames.append(Image.fromarray(frame))
    path.parent.mkdir(parents=True, exist_ok=True)
    milliseconds = [*[SECONDS * 1000 // FRAMES] * (FRAMES - 1), 1500]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, quality=70, method=0)
    return path


def log_axis(axes: Axes, which: str) -> None:
    """Log axis with plain numbers, as many as there is room for."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    subs = (1.0, 2.0, 5.0) if decades < 2.5 else (1.0, 3.0) if decades < 4 else (1.0,)
    subs = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0) if decades < 0.9 else subs
    axis.set_major_locator(LogLocator(subs=subs, numticks=20))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def symbol(unit: str) -> str:
    """A unit as it is written in a figure."""
    return UNITS.get(unit, unit)


def times(scenario: Scenario, steps: int) -> np.ndarray:
    """Times of the samples 0..steps, in the plant's unit."""
    return scenario.plant.control_step * np.arange(steps + 1)


def legend(figure: Figure, handles: Sequence[Any] | None = None, most: int = 6) -> None:
    """One legend for the whole figure, below it, in as many columns as there is room for.

    Args:
        figure: with all its axes.
        handles: with their labels; None: those of the axes, each label once.
        most: columns.
    """
    if handles is None:
        drawn = [handle for axes in figure.axes for handle in axes.get_legend_handles_labels()[0]]
        handles = [*{str(handle.get_label()): handle for handle in reversed(drawn)}.values()][::-1]
    widths = [HANDLE + LETTER * len(str(handle.get_label())) for handle in handles]
    wide = {n: sum(map(max, np.array_split(widths, n))) for n in range(min(len(handles), most), 1, -1)}
    columns = next((n for n, width in wide.items() if width < figure.get_figwidth()), 1)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=8.5, frameon=False)


def response(scenarios: Sequence[Scenario], inner: Mapping[str, Traces], learned: Mapping[str, Traces]) -> Figure:
    """The first episode of each scenario, a column each: r and y, alone and with the learned outer loop, above r~.

    A plant with a rate limit has a third row, the changes of y from one control step to the next.

    Args:
        scenarios: one or two of a plant.
        inner, learned: by the scenarios' ids.
    """
    plant = scenarios[0].plant
    rates = plant.rate_limit is not None
    heights = (1.6, 1.0, 1.0) if rates else (1.6, 1.0)
    figure = Figure(figsize=(2.0 + 4.6 * len(scenarios), 1.2 + 1.7 * sum(heights)), layout="constrained")
    grid = figure.subplots(len(heights), len(scenarios), sharex="col", squeeze=False, height_ratios=heights)
    unit, time = symbol(plant.y_unit), plant.time_unit
    for column, scenario in zip(grid.T, scenarios, strict=True):
        alone, own = inner[scenario.id], learned[scenario.id]
        _outputs(column[0], scenario, alone, own)
        _modified(column[1], scenario, own)
        if rates:
            _changes(column[2], scenario, own)
            column[2].set_ylim(bottom=0)
        short = scenario.id.rpartition("/")[2]  # the plant's name, which may be long, stands above all
        column[0].set_title(f"{short}: MAE {mae(alone):.3g} alone, {mae(own):.3g} learned", fontsize=10, loc="left")
        column[-1].set_xlabel(f"time [{time}]")
    labels = [f"y [{unit}]", f"r̃ [{unit}]", f"|Δy| [{unit}/{time}]"]
    for axes, label in zip(grid[:, 0], labels, strict=False):
        axes.set_ylabel(label)
    figure.suptitle(plant.name, fontsize=11)
    legend(figure)
    return styled(figure)


def _outputs(axes: Axes, scenario: Scenario, alone: Traces, learned: Traces) -> None:
    """Y of the first episode of both, r, and the limits on y."""
    t, limit = times(scenario, alone.r.shape[1]), scenario.plant.output_limit
    _members(axes, scenario, learned)
    if limit is not None:
        for bound in (-limit, limit):
            axes.axhline(bound, **LIMITS)
    r = np.append(alone.r[0], alone.r[0, -1])
    axes.step(t, r, where="post", color=REFERENCE, lw=1.2, ls="--", label=SET_POINT)
    both = {"y, inner loop alone": (alone, INNER), "y, learned outer loop": (learned, LEARNED)}
    for label, (traces, color) in both.items():
        axes.plot(t, np.append(traces.y0[0], traces.y[0]), color=color, lw=1.8, label=label)
    low, high = scenario.plant.divergence_bounds
    every = np.concatenate([alone.y[0], learned.y[0]])
    if not scenario.stable_alone or not ((every > low) & (every < high)).all():
        axes.set_ylim(*output_range(scenario, (alone, learned)))
        for traces, color in both.values():
            _diverges(axes, t[1:], traces.y[0], color)
    axes.set_xlim(t[0], t[-1])


def _diverges(axes: Axes, t: np.ndarray, y: np.ndarray, color: str) -> None:
    """Say so where y leaves the frame and does not come back to stay."""
    low, high = axes.get_ylim()
    outside = ~((y >= low) & (y <= high))
    if not outside[-(len(y) // 3) :].any():
        return
    k = int(np.argmax(outside))
    above = bool(y[k] > high) if np.isfinite(y[k]) else bool(y[max(k - 1, 0)] > (low + high) / 2)
    right = k < len(y) / 2  # where there is room for the word
    axes.annotate(
        "diverges",
        (t[k], high if above else low),
        xytext=(4 if right else -4, -10 if above else 4),
        textcoords="offset points",
        ha="left" if right else "right",
        fontsize=8.5,
        color=color,
        bbox=dict(fc="white", alpha=0.85, lw=0, pad=1.0),
        zorder=4,
    )


def output_range(scenario: Scenario, traces: Sequence[Traces]) -> tuple[float, float]:
    """Range of y that shows r and these outputs; what runs away leaves the picture."""
    low, high = scenario.plant.evaluation_range
    low, high = 1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low
    if scenario.stable_alone:
        low, high = min(low, scenario.plant.divergence_bounds[0]), max(high, scenario.plant.divergence_bounds[1])
    shown = np.concatenate([traces[0].r[0], *(np.append(own.y0[0], own.y[0]) for own in traces)])
    shown = np.clip(shown[np.isfinite(shown)], low, high)
    margin = 0.06 * (shown.max() - shown.min()) + 1e-6 * scenario.plant.error_scale
    return float(shown.min() - margin), float(shown.max() + margin)


def _modified(axes: Axes, scenario: Scenario, traces: Traces) -> None:
    """r~ of the first episode and its bounds."""
    t = times(scenario, traces.r.shape[1])
    for bound in scenario.plant.r_tilde_bounds:
        axes.axhline(bound, **LIMITS)
    r_tilde = np.append(traces.r_tilde[0], traces.r_tilde[0, -1])
    axes.step(t, r_tilde, where="post", color=MODIFIED, lw=1.4, label="modified reference r̃, learned")
    axes.set_xlim(t[0], t[-1])


def _members(axes: Axes, scenario: Scenario, traces: Traces) -> None:
    """The spread of the single outputs of the first episode."""
    if traces.members is None:
        return
    t = times(scenario, traces.r.shape[1])[1:]
    quantiles = np.quantile(traces.members[0], [0.0, 0.05, 0.95, 1.0], axis=1)
    axes.fill_between(t, quantiles[0], quantiles[3], label="all members, learned", **WIDE)
    axes.fill_between(t, quantiles[1], quantiles[2], label="90 % of the members", **NARROW)


def _changes(axes: Axes, scenario: Scenario, traces: Traces) -> None:
    """|change| a control step of y and of the single outputs, against the rate limit."""
    t, limit = times(scenario, traces.r.shape[1])[1:], scenario.plant.rate_limit
    if traces.members is not None:
        change = np.abs(np.diff(traces.members[0], axis=0))
        axes.fill_between(t[1:], 0, change.max(1), **WIDE)
        axes.fill_between(t[1:], 0, np.quantile(change, 0.95, axis=1), **NARROW)
    axes.plot(t, np.abs(np.diff(traces.y[0], prepend=traces.y0[0])), color=LEARNED, lw=1.6)
    if limit is not None:
        axes.axhline(limit, **LIMITS)
    axes.set_xlim(0, t[-1])


def learning_curve(rows: Mapping[int, Sequence[Mapping[str, Any]]], levels: Mapping[str, float], title: str) -> Figure:
    """MAE over updates, a line a seed; beside it the reward with exploration, or what the gate let through.

    Args:
        rows: of metrics.jsonl, by seed: `mae`, and `reward` of the agent's epochs, or else the `gain` of the rounds of
            pairs in which a new actor was kept.
        levels: horizontal lines by name, such as the MAE of the static prefilter.
        title: what the MAE is of.
    """
    figure = Figure(figsize=(9, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    explored = any("reward" in row for of_seed in rows.values() for row in of_seed)
    for seed, of_seed in rows.items():
        updates = [row["updates"] / 1000 for row in of_seed]
        left.plot(updates, [row["mae"] for row in of_seed], lw=1.6, label=f"seed {seed}")
        if explored:
            gained = [row.get("reward", math.nan) for row in of_seed]
        else:
            rounds = [row["gain"] if row.get("kept") and "rate" in row else 0.0 for row in of_seed]
            gained = np.cumsum(rounds).tolist()
        right.plot(updates, gained, lw=1.6)
    high = FAR * max(row["mae"] for of_seed in rows.values() for row in of_seed)
    for (name, value), style in zip(levels.items(), cycle(("-", "--", ":", "-.")), strict=False):
        above = ", above" if value > high else ""
        left.plot([], [], color=INNER, ls=style, lw=1.2, label=f"{name} {value:.3g}{above}")
        if not above:
            left.axhline(value, color=INNER, ls=style, lw=1.2)
    left.set_ylabel("MAE without exploration")
    log_axis(left, "y")
    left.set_title(title, fontsize=10, loc="left")
    right.set_ylabel("reward a step, with exploration" if explored else "gain in reward a step, kept by the gate")
    for axes in (left, right):
        axes.set_xlabel("updates [thousand]")
    legend(figure)
    return styled(figure)


def step_responses(plant: Plant, moves: np.ndarray, responses: np.ndarray) -> Figure:
    """What y does (n, T) after r~ has moved by so much (n,); and by that, where a linear plant has one line."""
    unit, time = symbol(plant.y_unit), plant.control_step * np.arange(responses.shape[1] + 1)
    figure = Figure(figsize=(7, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for move, response in zip(moves, responses, strict=True):
        style = dict(lw=1.2, ls="-" if move > 0 else "--", label=f"r̃ {move:+.3g} {unit}")
        above.plot(time, [0.0, *response], **style)
        below.plot(time, [0.0, *(response / move)], **style)
    above.set(ylabel=f"change of y, {unit}", title=f"{plant.name}: response to a move of r̃ at 0")
    below.set(ylabel="change of y by that of r̃", xlabel=f"time, {plant.time_unit}")
    figure.legend(*above.get_legend_handles_labels(), loc="outside right upper", fontsize=8.5, frameon=False)
    return styled(figure)


def live(steps: Mapping[str, np.ndarray], unit: str = "1") -> Figure:
    """The beginning and the end of a live run: r, y and what y would have been, and r~.

    Args:
        steps: time (s), r, y, r_tilde and y_passed, (T,) each; nan where there is none.
        unit: of y.
    """
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    grid = figure.subplots(2, 2, sharex="col", sharey="row", squeeze=False)
    told = in_words(symbol(unit), " [{}]")
    for column, (title, shown) in enumerate((("beginning", slice(LIVE_ROWS)), ("end", slice(-LIVE_ROWS, None)))):
        t, r, y, r_tilde, passed = (steps[name][shown] for name in ("time", "r", "y", "r_tilde", "y_passed"))
        above, below = grid[:, column]
        above.step(t, r, where="post", color=REFERENCE, lw=1.2, ls="--", label=SET_POINT)
        if np.isfinite(passed).any():
            above.plot(t, passed, color=INNER, lw=1.2, label="y if r passed through")
        above.plot(t, y, color=LEARNED, lw=1.6, label="output y")
        error = float(np.nanmean(np.abs(r[:-1] - y[1:]))) if len(t) > 1 else math.nan
        above.set_title(f"{title}: MAE {error:.3g}{told}", fontsize=10, loc="left")
        below.step(t, r_tilde, where="post", color=MODIFIED, lw=1.2, label="modified reference r̃")
        below.set_xlabel("time [s]")
    grid[0, 0].set_ylabel(f"y{told}")
    grid[1, 0].set_ylabel(f"r̃{told}")
    legend(figure)
    return styled(figure)


def validation_figure(report: Validation, title: str, y_unit: str = "1", time_unit: str = "s") -> Figure:
    """Model validation: the held-out free run, the step responses, levels and frequencies of the recorded r~.

    Args:
        report: of the recorded data.
        title: of the whole, such as the name of their file.
        y_unit, time_unit: of the recorded data.
    """
    figure = Figure(figsize=(10, 7.2), layout="constrained")
    grid = figure.add_gridspec(2, 3)
    unit = in_words(symbol(y_unit), " [{}]")
    _held_out(figure.add_subplot(grid[0, :]), report, unit, time_unit)
    _step_responses(figure.add_subplot(grid[1, 0]), report, time_unit)
    _levels(figure.add_subplot(grid[1, 1]), report, unit)
    _frequencies(figure.add_subplot(grid[1, 2]), report, time_unit)
    figure.suptitle(title, fontsize=11)
    legend(figure)
    return styled(figure)


def _held_out(axes: Axes, report: Validation, unit: str, time_unit: str) -> None:
    """Y of the last quarter, and what the models of the rest make of it."""
    curves = report.curves
    shown = slice(min(len(curves.time), HELD_OUT_ROWS))
    t = curves.time[shown]
    axes.fill_between(t, *curves.band[:, shown], color=LEARNED, alpha=0.2, lw=0, label="90 % of the ensemble")
    axes.plot(t, curves.y[shown], color=REFERENCE, lw=1.0, label="y, recorded")
    axes.plot(t, curves.free_run[shown], color=LEARNED, lw=1.4, label="nominal model")
    axes.set_ylabel(f"y{unit}")
    axes.set_xlabel(f"time [{time_unit}]")
    axes.set_xlim(t[0], t[-1])
    told = f"{max(report.fit_free_run, 0.0):.1%} of the variance, {report.coverage:.0%} in the band"
    axes.set_title(f"rows not fitted: {told}", fontsize=10, loc="left")


def _step_responses(axes: Axes, report: Validation, time_unit: str) -> None:
    nominal, *members = report.curves.responses
    t = report.control_step * np.arange(len(nominal))
    for i, member in enumerate(members):
        axes.plot(t, member, color=LEARNED, lw=0.8, alpha=0.35, label=None if i else "models of the ensemble")
    axes.plot(t, nominal, color=LEARNED, lw=1.4)
    axes.axvline(report.settling_time, color=INNER, ls=":", lw=1.2, label=f"settled, after {report.settling_time:.3g}")
    axes.set_title(f"y after r̃ steps by 1: gain {report.gain:.3g}", fontsize=10, loc="left")
    axes.set_xlabel(f"time [{time_unit}]")
    axes.set_xlim(0, t[-1])


def _levels(axes: Axes, report: Validation, unit: str) -> None:
    edges, levels = report.curves.edges, report.curves.levels
    axes.bar(edges[:-1], 100.0 * levels, np.diff(edges), align="edge", color=MODIFIED, alpha=0.75)
    for i, (low, high) in enumerate(report.levels_unseen):
        axes.axvspan(low, high, color=LIMIT, alpha=0.12, lw=0, label=None if i else "levels never seen")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel(f"r̃{unit}")
    axes.set_ylabel("share of the time [%]")
    axes.set_title(f"levels of r̃: {report.levels_seen:.0%} seen, {report.moves} moves", fontsize=10, loc="left")


def _frequencies(axes: Axes, report: Validation, time_unit: str) -> None:
    curves = report.curves
    axes.axvspan(curves.frequency[0], report.needed, color=LEARNED, alpha=0.1, lw=0, label="frequencies needed")
    axes.plot(curves.frequency, curves.coherence, color=LEARNED, lw=1.4, label="coherence of r̃ and y")
    axes.plot(curves.frequency, curves.power / curves.power.max(), color=MODIFIED, lw=1.0, label="power of r̃, relative")
    axes.axhline(COHERENT, color=INNER, ls=":", lw=1.2)
    log_axis(axes, "x")
    axes.set_ylim(0, 1.05)
    axes.set_xlabel(f"frequency [1/{time_unit}]")
    axes.set_title(f"{report.excited_share:.0%} of the needed frequencies shown", fontsize=10, loc="left")
