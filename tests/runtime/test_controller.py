"""The controller in a loop: the spec itself, and everything that can come between."""

from __future__ import annotations

import csv
import dataclasses
import math
import subprocess
import sys
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxouter import plants
from jaxouter.exports.spec import ControllerSpec
from jaxouter.runtime import Controller
from jaxouter.runtime.controller import REASONS, Event, Row
from tests.exports.test_spec import chosen, learned

PART = 2.0  # of the difference at a switch, in the tests with a spec of r~ = 3 r


@pytest.fixture(scope="module")
def pitch() -> ControllerSpec:
    """A random spec that uses its whole range: -60 to 60, as y; a control step is 0.1 s; remembers 3 samples."""
    return learned("pitch")[-1]


@pytest.fixture
def static(pitch: ControllerSpec) -> ControllerSpec:
    """r~ = 3 r, whatever y."""
    nothing = tuple(np.zeros_like(array) for array in pitch.weights), tuple(np.zeros_like(b) for b in pitch.biases)
    return dataclasses.replace(
        pitch, base_r=np.float32([3]), base_offset=np.float32([0]), weights=nothing[0], biases=nothing[1]
    )


def run(controller: Controller, samples, r=10.0) -> list[float]:
    """r~ of these y, one by one."""
    return [controller.step(r, y) for y in samples]


def wanted(spec: ControllerSpec, rows: list[Row]) -> list[float]:
    """What the spec would have in each step, had it seen all y and the r~ that was applied."""
    state, out = spec.init(rows[0].y), []
    for row in rows:
        state = spec.observe(state, row.r, row.y)
        out.append(float(spec.r_tilde(state, row.r, row.y)))
        state = spec.record(state, row.y, row.r_tilde)
    return out


@pytest.mark.parametrize("name", ["pitch", "heaters"])
def test_it_acts_like_the_policy(name, tmp_path):
    policy, params, spec = learned(name)
    low, high = spec.r_tilde_bounds
    spec.save(tmp_path / "controller.npz")
    controller = Controller.load(tmp_path / "controller.npz")
    r, y = np.random.default_rng(1).uniform(*spec.setpoint_range, (2, 100))
    state, got, of_law = spec.init(y[0]), [], []
    for k, (r_k, y_k) in enumerate(zip(r, y, strict=True)):
        state, r_tilde = spec.act(state, r_k, y_k)
        of_law.append(r_tilde)
        got.append(controller.step(r_k, y_k, k * spec.control_step))
    assert np.ptp(got) > 0.01 * (high - low)
    np.testing.assert_allclose(got, of_law, atol=1e-5 * (high - low))
    np.testing.assert_allclose(got, chosen(policy, params, r, y), atol=1e-5 * (high - low))
    assert type(controller.step(r[0], y[0])) is float
    assert controller.reason is None
    assert set(controller.counts.values()) == {0}
    assert controller.log == [Event(0, 0.0, "control", None)]


def test_switching_has_no_bumps(static):
    controller = Controller(static, engaged=False)
    assert run(controller, [0.0] * 3) == [10.0] * 3
    assert controller.reason == "disengaged"
    controller.engage()
    np.testing.assert_allclose(run(controller, [0.0] * 12), [*np.arange(12.0, 31.0, PART), 30.0, 30.0])
    assert controller.reason is None
    controller.disengage()
    np.testing.assert_allclose(run(controller, [0.0] * 4), [28.0, 26.0, 24.0, 22.0])
    controller.engage()  # in the midst of it
    np.testing.assert_allclose(run(controller, [0.0] * 2), [22.8, 23.6])
    assert controller.counts == dict.fromkeys(REASONS, 0) | {"disengaged": 7}
    assert [event[:1] + event[2:] for event in controller.log] == [
        (0, "pass through", "disengaged"),
        (3, "control", None),
        (15, "pass through", "disengaged"),
        (19, "control", None),
    ]


