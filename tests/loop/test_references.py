"""Families of references and goal generators, by what defines each."""

from __future__ import annotations

from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop.references import FAMILIES, Family, Goal, Reaimed, SetPoint, Still, held, redrawn, telegraph, wander
from tests.precision import FLOAT

KEY = jax.random.key(0)
STEPS = 200
LOW, HIGH = -12.0, 20.0
MIDDLE, HALF = 4.0, 16.0
MEMBERS = 100


@cache
def members(kind: str, steps: int = STEPS) -> np.ndarray:
    """(MEMBERS, steps)."""
    draw = jax.jit(jax.vmap(lambda key: FAMILIES[kind](key, steps, LOW, HIGH)))
    return np.asarray(draw(jax.random.split(KEY, MEMBERS)))


def runs(r: np.ndarray) -> list[tuple[float, int]]:
    """Held values of one trajectory and how long each is held."""
    starts = np.flatnonzero(np.diff(r, prepend=np.nan))
    return [(float(part[0]), len(part)) for part in np.split(r, starts[1:])]


@pytest.mark.parametrize("kind", FAMILIES)
def test_family_stays_in_its_range_and_differs_from_member_to_member(kind: str) -> None:
    r = members(kind)
    chex.assert_shape(r, (MEMBERS, STEPS))
    chex.assert_type(r, FLOAT)
    assert r.min() >= LOW - 1e-5
    assert r.max() <= HIGH + 1e-5
    assert len(np.unique(r, axis=0)) == MEMBERS


def test_steps_are_one_set_point_over_all_of_the_range() -> None:
    r = members("steps")
    np.testing.assert_array_equal(np.ptp(r, axis=1), 0.0)
    assert np.ptp(r) > 0.9 * 2 * HALF


