import json

import jax
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.training.config import preset
from tests.load import load

cases, slower, throughput = (load("benchmarks", name) for name in ("cases", "slower", "throughput"))


def test_an_update_of_the_paper_is_counted_at_157_mflop():
    assert cases.update_mflop(preset("pitch", "paper")) == throughput.PAPER_MFLOP == 157


def test_the_numpy_loop_is_the_heaters_plant():
    plant, params = plants.make("heaters", n=2, x0_mean=[15.0, 21.0], x0_spread=0.0, sigma=0.0)
    r_tilde = [30.0, 30.0, 5.0, 18.0]
    expected = plants.simulate(plant, params, r_tilde, jax.random.key(0))
    x0 = np.float32([[15.0, 21.0]])
    x, mean, p = x0.copy(), [], jax.tree.map(float, params.house)
    for k, value in enumerate(r_tilde):
        cases.numpy_hour(x, x0, k, np.float32([[value]]), p, np.random.default_rng(0), np.empty_like(x))
        mean.append(x.mean())
    np.testing.assert_allclose(mean, expected, rtol=2e-6)


def test_a_row_has_the_median_ratio_of_its_rounds():
    measured = throughput.Measured(throughput.About("updates/s", "sgemm_gflops", {"mflop": 500}))
    measured.rounds = [
        (100.0, {"sgemm_gflops": 100.0}),
        (300.0, {"sgemm_gflops": 200.0}),
        (90.0, {"sgemm_gflops": 50.0}),
    ]
    row = measured.row("fused/paper")
    assert (row["median"], row["min"], row["max"]) == (100.0, 90.0, 300.0)
    assert row["ratio"] == 0.75  # of 0.5, 0.75 and 0.9
    content = throughput.results({"fused/paper": measured}, {})
    assert content["yardsticks"] == {"sgemm_gflops": 100.0}


def test_cases_are_chosen_by_globs():
    listed = [
        throughput.Case(name, None, quick) for name, quick in (("plant/a", True), ("plant/b", False), ("c", True))
    ]
    names = [case.name for case in throughput.choose(listed, ("plant/*",), quick=False)]
    assert names == ["plant/a", "plant/b"]
    assert [case.name for case in throughput.choose(listed, (), quick=True)] == ["plant/a", "c"]
    with pytest.raises(ValueError, match="'plan' is no case; there are: plant/a, plant/b, c"):
        throughput.choose(listed, ("c", "plan"), quick=False)


def row(middle, low, high, ratio=None, unit="updates/s"):
    return {"case": "x", "median": middle, "min": low, "max": high, "ratio": ratio, "unit": unit}


@pytest.mark.parametrize(
    ("before", "after", "factor", "real"),
    [
        (row(100, 95, 105, 0.5), row(80, 78, 82, 0.4), 0.8, True),
        (row(100, 95, 105, 0.5), row(50, 48, 52, 0.5), 1.0, False),  # a machine of half the speed
        (row(100, 70, 105, 0.5), row(80, 78, 82, 0.4), 0.8, False),  # within the range
        (row(100, 99, 101, 0.5), row(94, 93, 95, 0.47), 0.94, False),  # within the tolerance
        (row(4, 3.9, 4.1, unit="s"), row(5, 4.9, 5.1, unit="s"), 0.8, True),
        (row(500, 490, 510, unit="MiB"), row(250, 240, 260, unit="MiB"), 2.0, True),
    ],
)
def test_a_change_is_beyond_tolerance_and_range(before, after, factor, real):
    assert slower.change(before, after, 0.1) == (pytest.approx(factor), real)


def test_yardstick_that_drifts_is_no_change_on_one_machine():
    before, after = row(100, 95, 105, 0.5), row(100, 95, 105, 0.4)
    assert slower.change(before, after, 0.1) == (pytest.approx(0.8), True)
    assert slower.change(before, after, 0.1, same_machine=True) == (pytest.approx(1.0), False)
    assert slower.change(before, row(70, 69, 71, 0.3), 0.1, same_machine=True) == (pytest.approx(0.7), True)


def test_slower_names_cases_and_sets_the_status(tmp_path, capsys):
    before, after = tmp_path / "before.json", tmp_path / "after.json"
    before.write_text(json.dumps({"rows": [row(100, 99, 101), row(1, 1, 1) | {"case": "gone"}]}))
    after.write_text(json.dumps({"rows": [row(50, 49, 51)]}))
    with pytest.raises(SystemExit) as end:
        slower.main(before, after)
    out = capsys.readouterr().out
    assert end.value.code == 1
    assert "slower  x: 0.50 x as good (100 -> 50 updates/s)\nmissing  gone" in out
    with pytest.raises(SystemExit) as end:
        slower.main(before, before)
    assert end.value.code == 0
    before.write_text("[]")
    with pytest.raises(ValueError, match="is not a results file"):
        slower.main(before, after)
