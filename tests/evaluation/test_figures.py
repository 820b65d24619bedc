"""The figures of a run on the houses, from traces that nobody had to simulate."""

import numpy as np
import pytest
from PIL import Image

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
    bare = {name: of._replace(members=None) for name, of in traces.items()}
    sizes = []
    for each, name in ((traces, "houses.png"), (bare, "mean.png")):
        path = figures.keep(figures.response(selected, each, each), tmp_path / name)
        assert path.read_bytes().startswith(b"\x89PNG")
        sizes.append(path.stat().st_size)
    assert sizes[0] > 1.02 * sizes[1]  # a picture of the houses holds more
    drawn = (tmp_path / "houses.svg").read_bytes()
    figures.keep(figures.response(selected, traces, traces), tmp_path / "again.png")
    assert drawn.startswith(b"<?xml")
    assert (tmp_path / "again.svg").read_bytes() == drawn


def texts(figure) -> list[str]:
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def test_a_figure_has_one_legend_outside_its_axes_and_both_loops_share_one(houses):
    selected, traces = houses
    figure = figures.response(selected, traces, traces)
    assert all(axes.get_legend() is None for axes in figure.axes)
    (legend,) = figure.legends
    labels = [text.get_text() for text in legend.texts]
    assert len(labels) == len(set(labels)) == 7
    figure.draw_without_rendering()
    box = legend.get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
    names = {line.get_label() for line in figure.axes[0].lines}
    assert {"y, inner loop alone", "y, learned outer loop", "reference r"} <= names
    assert [axes.get_ylabel() for axes in figure.axes[::2]] == ["y [°C]", "r̃ [°C]", "|Δy| [°C/h]"]
    assert texts(figure) == []


def test_in_an_animation_the_responses_run_along_and_the_rest_stays(houses, tmp_path):
    selected, traces = houses
    path = figures.animate(figures.response(selected[:1], traces, traces), tmp_path / "episode.webp")
    with Image.open(path) as film:
        assert film.n_frames == figures.FRAMES
        frames = []
        for i in (0, figures.FRAMES // 2, figures.FRAMES - 1):
            film.seek(i)
            frames.append(np.asarray(film.convert("RGB"), float))
    begun, half, ended = frames
    changed = [np.abs(frame - begun).max((0, 2)) > 60 for frame in (half, ended)]  # by column
    columns = [np.flatnonzero(each) for each in changed]
    width = begun.shape[1]
    assert columns[0].max() < 0.6 * width < 0.9 * width < columns[1].max()
    assert columns[0].min() == pytest.approx(columns[1].min(), abs=8)


def test_what_leaves_the_frame_for_good_is_said_to_diverge():
    scenario = scenarios.get("pitch/delay-5.7", 1)
    r = np.asarray(scenario.r, float)
    k = np.arange(r.shape[1])
    alone, held, gone = r * 0.3, r * (1 - 0.9**k), 1.05**k * np.sin(k / 5.0)[None]
    gone[0, -20:] = np.nan

    def traces(y):
        return {scenario.id: Traces(y[:, 0], r, y, r, -np.abs(r - y), None, None, None)}

    figure = figures.response([scenario], traces(alone), traces(gone))
    assert texts(figure) == ["diverges"]
    low, high = figure.axes[0].get_ylim()
    assert -60.0 < low < high < 60.0
    assert texts(figures.response([scenario], traces(alone), traces(held))) == []


def test_a_learning_curve_has_a_line_a_seed_and_the_levels(tmp_path):
    rows = [{"updates": 1000 * k, "mae": 3.0 / (k + 1), **({"reward": -1.0} if k else {})} for k in range(4)]
    path = figures.save(figures.learning_curve({0: rows, 1: rows}, {"static": 3.4}, "MAE"), tmp_path / "curve.png")
    assert path.stat().st_size > 10_000


def test_levels_far_above_the_curve_are_told_and_not_drawn():
    rows = [{"updates": 600 * k, "mae": 0.5, "gain": 0.0, "kept": 0.0, "rate": 1.0} for k in range(1, 4)]
    levels = {"none": 15.6, "static": 1.9, "lq": 0.56, "paper's DRL": 1.17}
    figure = figures.learning_curve({0: rows}, levels, "MAE")
    assert figure.axes[0].get_ylim()[1] < 2.2
    labels = [text.get_text() for text in figure.legends[0].texts]
    assert sorted(labels) == ["lq 0.56", "none 15.6, above", "paper's DRL 1.17", "seed 0", "static 1.9"]


def test_a_learning_curve_of_pairs_shows_what_the_gate_let_through():
    kept = [{"updates": 600 * k, "mae": 2.6, "gain": 0.5, "kept": k % 2, "rate": 1.0} for k in range(1, 4)]
    check = {"updates": 1800, "mae": 2.6, "gain": 9.0, "kept": 1.0}
    _, right = figures.learning_curve({0: [*kept, check]}, {}, "MAE").axes
    np.testing.assert_array_equal(right.lines[0].get_ydata(), [0.5, 0.5, 1.0, 1.0])