def test_going_and_coming_by_itself_has_no_bumps(static):
    controller = Controller(static, return_after=2)
    np.testing.assert_allclose(run(controller, [0.0, None, 0.0, 0.0, 0.0]), [30.0, 28.0, 26.0, 26.4, 26.8])


def test_in_closed_loop_no_move_is_larger_than_its_part(pitch):
    plant, params = plants.make("pitch")
    rows: list[Row] = []
    spec = dataclasses.replace(pitch, base_r=np.float32([2]), weights=(*pitch.weights[:-1], 0.3 * pitch.weights[-1]))
    controller = Controller(spec, engaged=False, record=rows.append)
    key = jax.random.key(0)
    state, step = plant.init(key, params), jax.jit(plant.step)
    for k in range(240):
        if k % 40 == 20:
            (controller.disengage if controller.engaged else controller.engage)()
        y = float(plant.output(params, state))
        r_tilde = controller.step(12.0, y, k * plant.control_step)
        state = step(params, state, jnp.asarray(r_tilde, float), key)
    of_law = wanted(spec, rows)
    now = [row.r if row.reason else value for row, value in zip(rows, of_law, strict=True)]
    switches = [k for k, (a, b) in enumerate(pairwise(rows), 1) if a.reason != b.reason]
    assert switches == list(range(20, 240, 40))
    differences = {k: rows[k - 1].r_tilde - now[k] for k in switches}
    assert max(map(abs, differences.values())) > 5.0
    assert np.ptp([row.y for row in rows]) > 5.0
    for k in switches:
        for j in range(10):  # the move that is wanted anyway, and a part
            move = rows[k + j].r_tilde - rows[k + j - 1].r_tilde
            anyway = now[k + j] - now[k + j - 1] if j else 0.0
            assert abs(move - anyway) <= abs(differences[k]) / 10 + 1e-3
    later = [k for k in range(20, 240) if (k - 20) % 40 >= 10]  # also of the spec, as if it had never been away
    np.testing.assert_allclose([rows[k].r_tilde for k in later], [now[k] for k in later], atol=2e-3)


def test_start_from_what_the_plant_has(static):
    controller = Controller(static, r_tilde=-20.0, transfer_steps=5)
    np.testing.assert_allclose(run(controller, [0.0] * 6), [-10.0, 0.0, 10.0, 20.0, 30.0, 30.0])
    assert Controller(static, r_tilde=-20.0).step(None, None) == -20.0  # nothing else is known
    assert Controller(static).step(None, None) == 0.0


def test_the_law_knows_what_was_applied_before_it(pitch):
    controller = Controller(pitch, r_tilde=-20.0, transfer_steps=1)
    state = pitch.observe(pitch.init(4.0, -20.0), 10.0, 4.0)
    assert controller.step(10.0, 4.0) == float(pitch.r_tilde(state, 10.0, 4.0))
    first = Controller(pitch, r_tilde=-20.0, return_after=1, transfer_steps=1)
    first.step(None, None)  # no y yet
    assert first.step(10.0, 4.0) == float(pitch.r_tilde(state, 10.0, 4.0))


def test_bounds_and_rate_limit(static):
    controller = Controller(static, bounds=(-5.0, 25.0), rate_limit=4.0, r_tilde=0.0, transfer_steps=1)
    assert run(controller, [0.0] * 8) == [4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 25.0, 25.0]
    controller.disengage()
    assert run(controller, [0.0] * 2, r=-50.0) == [21.0, 17.0]
    assert run(controller, [0.0] * 9, r=-50.0)[-2:] == [-5.0, -5.0]
    fading = Controller(static, bounds=(-5.0, 25.0), r_tilde=-5.0, transfer_steps=10)
    assert run(fading, [0.0], r=5.0) == [-3.0]
    fading.disengage()
    assert run(fading, [0.0], r=20.0) == pytest.approx([-0.7])  # the difference is -23
    assert run(fading, [0.0], r=-5.0) == [-5.0]


