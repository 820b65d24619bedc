import json

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from jaxouter.evaluation import statistics
from jaxouter.evaluation.results import (
    BestBaseline,
    GridErrors,
    Improvement,
    Location,
    PolicyInfo,
    Row,
    Summary,
    SweepErrors,
)
from jaxouter.tasks import Axis

POLICIES = {
    "none": PolicyInfo("baseline"),
    "pi": PolicyInfo("baseline"),
    "learned": PolicyInfo("learned"),
    "mine.py": PolicyInfo("user"),
    "oracle": PolicyInfo("limit"),
    "clairvoyant": PolicyInfo("preview"),
}
LIMIT = 2.0


def row(policy, scenario, mae, within=True, run=None, seed=None):
    if mae is None:
        return Row(policy, run, seed, scenario, None, None, False, None, diverged=True)
    return Row(policy, run, seed, scenario, mae / LIMIT, None, within, None, mae=mae)


def seeds(maes, scenario="a", run="runs/x-0", **rest):
    return [row("learned", scenario, mae, run=run, seed=i, **rest) for i, mae in enumerate(maes)]


def test_interquartile_mean_leaves_out_the_outer_quarters():
    assert statistics.interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0])) == pytest.approx(2.5)
    assert statistics.interquartile_mean(np.array([[9.0, 1.0, 2.0, 3.0, 100.0]])) == pytest.approx([14 / 3])


def test_location_is_the_mean_over_scenarios_of_what_each_has():
    found = statistics.location([np.array([1.0, 2.0, 6.0]), np.array([10.0, 10.0, 10.0])])
    assert found.median == pytest.approx(6.0)
    assert found.iqm == pytest.approx(6.5)
    low, high = found.median_interval
    assert (low, high) == (5.5, 8.0)  # all of the three medians that the first scenario can have


def test_interval_of_a_mean_covers_as_the_normal_one_does():
    sample = np.random.default_rng(3).normal(5.0, 1.0, 200)
    low, high = statistics.interval(lambda x: np.mean(x, axis=-1), [sample])
    half = 1.96 * sample.std(ddof=1) / 200**0.5
    assert [low, high] == pytest.approx([sample.mean() - half, sample.mean() + half], abs=0.1 * half)


def test_interval_is_the_same_at_every_call_and_none_with_one_seed():
    sample = np.array([1.0, 2.0, 4.0])
    first = statistics.location([sample])
    assert first == statistics.location([sample])
    one = statistics.location([np.array([3.0])])
    assert (one.median, one.median_interval, one.iqm_interval) == (3.0, None, None)


def test_diverged_seed_counts_as_infinite():
    found = statistics.location([np.array([1.0, 2.0, np.inf])])
    assert (found.median, found.median_interval, found.iqm) == (2.0, None, None)


def test_probability_of_improvement_by_hand():
    found = statistics.improvement(
        [np.array([1.0, 3.0]), np.array([2.0, 2.0])], [np.array([2.0]), np.array([2.0, np.inf])]
    )
    assert found.probability == pytest.approx((0.5 + 0.75) / 2)
    low, high = found.interval
    assert 0.25 <= low < found.probability < high <= 1.0
    assert statistics.improvement([np.array([np.inf])], [np.array([np.inf])]) == Improvement(0.5, None)


def test_ranks_leave_out_what_is_outside_the_limits_diverged_or_knows_too_much():
    rows = [
        *seeds([3.0, 9.0, 4.0]),
        row("none", "a", 8.0),
        row("pi", "a", 1.0, within=False),
        row("mine.py", "a", None),
        row("oracle", "a", 0.5),
        row("clairvoyant", "a", 0.4),
    ]
    ranks = [(r.policy, r.rank, r.best) for r in statistics.ranks(rows, POLICIES)]
    assert ranks[:3] == [("learned", 1, True)] * 3  # its median is 4
    assert ranks[3] == ("none", 2, False)
    assert all(rank is None and not best for _, rank, best in ranks[4:])
    assert rows[0].rank is None  # the rows given stay as they are


def test_equal_errors_share_the_better_rank():
    rows = [row("none", "a", 2.0), row("pi", "a", 2.0), row("mine.py", "a", 3.0)]
    assert [r.rank for r in statistics.ranks(rows, POLICIES)] == [1, 1, 3]


