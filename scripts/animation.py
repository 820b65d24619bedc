"""The animation of the README: the 747's attitude and a thousand houses, with and without the outer loop.

    python -m jaxouter.train pitch
    python -m jaxouter.train heaters
    python scripts/animation.py runs/pitch-default-0 runs/heaters-default-0

What moves is what the runs' policies do on pitch/staircase and heaters/paper-1000, which training never saw.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D
from PIL import Image

import jaxouter
from jaxouter import cli
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.figures import INNER, LEARNED, REFERENCE
from jaxouter.evaluation.policies import NamedPolicy, baseline, evaluate_on
from jaxouter.evaluation.rollout import Traces

OUT = Path(__file__).resolve().parents[1] / "benchmarks" / "results" / "animation.webp"
FRAMES, MILLISECONDS, LAST = 100, 70, 1500  # of each frame, and how long the last one stays
COLORS = {"inner loop alone": INNER, "with the outer loop": LEARNED}
HOUSES = 400  # that are drawn
BODY = [  # a 747 from the side, nose to the right, lengths of the fuselage
    (-0.50, 0.03), (-0.56, 0.20), (-0.47, 0.20), (-0.36, 0.055), (0.22, 0.055), (0.28, 0.085), (0.40, 0.08),
    (0.47, 0.035), (0.50, 0.0), (0.47, -0.035), (0.38, -0.055), (-0.30, -0.055), (-0.44, -0.01),
]  # fmt: skip
WING = [(0.10, -0.02), (-0.02, -0.02), (-0.20, -0.085), (-0.13, -0.085)]


def played(folder: Path, scenario: str) -> tuple[scenarios.Scenario, dict[str, Traces]]:
    """A scenario, and its first episode alone and under the run's policy."""
    run = jaxouter.load(folder)
    selected = scenarios.get(scenario, 1)
    policies = {
        "inner loop alone": baseline("none", run.config.plant),
        "with the outer loop": NamedPolicy("learned", run.policy.policy, run.policy.params, run.config.plant),
    }
    return selected, {name: evaluate_on(each, [selected], True)[scenario].traces for name, each in policies.items()}


def times(scenario: scenarios.Scenario, traces: Traces) -> np.ndarray:
    """Times of y_0, ..., in the plant's unit."""
    return scenario.plant.control_step * np.arange(traces.r.shape[1] + 1)


class Course:
    """r and y over time, as far as the animation is."""

    def __init__(self, axes: Any, scenario: scenarios.Scenario, traces: dict[str, Traces], label: str) -> None:
        first = next(iter(traces.values()))
        self.t = times(scenario, first)
        axes.step(self.t, np.append(first.r[0], first.r[0, -1]), where="post", color=REFERENCE, lw=1.1, ls="--")
        self.y = {name: np.append(each.y0[0], each.y[0]) for name, each in traces.items()}
        self.lines = {name: axes.plot([], [], color=COLORS[name], lw=1.8)[0] for name in traces}
        axes.set(xlim=(0, self.t[-1]), xlabel=f"time [{scenario.plant.time_unit}]", ylabel=label)
        every = np.concatenate([*self.y.values(), first.r[0]])
        axes.set_ylim(every.min() - 1, every.max() + 1)

    def show(self, k: int) -> None:
        """Up to sample k."""
        for name, line in self.lines.items():
            line.set_data(self.t[: k + 1], self.y[name][: k + 1])


def attitude(axes: Any, name: str) -> Any:
    """An aircraft; returns a function that turns it (rad) and shows the wanted attitude (rad)."""
    axes.set(xlim=(-0.6, 0.6), ylim=(-0.3, 0.3), aspect="equal")
    axes.axis("off")
    axes.set_title(name, fontsize=10, color=COLORS[name])
    (wanted,) = axes.plot([], [], color=REFERENCE, lw=1.0, ls="--")
    body, wing = (axes.fill(*np.array(part).T, color=COLORS[name])[0] for part in (BODY, WING))
    wing.set_edgecolor("white")

    def turn(angle: float, reference: float) -> None:
        for part in (body, wing):
            part.set_transform(Affine2D().rotate(angle) + axes.transData)
        way = 0.6 * np.array([np.cos(reference), np.sin(reference)])
        wanted.set_data([-way[0], way[0]], [-way[1], way[1]])

    return turn


def houses(axes: Any, name: str, traces: Traces, limits: tuple[float, float]) -> Any:
    """Houses as points at their temperatures; returns a function that shows those of a step."""
    members = traces.members
    assert members is not None
    x = np.random.default_rng(0).uniform(0, 1, HOUSES)
    points = axes.scatter(x, members[0, 0, :HOUSES], s=5, color=COLORS[name], alpha=0.6, lw=0)
    wanted = axes.axhline(0.0, color=REFERENCE, lw=1.2, ls="--")
    axes.set(xlim=(0, 1), ylim=limits, xticks=[])
    axes.set_title(name, fontsize=10, color=COLORS[name])

    def show(k: int) -> None:
        k = min(k, members.shape[1] - 1)
        points.set_offsets(np.column_stack([x, members[0, k, :HOUSES]]))
        wanted.set_ydata([traces.r[0, k]] * 2)

    return show


def main(pitch: tyro.conf.Positional[Path], heaters: tyro.conf.Positional[Path], out: Path = OUT) -> None:
    """The command.

    Args:
        pitch: run on pitch.
        heaters: run on heaters.
        out: file to write, .webp.
    """
    flown, of_pitch = played(pitch, "pitch/staircase")
    heated, of_heaters = played(heaters, "heaters/paper-1000")
    figure = Figure(figsize=(9.6, 4.6), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    left, right = np.ravel(np.array(figure.subfigures(1, 2)))
    left.suptitle("Boeing 747 with a human pilot: pitch angle", fontsize=11)
    right.suptitle("A thousand space heaters: temperatures", fontsize=11)
    parts = [part.add_gridspec(2, 2, height_ratios=(1.0, 1.1)) for part in (left, right)]
    planes = {name: attitude(left.add_subplot(parts[0][0, i]), name) for i, name in enumerate(COLORS)}
    members = np.concatenate([each.members.ravel() for each in of_heaters.values() if each.members is not None])
    limits = float(members.min()) - 1, float(members.max()) + 1
    homes = [
        houses(right.add_subplot(parts[1][0, i]), name, each, limits)
        for i, (name, each) in enumerate(of_heaters.items())
    ]
    courses = [
        Course(left.add_subplot(parts[0][1, :]), flown, of_pitch, "y [crad]"),
        Course(right.add_subplot(parts[1][1, :]), heated, of_heaters, "y [°C]"),
    ]
    for axes in (courses[0].lines, courses[1].lines):
        next(iter(axes.values())).axes.spines[["top", "right"]].set_visible(False)
    frames = []
    for frame in range(FRAMES + 1):
        steps = [round(frame / FRAMES * (len(course.t) - 1)) for course in courses]
        for course, k in zip(courses, steps, strict=True):
            course.show(k)
        for name, each in of_pitch.items():
            k = min(steps[0], each.r.shape[1] - 1)
            planes[name](courses[0].y[name][steps[0]] / 100, each.r[0, k] / 100)
        for home in homes:
            home(max(0, steps[1] - 1))
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
        if frame == 0:
            figure.set_layout_engine("none")  # nothing moves but what is shown
    lasting = [MILLISECONDS] * FRAMES + [LAST]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=lasting, loop=0, quality=70, method=4)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB, {len(frames)} frames")


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
