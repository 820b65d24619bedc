"""How many control steps of the plant it takes to beat the static prefilter, and to come within 10 % of the limit.

    python benchmarks/sample_efficiency.py              # train what is not there yet; two hours
    python benchmarks/sample_efficiency.py heaters      # one plant

`paper`, `scratch` and `default` learn as they go: a point of their curves is an evaluation after an epoch or a round.
Runs of `paper` are cut where the curve has long been flat (nothing in the preset depends on the length). `record`
learns from recorded episodes alone: a point is a run of its own that recorded so many. All count every step of the
plant, those of identification, pairs and gate included. The MAE is that of the first of the paper's scenarios, on
which nothing is trained. Table, curve and numbers go to results/.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from tables import made, table

from jaxouter import cli
from jaxouter.evaluation import cache, figures, scenarios
from jaxouter.evaluation.baselines import LIMITS
from jaxouter.evaluation.drawing import Figure
from jaxouter.evaluation.jobs import limit as best
from jaxouter.evaluation.policies import baseline, evaluate_on
from jaxouter.evaluation.statistics import interval
from jaxouter.training.run import RunFolder, surroundings, write_json

RESULTS = Path(__file__).parent / "results"
SEEDS = 10
STEPS = {"pitch": 120_000, "heaters": 60_000}  # of the preset `paper`
EPISODES = (1, 4, 16, 64)  # of the preset `record`
COLORS = {
    "paper": figures.MODIFIED,
    "scratch": figures.REFERENCE,
    "record": figures.LIMIT,
    "default": figures.LEARNED,
}
NEAR = 1.1  # times the limit


class Curve(NamedTuple):
    """MAE of each seed after so many control steps."""

    steps: np.ndarray  # (points,)
    mae: np.ndarray  # (points, seeds)

    def median(self) -> np.ndarray:
        """Over the seeds (points,)."""
        return np.median(self.mae, -1)

    def interval(self) -> np.ndarray:
        """95 % bootstrap interval of the median (points, 2)."""
        return np.array([interval(lambda x: np.median(x, axis=-1), [of_seeds]) for of_seeds in self.mae])

    def first(self, level: float) -> list[int | None]:
        """Steps after which each seed is below the level for the first time; None where it never is."""
        below = self.mae < level
        return [int(self.steps[seed.argmax()]) if seed.any() else None for seed in below.T]

    def half_below(self, level: float) -> int | None:
        """Steps from which on the median over the seeds stays below the level."""
        above = np.flatnonzero(self.median() >= level)
        since = above[-1] + 1 if len(above) else 0
        return int(self.steps[since]) if since < len(self.steps) else None


def trained(folder: Path, *arguments: str) -> RunFolder:
    """The run in a folder, trained unless it is there."""
    if not (folder / "summary.json").exists():
        start = [*arguments, "--seeds", str(SEEDS), "--out", str(folder)]
        command = ["-m", "jaxouter.train", *(["--resume", str(folder)] if folder.exists() else start)]
        print(f"python {' '.join(command)}", flush=True)
        subprocess.run([sys.executable, *command], check=True)
    return RunFolder.open(folder)


def curves(plant: str, runs: Path) -> dict[str, Curve]:
    """The curve of each preset."""

    def of_rows(preset: str, *more: str) -> Curve:
        run = trained(runs / f"{plant}-{preset}", plant, "--preset", preset, *more)
        rows = np.array([[(row["steps"], row["mae"]) for row in run.rows(seed)] for seed in run.seeds])
        return Curve(rows[0, :, 0] + run.config.identification_steps, rows[:, :, 1].T)

    found = {"paper": of_rows("paper", "--steps", str(STEPS[plant])), "scratch": of_rows("scratch")}
    steps, maes = [], []
    for episodes in EPISODES:
        folder = runs / f"{plant}-record-{episodes}"
        run = trained(folder, plant, "--preset", "record", "--pretraining.episodes", str(episodes))
        steps.append(run.config.environment_steps)
        maes.append([run.rows(seed)[-1]["mae"] for seed in run.seeds])
    return found | {"record": Curve(np.array(steps), np.array(maes)), "default": of_rows("default")}


def draw(path: Path, found: dict[str, Curve], levels: dict[str, float], title: str, unit: str) -> None:
    """MAE against control steps: median of the seeds, its 95 % interval (darker) and the range of all (lighter)."""
    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, curve in found.items():
        color, (low, high) = COLORS[name], curve.interval().T
        marker = "o" if name == "record" else None
        axes.plot(
            curve.steps, curve.median(), color=color, lw=1.8, marker=marker, label=f"{name}, median of {SEEDS} seeds"
        )
        axes.fill_between(curve.steps, low, high, color=color, alpha=0.3, lw=0)
        axes.fill_between(curve.steps, curve.mae.min(1), curve.mae.max(1), color=color, alpha=0.1, lw=0)
    for (name, value), style in zip(levels.items(), ("-", "--", ":"), strict=True):
        axes.axhline(value, color=figures.INNER, ls=style, lw=1.2, label=f"{name} {value:.3g}")
    figures.log_axis(axes, "x")
    figures.log_axis(axes, "y")
    axes.set_xlabel("control steps of the plant")
    axes.set_ylabel(f"MAE [{unit}]")
    axes.set_title(title, fontsize=10, loc="left")
    axes.legend(fontsize=7.5, framealpha=0.85)
    figures.save(figures.styled(figure), path)


def spread(steps: Sequence[int | None], none: str = "never") -> str:
    """Median of the seeds, least and greatest."""
    all_steps = [np.inf if step is None else step for step in steps]
    low, middle, high = (
        f"{step:,.0f}" if np.isfinite(step) else none for step in (min(all_steps), np.median(all_steps), max(all_steps))
    )
    return middle if low == high else f"{middle} ({low} to {high})"


def main(
    plants: tyro.conf.Positional[tuple[str, ...]] = tuple(STEPS), runs: Path = Path("runs/sample-efficiency")
) -> None:
    """The command."""
    cache.use_compilation_cache()
    found_rows = []
    for plant in plants:
        scenario = scenarios.get(scenarios.reported(plant)[0])
        found = curves(plant, runs)
        known = {name: evaluate_on(baseline(name, plant), [scenario])[scenario.id] for name in ("static", *LIMITS)}
        static, limit = known["static"].figures.mae, best({name: each.figures for name, each in known.items()})
        assert static is not None
        assert limit is not None
        levels = {"static": static, f"{NEAR:g} x the limit": NEAR * limit, "limit": limit}
        rows: dict[str, Any] = {}
        for name, curve in found.items():
            to = {key: curve.first(level) for key, level in (("static", static), ("limit", NEAR * limit))}
            stays = {key: curve.half_below(level) for key, level in (("static", static), ("limit", NEAR * limit))}
            rows[name] = {"steps": curve.steps.tolist(), "mae": curve.mae.tolist(), "first": to, "median_stays": stays}
            cells = [f"{spread(to[key])}; {spread([stays[key]])}" for key in to]
            found_rows.append([scenario.id, name, *cells, f"{curve.median()[-1]:.3g} at {curve.steps[-1]:,.0f}"])
        about = {"date": date.today().isoformat(), "machine": surroundings(), "seeds": SEEDS, "scenario": scenario.id}
        write_json(RESULTS / f"sample-efficiency-{plant}.json", about | {"levels": levels, "presets": rows})
        title = f"{scenario.id}: MAE against control steps"
        draw(RESULTS / f"sample-efficiency-{plant}.png", found, levels, title, figures.symbol(scenario.plant.y_unit))
    columns = ["scenario", "preset", "to beat static", f"to come within {NEAR - 1:.0%} of the limit", "MAE in the end"]
    written = f"{table(columns, found_rows)}\n\n{made('python benchmarks/sample_efficiency.py')}\n"
    (RESULTS / "sample-efficiency.md").write_text(written)
    print(written)


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
