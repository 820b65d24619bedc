"""What `default` holds on the paper's two plants that are unstable alone, trained on each of them by itself.

    python benchmarks/unstable.py                # five seeds each; a quarter of an hour
    python benchmarks/unstable.py --seeds 1

From rest: the MAE in 20 s of the scenario, without and with sensor noise of 0.1 crad. Drawn starts: 64 as in training,
then the scenario's set-point for 600 steps; held where |y| is within its limit in all of the last 300, counted among
those that some r~ within its bounds can bring back, by a linear programme on the plant. Table, numbers and figure go to
results/. The figure has the paper's four panels: the nominal plant with what `default` learned on it, delay-5.7 with
what it learned there.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import tyro
from tables import made, table

import jaxouter
from jaxouter import cli
from jaxouter.evaluation import figures, scenarios
from jaxouter.evaluation.baselines.clairvoyant import Replay
from jaxouter.evaluation.metrics import held, mae
from jaxouter.evaluation.policies import NamedPolicy, baseline
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Scenario
from jaxouter.identification.records import Record
from jaxouter.identification.unstable import can_be_brought_back
from jaxouter.loop import sensor
from jaxouter.plants.pitch import W_PRINTED
from jaxouter.training.run import RunFolder, surroundings, write_json

RESULTS = Path(__file__).parent / "results"
PLANTS: Mapping[str, dict[str, Any]] = {"delay-5.7": {"d1": 5.7, "d2": 0.57}, "uncertainty": {"W": W_PRINTED}}
NOISE = 0.1  # crad


def possible(scenario: Scenario, steps: int = 200) -> np.ndarray:
    """Which episodes of a scenario some r~ can bring back; (episodes,)."""
    short, high = replace(scenario, r=scenario.r[:, :steps]), scenario.plant.r_tilde_bounds[1]
    nothing = np.zeros(short.r.shape, short.r.dtype)
    once = nothing.copy()
    once[:, 0] = high
    free, moved = (rollout(Replay(), each, short, per_episode=True) for each in (nothing, once))
    y = np.concatenate([free.y0[:, None], free.y], 1).astype(np.float64)
    return can_be_brought_back(scenario.plant, Record(nothing, y), (moved.y - free.y)[0] / high)


def learned(seed: int, settings: dict[str, Any]) -> tuple[NamedPolicy, float]:
    """What `default` learns on the plant with these settings, and the seconds of the whole run."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        run = jaxouter.learn("pitch", set=settings, seed=seed, out=Path(folder) / "run", progress=False)
        seconds = time.perf_counter() - begun
        opened = RunFolder.open(run.path)
        return NamedPolicy("learned", opened.trainer[0].policy, opened.policy(seed)[1], opened.config.plant), seconds


def drawn(policies: Mapping[str, NamedPolicy], path: Path) -> None:
    """The paper's panels: the inner loop alone and with the policy for each scenario, and r~ below."""
    on = {name: scenarios.get(name) for name in policies}
    alone = baseline("none", next(iter(policies.values())).plant)
    inner = {name: rollout(alone.policy, alone.params, on[name]) for name in on}
    with_outer = {name: rollout(named.policy, named.params, on[name]) for name, named in policies.items()}
    figures.keep(figures.response(list(on.values()), inner, with_outer), path)


def measured(named: NamedPolicy, identifier: str) -> dict[str, float]:
    """What a policy holds on a scenario."""
    alone = scenarios.get(identifier)
    noisy = replace(scenarios.get(identifier, 32), sensor=sensor.params(noise=NOISE))
    starts = scenarios.perturbed(identifier)
    found = {name: mae(rollout(named.policy, named.params, on)) for name, on in (("mae", alone), ("noisy", noisy))}
    seen = rollout(named.policy, named.params, starts)
    return found | {"held": held(seen, starts.plant)}


def main(seeds: int = 5) -> None:
    """The command."""
    rows, kept = [], {}
    for case, settings in PLANTS.items():
        could = float(np.mean(possible(scenarios.perturbed(f"pitch/{case}"))))
        found: list[dict[str, float]] = []
        for seed in range(seeds):
            named, seconds = learned(seed, settings)
            found.append(measured(named, f"pitch/{case}") | {"seconds": seconds})
            if (case, seed) == ("delay-5.7", 0):
                drawn({"pitch/paper": learned(0, {})[0], f"pitch/{case}": named}, RESULTS / "unstable.png")
            print(case, seed, found[-1], flush=True)
        kept[case] = {"can be held": could, "seeds": found}

        def cell(name: str, scale: float = 1.0, of: list[dict[str, float]] = found) -> str:
            values = [scale * each[name] for each in of]
            return f"{median(values):.3g} ({min(values):.3g} to {max(values):.3g})"

        rows.append([f"pitch/{case}", cell("mae"), cell("noisy"), f"{100 * could:.0f} %", cell("held", 100 / could)])
    columns = ["plant", "MAE from rest", f"with noise of {NOISE}", "starts that can be held", "of these held, %"]
    text = f"{table(columns, rows)}\n\nMedian (least to greatest) of {seeds} seeds. "
    text += made(f"python benchmarks/unstable.py --seeds {seeds}")
    write_json(RESULTS / "unstable.json", {"machine": surroundings(), "plants": kept})
    (RESULTS / "unstable.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