@pytest.mark.parametrize(
    ("sample", "reason"),
    [
        ((None, 0.0, 0.2), "missing"),
        ((10.0, None, 0.2), "missing"),
        ((math.nan, 0.0, 0.2), "not finite"),
        ((10.0, math.inf, 0.2), "not finite"),
        ((10.0, 0.0, math.nan), "not finite"),
        ((10.0, 0.0, 0.27), "late"),
        ((10.0, 60.1, 0.2), "out of range"),
        ((-60.1, 0.0, 0.2), "out of range"),
    ],
)
def test_a_bad_sample_passes_through_until_enough_are_good(static, sample, reason):
    controller = Controller(static, return_after=3, transfer_steps=1)
    for k in range(2):
        controller.step(10.0, 0.0, 0.1 * k)
    passed = max(-60.0, sample[0]) if sample[0] is not None and math.isfinite(sample[0]) else 10.0
    assert controller.step(*sample) == passed
    assert controller.reason == reason
    start = sample[2] if math.isfinite(sample[2]) else 0.2
    seen = []
    for k in range(1, 5):
        controller.step(10.0, 0.0, start + 0.1 * k)
        seen.append(controller.reason)
    assert seen == ["returning", "returning", None, None]
    assert {name: n for name, n in controller.counts.items() if n} == {reason: 1, "returning": 2}


def test_y_at_the_edge_of_its_range_does_not_chatter(static):
    controller = Controller(static, y_range=(-20.0, 20.0), return_after=4)
    run(controller, [19.0, 21.0] * 20)
    run(controller, [19.0] * 4)
    assert [event.what for event in controller.log if event.why != "returning"][:2] == ["control", "pass through"]
    assert sum(event.what == "control" for event in controller.log) == 2
    assert controller.reason is None


def test_reasons_have_an_order(static):
    controller = Controller(static, clock=iter([0.0, 9.0, 18.0, 27.0, 27.1]).__next__, return_after=1)
    seen = []
    for r, y in ((1.0, 1.0), (None, math.nan), (math.nan, 99.0), (99.0, 1.0), (99.0, 1.0)):
        controller.step(r, y)
        seen.append(controller.reason)
    assert seen == [None, "missing", "not finite", "late", "out of range"]
    controller.disengage()
    controller.step(None, None, 27.2)
    assert controller.reason == "disengaged"


def test_late_needs_two_times_and_time_may_go_back(static):
    controller = Controller(static, late_after=3.0)
    for time in (None, 50.0, 50.3, None, 70.0, 10.0, 10.1):
        controller.step(1.0, 1.0, time)
        assert controller.reason is None


def test_what_was_missed_is_remembered_as_the_last_sample(pitch):
    controller = Controller(pitch, return_after=1, transfer_steps=1, late_after=10.0)
    state, r_tilde = pitch.init(2.0), 0.0
    y_before = 2.0
    for y, time, missed in ((2.0, 0.0, 0), (5.0, 0.1, 0), (7.0, 0.3, 1), (8.0, 0.6, 2)):
        for _ in range(missed):
            state = pitch.record(pitch.observe(state, 10.0, y_before), y_before, r_tilde)
        state = pitch.observe(state, 10.0, y)
        r_tilde = controller.step(10.0, y, time)
        assert r_tilde == float(pitch.r_tilde(state, 10.0, y))
        state, y_before = pitch.record(state, y, r_tilde), y
    controller.step(10.0, None, 0.7)
    state = pitch.record(pitch.observe(state, 10.0, 8.0), 8.0, 10.0)
    assert controller.step(10.0, 6.0, 0.8) == float(pitch.r_tilde(pitch.observe(state, 10.0, 6.0), 10.0, 6.0))