@pytest.mark.parametrize(("outside", "rank"), [(1, 1), (2, None)])
def test_line_keeps_the_limits_when_most_of_its_seeds_do(outside, rank):
    rows = [row("learned", "a", 1.0, within=i >= outside, run="x", seed=i) for i in range(3)]
    assert {r.rank for r in statistics.ranks(rows, POLICIES)} == {rank}


def test_several_runs_are_lines_of_their_own():
    rows = [*seeds([1.0], run="runs/a-0"), *seeds([2.0], run="runs/b-0"), *seeds([3.0], run="old/b-0")]
    labels = [line.label for line in statistics.lines([row("pi", "a", 5.0), *rows], POLICIES)]
    assert labels == ["learned a-0", "learned runs/b-0", "learned old/b-0", "pi"]
    assert [line.label for line in statistics.lines(rows[:1], POLICIES)] == ["learned"]


def test_summary_is_json_and_says_what_was_asked():
    rows = [
        *seeds([2.0, 4.0, 6.0]),
        *seeds([2.0, 2.0, 2.0], scenario="b"),
        row("pi", "a", 3.0),
        row("pi", "b", None),
        row("oracle", "a", 2.0),
        row("oracle", "b", 2.0),
    ]
    found = statistics.summarise(rows, POLICIES)
    written = json.dumps(msgspec.to_builtins(found), allow_nan=False)
    assert msgspec.convert(json.loads(written), Summary) == found
    learned, pi, oracle = (found.lines[name] for name in ("learned", "pi", "oracle"))
    assert found.scenarios == ["a", "b"]
    assert (learned.seeds, learned.mean_rank, learned.first, learned.unranked) == (3, 1.5, 1, 0)
    assert learned.scenarios["a"].median == 2.0
    assert learned.mean.median == 1.5
    assert (pi.mean_rank, pi.first, pi.unranked) == (1.5, 1, 1)  # without a rank the last of two
    assert pi.scenarios["b"].median is None
    assert pi.mean.median is None
    assert (oracle.mean_rank, oracle.mean.iqm) == (None, 1.0)
    assert found.improvement["learned"].keys() == {"pi"}
    assert found.improvement["learned"]["pi"].probability == pytest.approx((1 / 3 + 1) / 2)


def test_without_a_limit_there_is_no_ratio():
    rows = [replace(row(name, "a", mae), ratio_to_limit=None) for name, mae in (("none", 2.0), ("pi", 1.0))]
    found = statistics.summarise(rows, POLICIES)
    assert found.scenarios == []
    assert found.lines["pi"].mean == Location()


def test_best_baseline_is_of_the_points_that_all_baselines_have():
    axes = Axis("x", "", (0.0, 0.1, 0.2), 0.0), Axis("z", "", (1.0, 2.0), 1.0)
    errors = {
        "none": GridErrors([[0.0, 0.1, 0.2], [1.0, 2.0]], [[5.0, None], [1.0, 1.0], [4.0, 3.0]]),
        "pi": GridErrors([[0.0, 0.2], [1.0, 2.0]], [[6.0, None], [2.0, 7.0]]),
        "learned": GridErrors([[0.0], [1.0]], [[0.1]]),
    }
    assert statistics.best_baseline(SweepErrors(axes, errors), POLICIES) == BestBaseline(
        values=[[0.0, 0.2], [1.0, 2.0]], mae=[[5.0, None], [2.0, 3.0]], policy=[["none", None], ["pi", "none"]]
    )
    assert statistics.best_baseline(SweepErrors(axes, {"learned": errors["learned"]}), POLICIES) is None


def test_values_on_another_grid_are_missing_where_the_policy_did_not_run():
    swept = GridErrors([[0.0, 0.30000000000000004]], [1.0, None])
    np.testing.assert_array_equal(statistics.on_grid(swept, [[0.0, 0.1, 0.3]]), [1.0, np.nan, np.nan])


def test_table_has_a_line_a_scenario_and_marks_the_best_and_what_left_the_limits():
    rows = [*seeds([1.0, 2.0, 4.0]), row("none", "a", 8.0, within=False), row("oracle", "a", 1.9), row("pi", "a", None)]
    columns, body = statistics.table(statistics.ranks(rows, POLICIES), POLICIES, "*{}*")
    assert columns == ["scenario", "learned", "none", "pi", "oracle"]
    assert body == [["a", "*2 (1.00)*", "8 (4.00)!", "diverged", "1.9 (0.95)"]]
