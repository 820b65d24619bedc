"""What a policy trained on many plants holds, beside the baselines, tuned on the nominal one, and beside its own limit.

Each plant starts 64 times as in training and is then asked for the scenario's set-point, for 600 steps. It is held
where |y| stays within its limit in all of the last 300. The limit is the oracle, retrained on the same drawn plants.

    python benchmarks/robust.py runs/heaters-robust-0      # results/robust-heaters.json, and two tables
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
import numpy as np
import tyro
from msgspec import Struct
from tables import table

from jaxouter import cli
from jaxouter.evaluation import cache, scenarios
from jaxouter.evaluation.baselines import BASELINES, oracle
from jaxouter.evaluation.metrics import held, mae
from jaxouter.evaluation.policies import NamedPolicy, baseline
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.training.run import RunFolder, surroundings, write_json

RESULTS = Path(__file__).parent / "results"
LEARNED, LIMIT = "learned", "its limit"


def entrants(runs: Sequence[RunFolder]) -> Iterator[tuple[str, list[NamedPolicy]]]:
    """Name and policies: one for each seed of the runs, and one of all others."""
    run, (trainer, _) = runs[0], runs[0].trainer
    states = [one.load(seed)[0] for one in runs for seed in one.seeds]
    yield (
        LEARNED,
        [NamedPolicy(LEARNED, trainer.policy, trainer.policy_params(state), run.config.plant) for state in states],
    )
    limit = oracle.retrained(run.config, lambda text, share: print(f"{LIMIT}: {text}", flush=True))
    yield LIMIT, [NamedPolicy(LIMIT, trainer.policy, oracle.learned(limit), run.config.plant)]
    for name in BASELINES:
        yield name, [baseline(name, run.config.plant)]


class Held(Struct, frozen=True):
    """MAE and the share that is held, each the median over the seeds, with the worst seed; None where diverged."""

    mae: float | None
    worst_mae: float | None
    held: float
    worst_held: float


def evaluated(policies: Sequence[NamedPolicy], scenario: Scenario) -> Held:
    """What the seeds of a policy hold on a scenario."""
    traces = [rollout(named.policy, named.params, scenario) for named in policies]
    with np.errstate(all="ignore"):
        maes, shares = [mae(t) for t in traces], [held(t, scenario.plant) for t in traces]
    middle, worst = (value if np.isfinite(value) else None for value in (median(maes), max(maes)))
    return Held(middle, worst, median(shares), min(shares))


def cell(row: dict[str, float | None], limit: dict[str, float | None]) -> str:
    """MAE, its ratio to the limit, and the share that is held."""
    if row["mae"] is None:
        return "diverged"
    ratio = "" if limit["mae"] is None or row is limit else f" ({row['mae'] / limit['mae']:.2f})"
    return f"{row['mae']:.3g}{ratio}, {100 * (row['held'] or 0.0):.0f} %"


def main(runs: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """The command; several runs differ by their seeds."""
    cache.use_compilation_cache()
    opened = [RunFolder.open(path) for path in runs]
    config, plant = opened[0].config, opened[0].config.plant
    plants = [scenarios.perturbed(name) for name in scenarios.for_stability(plant)]
    catalogue = [scenarios.get(name) for name in scenarios.catalogue(plant)]
    places = {s.id: scenarios.place(s, *opened[0].drawn) for s in catalogue}
    started: dict[str, dict[str, Held]] = {}  # rows by policy and scenario
    asked: dict[str, dict[str, Held]] = {}
    for name, policies in entrants(opened):
        print(name, flush=True)
        started[name] = {scenario.id: evaluated(policies, scenario) for scenario in plants}
        if name in (LEARNED, LIMIT):
            asked[name] = {scenario.id: evaluated(policies, scenario) for scenario in catalogue}
    about = {
        "date": date.today().isoformat(),
        "machine": surroundings(),
        "seeds": [seed for run in opened for seed in run.seeds],
    }
    about |= {"preset": config.preset, "ranges": config.randomise, "places": places}
    found = about | msgspec.to_builtins({"perturbed": started, "scenarios": asked})
    write_json(RESULTS / f"robust-{plant}.json", found)
    text = written(found)
    (RESULTS / f"robust-{plant}.md").write_text(text + "\n")
    print(text)


def written(found: dict[str, Any]) -> str:
    """The tables of a result: drawn starts, scenarios."""
    started, asked, places = (found[key] for key in ("perturbed", "scenarios", "places"))
    names = started[LIMIT]
    rows = [[name, places[name], *(cell(row[name], names[name]) for row in started.values())] for name in names]
    held = table(["plant", "of the drawn ones", *started], rows)
    pairs = {name: [asked[each][name]["mae"] or np.inf for each in (LEARNED, LIMIT)] for name in asked[LIMIT]}
    rows = [
        [name, places[name], *map("{:.3g}".format, maes), f"{maes[0] / maes[1]:.2f}"] for name, maes in pairs.items()
    ]
    scenario = table(["scenario", "of the drawn ones", LEARNED, LIMIT, "ratio"], rows)
    versions = found["machine"]["versions"]
    when = (
        f"Made on {found['date']} with jaxouter {versions['jaxouter']}, jax {versions['jax']}, seeds {found['seeds']}."
    )
    return f"{held}\n\n{scenario}\n\n{when}"


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main))