def test_a_wild_sample_is_remembered_within_the_range(pitch):
    controllers = [Controller(pitch, return_after=1, transfer_steps=1) for _ in range(2)]
    for controller, wild in zip(controllers, (1e300, 61.0), strict=True):
        run(controller, [0.0, wild])
    assert run(controllers[0], [1.0, 2.0]) == run(controllers[1], [1.0, 2.0])


def test_steps_can_be_recorded(static, tmp_path):
    with (tmp_path / "steps.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        controller = Controller(static, record=writer.writerow)
        controller.step(1.0, 0.5, 0.0)
        controller.step(1.0, None, 0.1)
    text = (tmp_path / "steps.csv").read_text()
    assert text.splitlines() == ["step,time,r,y,r_tilde,reason", "0,0.0,1.0,0.5,3.0,", "1,0.1,1.0,,2.8,missing"]


def test_the_log_is_bounded(static):
    controller = Controller(static, log_length=3, return_after=1)
    run(controller, [0.0, None] * 10)
    assert [event.step for event in controller.log] == [17, 18, 19]


anything = st.none() | st.floats() | st.floats(-70.0, 70.0) | st.floats(-17.0, 17.0)
samples = st.tuples(anything, anything, st.none() | st.floats() | st.floats(0.0, 3.0), st.booleans())


@settings(deadline=None, max_examples=150, derandomize=True)
@given(st.lists(samples, min_size=1, max_size=60), st.floats(0.01, 200.0), st.integers(1, 12), st.integers(1, 6))
def test_in_a_storm_r_tilde_stays_within_bounds_and_rate(pitch, storm, rate_limit, transfer_steps, return_after):
    controller = Controller(
        pitch,
        bounds=(-50.0, 40.0),
        rate_limit=rate_limit,
        transfer_steps=transfer_steps,
        return_after=return_after,
    )
    before = None
    for r, y, time, engaged in storm:
        (controller.engage if engaged else controller.disengage)()
        assert controller.engaged is engaged
        r_tilde = controller.step(r, y, time)
        assert -50.0 <= r_tilde <= 40.0
        assert before is None or abs(r_tilde - before) <= rate_limit * (1 + 1e-9)
        assert (controller.reason is None) <= (engaged and r is not None and y is not None and -60 <= y <= 60)
        before = r_tilde
    assert sum(controller.counts.values()) <= len(storm)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"bounds": (-70.0, 10.0)}, r"bounds is \(-70.0, 10.0\); they must lie within those of the spec, -60 to 60"),
        ({"bounds": (10.0, -10.0)}, "bounds is .* the first below the second"),
        ({"bounds": (math.nan, 10.0)}, "bounds is .* they must lie within"),
        ({"r_tilde": 61.0}, "r_tilde is 61.0; it must lie within the bounds, -60 to 60"),
        ({"r_tilde": math.nan}, "r_tilde is nan"),
        ({"rate_limit": 0.0}, "rate_limit is 0.0; it must be positive"),
        ({"transfer_steps": 0}, "transfer_steps is 0; it must be a whole number, at least 1"),
        ({"return_after": 2.5}, "return_after is 2.5"),
        ({"return_after": math.inf}, "return_after is inf"),
        ({"y_range": (5.0, 5.0)}, "y_range is .* the first below the second"),
        ({"y_range": (-math.inf, 5.0)}, "y_range is .* two numbers"),
        ({"late_after": 1.0}, "late_after is 1.0; it must be more than 1 control step"),
        ({"late_after": math.nan}, "late_after is nan"),
        ({"log_length": -1}, "log_length is -1; it must not be negative"),
    ],
)
def test_settings_that_do_not_fit(static, setting, message):
    with pytest.raises(ValueError, match=message):
        Controller(static, **setting)


def test_a_law_that_is_not_finite(static):
    broken = dataclasses.replace(static, biases=(*static.biases[:-1], np.full(1, np.nan, np.float32)))
    with pytest.raises(ValueError, match="not finite"):
        Controller(broken)


def test_it_needs_no_jax():
    code = "import sys; from jaxouter.runtime import Controller; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
