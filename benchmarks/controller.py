"""How long `jaxouter.runtime.Controller.step` takes, in microseconds: median, 99th percentile and greatest.

The weights are random, in the shapes of the presets; time does not depend on their values. JAX is in another process,
so that the one that is timed has NumPy alone, as in a real loop. Samples have times, and the rate is limited.

    python benchmarks/controller.py                             # into benchmarks/results/controller.json
    python benchmarks/controller.py --steps 2000 --json now.json

Run it on a machine that does nothing else: `load_before` in the result says whether it did.
"""

from __future__ import annotations

import json
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from throughput import RESULTS, machine

from jaxouter.exports.spec import ControllerSpec
from jaxouter.runtime import Controller

CASES = (("pitch", "default"), ("heaters", "default"), ("pitch", "robust"))
WARM_UP = 1000  # steps


def random_law(plant: str, preset_name: str) -> ControllerSpec:
    """A spec in the shapes of a preset."""
    import jax

    from jaxouter.training.config import preset
    from jaxouter.training.trainer import build

    trainer, params = build(preset(plant, preset_name))
    shapes = trainer.policy_params(jax.eval_shape(trainer.fresh, jax.random.key(0), params))
    rng = np.random.default_rng(0)
    drawn = jax.tree.map(lambda leaf: rng.uniform(-0.1, 0.1, leaf.shape), shapes)
    return ControllerSpec.of(trainer.policy, drawn, trainer.env.plant)


def durations(spec: ControllerSpec, steps: int) -> np.ndarray:
    """Of each step, in microseconds; (steps,)."""
    low, high = spec.r_tilde_bounds
    controller = Controller(spec, rate_limit=(high - low) / 10)
    r, y = np.random.default_rng(1).uniform(*spec.setpoint_range, (2, WARM_UP + steps)).tolist()
    taken = []
    for k, (r_k, y_k) in enumerate(zip(r, y, strict=True)):
        now = k * spec.control_step
        begin = time.perf_counter_ns()
        controller.step(r_k, y_k, now)
        taken.append(time.perf_counter_ns() - begin)
    assert not any(controller.counts.values())  # it was the spec all the time
    return np.array(taken[WARM_UP:]) / 1000


def row(name: str, spec: ControllerSpec, steps: int) -> dict[str, Any]:
    taken = durations(spec, steps)
    figures = {"median": np.median(taken), "p99": np.percentile(taken, 99), "max": taken.max()}
    layers = [len(spec.weights[0]), *map(len, spec.biases)]
    return {"case": name, "layers": layers, "unit": "us"} | {key: round(float(us), 2) for key, us in figures.items()}


def main(steps: int = 100_000, json_file: Annotated[Path, tyro.conf.arg(name="json")] = RESULTS / "controller.json"):
    """Measure, print, and write.

    Args:
        steps: Control steps of each case.
        json_file: Where the results go.
    """
    if steps < 1:
        raise ValueError(f"--steps is {steps}; it must be at least 1")
    about = machine()
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        specs = list(pool.map(random_law, *zip(*CASES, strict=True)))
    rows = [row("/".join(case), spec, steps) for case, spec in zip(CASES, specs, strict=True)]
    json_file.write_text(json.dumps({"machine": about, "steps": steps, "rows": rows}, indent=2) + "\n")
    table = Table("case", "layers", "median", "p99", "max", title=f"microseconds a step; load {about['load_before']}")
    for each in rows:
        table.add_row(
            each["case"], "-".join(map(str, each["layers"])), *(str(each[k]) for k in ("median", "p99", "max"))
        )
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
