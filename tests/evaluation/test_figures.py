"""The figures of a run on the houses, from traces that nobody had to simulate."""

import numpy as np
import pytest

from jaxouter.evaluation import figures, scenarios
from jaxouter.evaluation.rollout import Traces


@pytest.fixture(scope="module")
def houses():
    """Scenarios of 4 and of 1000 houses, and traces of an episode of each."""
    selected = [scenarios.get(name, 1) for name in ("heaters/paper-4", "heaters/paper-1000")]
    rng, traces = np.random.default_rng(0), {}
    for scenario, n in zip(selected, (4, 1000), strict=True):
        r = np.asarray(scenario.r, float)
        members = r[..., None] + rng.normal(0.0, 0.5, (*r.shape, n))
        y = members.mean(2)
        traces[scenario.id] = Traces(y[:, 0] - 1.0, r, y, r, -np.abs(r - y), None, None, members)
    return selected, traces


def test_the_houses_and_their_comfort_limit_are_drawn(houses, tmp_path):
    selected, traces = houses
    sizes = [figures.save(figures.paper(selected, traces, traces), tmp_path / "paper.png").stat().st_size]
    bare = {name: of._replace(members=None) for name, of in traces.items()}
    for each, name in ((traces, "houses.png"), (bare, "mean.png")):
        path = figures.save(figures.response(selected[1], each[selected[1].id], each[selected[1].id]), tmp_path / name)
        assert path.read_bytes().startswith(b"\x89PNG")
        sizes.append(path.stat().st_size)
    assert sizes[1] > 1.02 * sizes[2]  # a picture of the houses holds more


def test_a_learning_curve_has_a_line_a_seed_and_the_levels(tmp_path):
    rows = [{"updates": 1000 * k, "mae": 3.0 / (k + 1), **({"reward": -1.0} if k else {})} for k in range(4)]
    path = figures.save(figures.learning_curve({0: rows, 1: rows}, {"static": 3.4}, "MAE"), tmp_path / "curve.png")
    assert path.stat().st_size > 10_000


def test_a_learning_curve_of_pairs_shows_what_the_gate_let_through():
    kept = [{"updates": 600 * k, "mae": 2.6, "gain": 0.5, "kept": k % 2, "rate": 1.0} for k in range(1, 4)]
    check = {"updates": 1800, "mae": 2.6, "gain": 9.0, "kept": 1.0}
    _, right = figures.learning_curve({0: [*kept, check]}, {}, "MAE").axes
    np.testing.assert_array_equal(right.lines[0].get_ydata(), [0.5, 0.5, 1.0, 1.0])
