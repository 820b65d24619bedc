"""What it costs not to know the plant: a bound for any one policy on two plants that answer alike at first.

    python benchmarks/undecided.py      # results/undecided.md; two minutes

From rest the nominal plant and that of the printed uncertainty answer almost alike for the first two seconds. Whoever
can't tell them apart gives both the same r~ until then. A linear programme finds the r~ with the least error on both:
common for the first T control steps, then each its own, with |y| within its limit and r known. A policy that
decides at T or later has no lower weighted sum of the two.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.optimize
import scipy.sparse as sparse
import tyro
from tables import made, table
from unstable import RESULTS

from jaxouter import cli
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.baselines.clairvoyant import Replay
from jaxouter.evaluation.rollout import rollout

CASES = ("paper", "uncertainty")
WEIGHTS = (1.0, 0.1)  # the second is at least bounded
COUNTED, STEPS = (
    200,
    260,
)  # control steps of the MAE, and of the programme, in whose last ones nothing is gained by the end


def response(case: str) -> tuple[np.ndarray, np.ndarray]:
    """Output (STEPS,) under r~ = 0, and its response to a unit of r~ in the first control step."""
    scenario = scenarios.get(f"pitch/{case}", 1)
    scenario = replace(scenario, r=np.full((1, STEPS), scenario.r[0, 0], scenario.r.dtype))
    nothing, high = np.zeros(scenario.r.shape, scenario.r.dtype), scenario.plant.r_tilde_bounds[1]
    once = nothing.copy()
    once[:, 0] = high
    free, moved = (
        rollout(Replay(), each, scenario, per_episode=True).y[0].astype(np.float64) for each in (nothing, once)
    )
    return free, (moved - free) / high


def bound(common: int) -> list[float]:
    """MAE on both plants where the first `common` r~ are the same."""
    plant, n = scenarios.get("pitch/paper", 1).plant, STEPS
    r, limit = float(scenarios.get("pitch/paper", 1).r[0, 0]), plant.output_limit
    A, b, one, nothing = [], [], sparse.eye(n), sparse.csr_matrix((n, n))
    for i, case in enumerate(CASES):  # of each plant n r~, then n errors that |y - r| must not exceed
        free, h = response(case)
        moved = sparse.csr_matrix(np.tril(h[np.maximum(np.subtract.outer(np.arange(n), np.arange(n)), 0)]))
        parts = [(moved, -one, r - free), (-moved, -one, free - r)]
        parts += [(moved, nothing, limit - free), (-moved, nothing, limit + free)]
        for of_r_tilde, of_error, most in parts:
            columns = [nothing] * (2 * len(CASES))
            columns[2 * i : 2 * i + 2] = of_r_tilde, of_error
            A.append(columns)
            b.append(most)
    same = sparse.hstack([one, nothing, -one, nothing]).tocsr()[:common]
    found = scipy.optimize.linprog(
        np.concatenate([np.repeat([0.0, weight / COUNTED], n) for weight in WEIGHTS]),
        sparse.bmat(A).tocsr(),
        np.concatenate(b),
        same,
        np.zeros(common),
        ([plant.r_tilde_bounds] * n + [(0.0, None)] * n) * len(CASES),
        method="highs-ipm",
    )
    errors = found.x.reshape(len(CASES), 2, n)[:, 1, :COUNTED]
    return errors.mean(1).tolist()


def main() -> None:
    """The command."""
    rows = []
    for common in (0, 10, 15, 20, 25):
        maes = bound(common)
        rows.append([str(common), *map("{:.3g}".format, maes)])
        print(*rows[-1], flush=True)
    columns = ["control steps with common r~", *(f"least MAE on pitch/{case}" for case in CASES)]
    text = f"{table(columns, rows)}\n\n{made('python benchmarks/undecided.py')}\n"
    (RESULTS / "undecided.md").write_text(text)


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
