from dataclasses import replace

import msgspec
import numpy as np
import pytest

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.metrics import FiguresOfMerit, figures_of_merit, held
from jaxouter.evaluation.rollout import Traces

PITCH, HEATERS = scenarios.get("pitch/paper"), scenarios.get("heaters/paper-4", 1)  # steps of 0.1 s and of 1 h


def traces(r, y, r_tilde=None, y0=0.0) -> Traces:
    r, y = (np.atleast_2d(np.asarray(x, float)) for x in (r, y))
    nan = np.full(y.shape, np.nan)
    r_tilde = r if r_tilde is None else np.atleast_2d(np.asarray(r_tilde, float))
    return Traces(np.full(len(y), y0), r, y, r_tilde, -np.abs(r - y), nan, nan, None)


def test_errors_and_their_integrals_by_hand():
    out = figures_of_merit(traces([2, 2, 2, 2], [0, 1, 2, 4]), PITCH, inner_mae=2.5)
    assert out.mae == pytest.approx(1.25)
    assert out.improvement == pytest.approx(50.0)
    assert out.iae == pytest.approx(0.5)
    assert out.ise == pytest.approx(0.1 * (4 + 1 + 0 + 4))
    assert out.itae == pytest.approx(0.1 * (0.1 * 2 + 0.2 * 1 + 0.4 * 2))
    assert out.overshoot == pytest.approx(100.0)
    assert out.episode_return == pytest.approx(-5.0)


def test_held_is_what_stays_within_the_limit_in_the_second_half():
    episodes = traces(np.zeros((3, 4)), [[99, 99, -18, 18], [0, 0, 0, 18.1], [0, 0, np.nan, 0]])
    assert held(episodes, PITCH.plant) == pytest.approx(1 / 3)
    assert held(traces(np.zeros(4), [99, 99, 59, 20]), HEATERS.plant) == 1.0  # no limit: divergence


def test_settling_time_is_when_the_error_stays_within_5_percent_of_the_step():
    y = [5, 10.2, 9, 10.4, 10.6, 10.4, 9.6, 10.1, 10, 10]  # the last one outside 0.5 is the fifth
    assert figures_of_merit(traces([10] * 10, y), PITCH).settling_time == pytest.approx(0.5)


def test_set_point_that_is_never_settled_counts_as_infinite():
    out = figures_of_merit(traces([[10] * 4, [10] * 4, [10] * 4], [[10] * 4, [0] * 4, [0] * 4]), PITCH)
    assert out.settling_time is None
    out = figures_of_merit(traces([[10] * 4, [10] * 4, [10] * 4], [[10] * 4, [10] * 4, [0] * 4]), PITCH)
    assert out.settling_time == 0.0


def test_time_restarts_at_each_set_point():
    out = figures_of_merit(traces([1, 1, -1, -1], [0, 1, 1, -1.5]), PITCH)
    first, second = 0.1 * (0.1 * 1), 0.1 * (0.1 * 2 + 0.2 * 0.5)
    assert out.itae == pytest.approx((first + second) / 2)
    assert out.overshoot == pytest.approx((0.0 + 25.0) / 2)  # the second step is from 1 to -1
    assert out.steady_state_error == pytest.approx((0.0 + 0.5) / 2)


def test_references_that_are_no_set_points_have_no_segment_figures():
    out = figures_of_merit(traces([1, 2, 3], [1, 2, 3]), replace(PITCH, segments=False))
    assert (out.itae, out.overshoot, out.settling_time, out.steady_state_error, out.swing) == (None,) * 5
    assert out.mae == 0.0


def test_time_and_size_outside_the_output_limit():
    out = figures_of_merit(traces([0] * 4, [18, 18.5, -20, 0]), PITCH)
    assert out.violation_time == pytest.approx(0.5)
    assert out.violation_max == pytest.approx(2.0)
    assert out.violation_time_each is None


def test_time_and_size_outside_the_comfort_limit_count_from_the_start():
    out = figures_of_merit(traces([20] * 4, [21.5, 22, 21, 19], y0=20.0), HEATERS)
    assert out.violation_time == pytest.approx(0.5)
    assert out.violation_max == pytest.approx(1.0)


def test_total_variation_starts_at_the_clipped_first_output():
    out = figures_of_merit(traces([1, 1, 1], [0, 0, 0], r_tilde=[10, 20, 15], y0=4.0), PITCH)
    assert out.r_tilde_tv == pytest.approx(6 + 10 + 5)


def test_swing_is_of_the_second_half_of_the_worst_set_point():
    out = figures_of_merit(traces([1] * 4 + [2] * 4, [0] * 8, r_tilde=[0, 9, 4, 4, 9, 0, 1, 3]), PITCH)
    assert out.swing == pytest.approx(1.0)


def test_improvement_means_nothing_where_the_inner_loop_is_unstable():
    unstable = replace(PITCH, stable_alone=False)
    assert figures_of_merit(traces([1], [1]), unstable, inner_mae=3.0).improvement is None


def test_trace_that_is_not_finite_is_diverged_with_no_figures():
    assert figures_of_merit(traces([1, 1], [1, np.nan]), PITCH) == FiguresOfMerit(diverged=True)


def test_figures_are_written_with_all_their_keys_and_read_back():
    for y, extra in (([1, 1], set()), ([1, np.nan], {"diverged"})):
        found = figures_of_merit(traces([1, 1], y), PITCH)
        written = msgspec.to_builtins(found)
        assert set(written) - extra == {
            "mae", "improvement", "iae", "ise", "itae", "overshoot", "settling_time", "steady_state_error",
            "violation_time", "violation_max", "violation_time_each", "violation_max_each", "swing", "r_tilde_tv",
            "return",
        }  # fmt: skip
        assert msgspec.convert(written, FiguresOfMerit) == found