@pytest.mark.parametrize("steps", [200, 600])
def test_staircase_has_five_set_points_held_equally_long(steps: int) -> None:
    for r in members("staircase", steps):
        assert [length for _, length in runs(r)] == [steps // 5] * 5


def test_ramps_are_five_straight_lines_without_jumps() -> None:
    for r in members("ramps"):
        bends = np.flatnonzero(np.abs(np.diff(r.astype(float), 2)) > 1e-4) + 1
        assert set(bends) <= {40, 80, 120, 160}
        assert np.abs(np.diff(r)).max() <= 2 * HALF / (STEPS / 5) + 1e-4
    assert np.ptp(members("ramps")) > HALF


def test_sines_swing_about_the_middle_at_one_frequency() -> None:
    time = np.arange(STEPS) / STEPS
    for r in members("sines"):
        wave = r.astype(float) - MIDDLE
        assert wave[0] == pytest.approx(0.0, abs=1e-4)
        assert 0.25 * HALF * 0.95 < np.abs(wave).max() <= HALF + 1e-4
        crossings = np.count_nonzero(np.diff(np.sign(wave[1:])))
        assert 5 <= crossings <= 24  # 3 to 12 periods, two each
        # A sampled sine obeys r_(k+1) + r_(k-1) = 2 cos(w) r_k.
        neighbours = wave[2:] + wave[:-2]
        twice_cosine = neighbours @ wave[1:-1] / (wave[1:-1] @ wave[1:-1])
        np.testing.assert_allclose(neighbours, twice_cosine * wave[1:-1], atol=1e-3)
        assert 3.0 - 0.1 < np.arccos(twice_cosine / 2) / (2 * np.pi * time[1]) < 12.0 + 0.1


def test_doublets_are_middle_one_way_the_other_way_middle() -> None:
    first = []
    for r in members("doublets"):
        (rest, before), (one, width_one), (other, width_other), (last, after) = runs(r)
        assert rest == last == MIDDLE
        assert one - MIDDLE == pytest.approx(MIDDLE - other, abs=1e-4)
        assert 0.25 * HALF - 1e-4 <= abs(one - MIDDLE) <= HALF + 1e-4
        assert abs(width_one - width_other) <= 1
        assert STEPS // 8 - 1 <= width_one <= STEPS // 4 + 1
        assert before == STEPS // 8
        assert after >= STEPS * 3 // 8 - 1
        first.append(np.sign(one - MIDDLE))
    assert set(first) == {-1.0, 1.0}


def test_days_are_sixteen_warm_and_eight_cool_hours() -> None:
    beginnings = set()
    for r in members("days"):
        cool, warm = np.unique(r)
        assert LOW <= cool <= MIDDLE <= warm <= HIGH
        np.testing.assert_array_equal(r[24:], r[:-24])
        assert np.count_nonzero(r[:24] == warm) == 16
        inner = runs(r)[1:-1]
        assert all(length == (16 if value == warm else 8) for value, length in inner)
        beginnings.add((r[0] == warm, runs(r)[0][1]))
    assert len(beginnings) > 12, "days begin at a random hour"


def telegraphs(redraw: float) -> np.ndarray:
    """(MEMBERS, STEPS)."""
    draw = jax.jit(jax.vmap(lambda key: telegraph(key, STEPS, LOW, HIGH, redraw)))
    return np.asarray(draw(jax.random.split(KEY, MEMBERS)))


def test_telegraph_that_is_never_redrawn_is_constant() -> None:
    r = telegraphs(0.0)
    np.testing.assert_array_equal(np.ptp(r, axis=1), 0.0)
    assert len(np.unique(r[:, 0])) == MEMBERS


def test_telegraph_redrawn_with_certainty_changes_at_each_step() -> None:
    assert np.all(np.diff(telegraphs(1.0)) != 0.0)


@pytest.mark.parametrize("redraw", [0.02, 0.2])
def test_telegraph_holds_levels_of_the_range_and_changes_as_often_as_asked(redraw: float) -> None:
    r = telegraphs(redraw)
    chex.assert_type(r, FLOAT)
    assert LOW <= r.min() < LOW + 0.5
    assert HIGH - 0.5 < r.max() <= HIGH
    n = MEMBERS * (STEPS - 1)
    assert abs(np.count_nonzero(np.diff(r)) - n * redraw) < 5 * np.sqrt(n * redraw * (1 - redraw))
    levels = np.array([level for one in r for level, _ in runs(one)])
    assert len(np.unique(levels)) > 0.99 * len(levels), "each level is drawn anew"
    assert levels.mean() == pytest.approx(MIDDLE, abs=5 * HALF / np.sqrt(3 * len(levels)))


@partial(jax.jit, static_argnums=0)
def _follow(goal: Goal, y: jax.Array) -> jax.Array:
    state, r0 = goal.init(KEY, y[0])
    return jnp.concatenate([r0[None], jax.lax.scan(goal.step, state, y[1:])[1]])


def follow(goal: Goal, outputs: np.ndarray) -> np.ndarray:
    """r_0, r_1, ... when the plant gives these outputs, the first before the first step."""
    return np.asarray(_follow(goal, jnp.asarray(outputs, float)))


def test_set_point_is_held_for_the_whole_episode() -> None:
    r = follow(SetPoint(LOW, HIGH), np.zeros(100))
    np.testing.assert_array_equal(r, r[0])


def test_set_points_of_different_keys_fill_the_range() -> None:
    goal = SetPoint(LOW, HIGH)
    r = jax.jit(jax.vmap(goal.init, (0, None)))(jax.random.split(KEY, 1000), jnp.zeros(()))[1]
    assert LOW <= float(r.min()) < LOW + 0.5
    assert HIGH - 0.5 < float(r.max()) <= HIGH
    assert float(r.mean()) == pytest.approx(MIDDLE, abs=5 * HALF / np.sqrt(3 * 1000))


def test_set_point_redrawn_with_certainty_changes_at_each_step() -> None:
    r = follow(SetPoint(LOW, HIGH, redraw=(1.0, 1.0)), np.zeros(100))
    assert len(np.unique(r)) == 100
    assert LOW <= r.min() < r.max() <= HIGH


def test_set_point_is_redrawn_as_often_as_asked() -> None:
    n, p = 2000, 0.1
    r = follow(SetPoint(LOW, HIGH, redraw=(p, p)), np.zeros(n + 1))
    changes = np.count_nonzero(np.diff(r))
    assert abs(changes - n * p) < 5 * np.sqrt(n * p * (1 - p))


def test_set_point_does_not_depend_on_the_output() -> None:
    goal = SetPoint(LOW, HIGH, redraw=(0.1, 0.1))
    np.testing.assert_array_equal(follow(goal, np.zeros(2001)), follow(goal, np.linspace(-9.0, 9.0, 2001)))


def test_reaimed_changes_exactly_when_the_output_is_near() -> None:
    goal = Reaimed(-1.0, 1.0, tolerance=0.4)
    y = np.random.default_rng(0).uniform(-1.5, 1.5, 200).astype(np.float32)
    r = follow(goal, y)
    near = np.abs(r[:-1] - y[1:]) < np.float32(0.4)
    np.testing.assert_array_equal(np.diff(r) != 0, near)
    assert 10 < np.count_nonzero(near) < 190
    assert -1.0 <= r.min() < r.max() <= 1.0


@pytest.mark.parametrize(("distance", "changes"), [(0.25, False), (0.2499, True), (-0.25, False), (-0.2499, True)])
def test_reaimed_tolerance_is_exclusive(distance: float, changes: bool) -> None:
    goal = Reaimed(0.5, 2.0, tolerance=0.25)
    state, _ = goal.init(KEY, jnp.zeros(()))
    state = state._replace(r=jnp.asarray(1.0, float))
    _, r = goal.step(state, jnp.asarray(1.0 + distance, float))
    assert (float(r) != 1.0) == changes


@pytest.mark.parametrize("kind", ["staircase", "days"])
def test_family_goal_plays_its_trajectory_and_holds_the_end(kind: str) -> None:
    r = follow(Family(kind, 60, LOW, HIGH), np.zeros(90))
    expected = np.asarray(jax.jit(lambda: FAMILIES[kind](KEY, 60, LOW, HIGH))())
    np.testing.assert_allclose(r[:60], expected, atol=1e-5)
    np.testing.assert_array_equal(r[60:], r[59])


@pytest.mark.parametrize("goal", [Still(), SetPoint(0.0, 1.0), Reaimed(0.0, 1.0, 0.1), Family("days", 24, 0.0, 1.0)])
def test_goals_are_static(goal: Goal) -> None:
    assert hash(goal) == hash(type(goal)(*vars(goal).values()))


def wandering(inertia: float) -> np.ndarray:
    """(MEMBERS, STEPS)."""
    draw = jax.jit(jax.vmap(lambda key: wander(key, STEPS, LOW, HIGH, inertia)))
    return np.asarray(draw(jax.random.split(KEY, MEMBERS)))


def test_a_course_wanders_over_all_of_the_range_alike() -> None:
    r = wandering(2.0)
    assert r.min() >= LOW
    assert r.max() <= HIGH
    shares = np.histogram(r, bins=8, range=(LOW, HIGH))[0] / r.size
    np.testing.assert_allclose(shares, 1 / 8, atol=0.02)


def test_with_more_inertia_a_course_is_smoother() -> None:
    """Behind two lags the speed is finite: it falls as 1 / inertia."""
    slow, fast = wandering(20.0), wandering(5.0)
    speeds, changes = ([np.abs(np.diff(r, n)).mean() for r in (slow, fast)] for n in (1, 2))
    assert speeds[0] == pytest.approx(speeds[1] / 4, rel=0.3)
    assert changes[0] < 0.6 * speeds[0]  # white noise: 1.7


def test_training_references_are_of_four_kinds_in_the_range() -> None:
    r = np.asarray(jax.jit(jax.vmap(lambda key: redrawn(key, STEPS, LOW, HIGH)))(jax.random.split(KEY, 400)))
    assert r.min() >= LOW
    assert r.max() <= HIGH
    moving = (np.diff(r, axis=1) != 0).mean(1)
    assert np.mean(moving == 0) == pytest.approx(0.2 + 0.2 * 0.13, abs=0.06)  # one set-point, or never redrawn
    assert np.mean((moving > 0) & (moving < 0.3)) == pytest.approx(0.17, abs=0.06)
    assert np.mean(moving > 0.9) == pytest.approx(0.6, abs=0.08)


def test_steps_since_the_last_change_are_counted() -> None:
    r = jnp.asarray([1.0, 1.0, 3.0, 3.0, 3.0, 1.0])
    np.testing.assert_array_equal(held(r), [0, 1, 0, 1, 2, 0])
    np.testing.assert_array_equal(held(jnp.ones(3)), [0, 1, 2])
