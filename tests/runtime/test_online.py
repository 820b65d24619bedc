"""The loop in time around a bare function, on a clock that the tests turn."""

from __future__ import annotations

import math
import time

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.loop import references
from jaxouter.loop.policy import affine
from jaxouter.plants.simulators import PlantOptions
from jaxouter.runtime.online import Live, declared
from jaxouter.runtime.realtime import SURE, Loop, StepError, Timing, judged, run
from jaxouter.training.trainer import FIELDS, build
from tests.load import load
from tests.precision import of_single_draws
from tests.training.small import small, with_agent

DT = 0.02
OPTIONS = PlantOptions(r_tilde_bounds=(0.0, 10.0), setpoint_range=(2.0, 6.0))


class Clock:
    """Goes on by so much each time it is read, and when something sleeps."""

    def __init__(self, tick: float = 0.0) -> None:
        self.now, self.tick = 0.0, tick

    def __call__(self) -> float:
        self.now += self.tick
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds + 1e-9


class Lag:
    """y comes to 1 + 0.7 r~ with a time constant of 10 periods, 2 periods late; each step takes some time."""

    def __init__(self, clock: Clock | None = None, taken: dict[int, float] | None = None, given=None) -> None:
        self.clock, self.taken, self.given = clock, taken or {}, given or {}
        self.y, self.line, self.k, self.shown = 3.1, [3.0, 3.0], 0, []

    def __call__(self, r_tilde: float):
        k, self.k = self.k, self.k + 1
        self.shown.append(r_tilde)
        self.line.append(r_tilde)
        self.y += (1.0 + 0.7 * self.line.pop(0) - self.y) / 10.0
        if self.clock is not None:
            self.clock.now += self.taken.get(k, 0.0)
        return self.given.get(k, self.y)


def tiny(takeover: int = 100) -> Live:
    config, env = declared(DT, 100, OPTIONS)
    config = with_agent(config, hidden=(16, 16), batch_size=32)
    return Live.of(config, env, takeover, "static")


def staircase(seed: int = 0) -> np.ndarray:
    keys = jax.random.split(jax.random.key(seed), 20)
    return np.asarray(jax.vmap(lambda key: references.staircase(key, 200, 2.0, 6.0))(keys), float).ravel()


def ran(live, steps, plant=None, clock=None, state=None, r=None, **settings):
    """The loop after so many steps, and its rows."""
    clock, rows = Clock() if clock is None else clock, []
    plant, r = Lag() if plant is None else plant, staircase() if r is None else r
    state = live.fresh(jax.random.key(0)) if state is None else state
    loop = Loop(live, state, plant, lambda k: float(r[k % len(r)]), Timing(DT, **settings), clock=clock)
    run(loop, steps, report=rows.append, sleep=clock.sleep)
    return loop, rows


@pytest.fixture(scope="module")
def learned():
    """From nothing to the policy."""
    return ran(tiny(), 700, learn=True, record=200, most_updates=1)


def test_r_passes_then_the_static_inverse_acts_then_the_lq_law_then_what_was_learned_on_it(learned):
    loop, rows = learned
    stages = list(dict.fromkeys(row.why for row in rows))
    assert stages[:3] == ["recording", "static", "lq"]
    assert [row.why for row in rows].index("lq") in range(401, 410)  # a piece of work a period, after 400 steps
    recorded = [row for row in rows if row.why == "recording"]
    assert len(recorded) == 201  # 200 steps, each up to the next sample
    assert [row.r_tilde for row in recorded] == [row.r for row in recorded]
    assert loop.updates == sum(row.why != "recording" for row in rows) + 1
    assert int(loop.state.agent.updates) == loop.updates - sum(row.why == "static" for row in rows)  # begins anew
    law = loop.state.base
    assert float(law.r) == -float(law.y) > 0.0
    assert float(jnp.sum(law.r_tilde_past)) == pytest.approx(1.0, abs=1e-5)  # it integrates
    assert sum(loop.counts.values()) == loop.steps == 700
    moves = np.abs(np.diff([row.r_tilde for row in rows[195:240]]))
    jumps = np.abs(np.diff([row.r for row in rows[195:240]])) / 0.7
    assert np.all(moves <= jumps + 0.4)  # a part of the difference, and the exploration


def test_the_others_are_what_the_plant_would_have_done(learned):
    _, rows = learned
    r = np.array([row.r for row in rows])
    for name, r_tilde in (("y_passed", r), ("y_kept", np.clip((r - 1) / 0.7, 0, 10))):
        plant = Lag()
        truth = np.array([plant(value) for value in [r[0], *r_tilde[:-1]]])
        told = np.array([math.nan if getattr(row, name) is None else getattr(row, name) for row in rows])
        assert np.isnan(told[:201]).all()
        end = 401 if name == "y_kept" else None  # then it is the LQ law
        np.testing.assert_allclose(told[300:end], truth[300:end], atol=0.03)  # after where they began


def test_the_replay_holds_what_happened(learned):
    loop, rows = learned
    layout, replay = loop.live.replay, loop.state.replay
    assert int(replay.written) == 699
    kept = dict(zip(FIELDS, np.asarray(replay.rows)[0, layout.mirror : layout.mirror + 699].T, strict=True))
    for name, key, which in (("r", "r", rows[:-1]), ("y", "y", rows[:-1]), ("r_tilde", "r_tilde", rows[:-1])):
        np.testing.assert_allclose(kept[name], [getattr(row, key) for row in which], rtol=1e-5)
    np.testing.assert_allclose(kept["y_next"], [row.y for row in rows[1:]], rtol=1e-5)
    np.testing.assert_allclose(kept["r_next"], [row.r for row in rows[1:]], rtol=1e-5)
    np.testing.assert_array_equal(kept["age"], np.arange(699))
    law, n = jax.tree.map(np.asarray, loop.state.base), loop.live.observer.lags
    base = law.offset + law.r * kept["r"] + law.y * kept["y"]
    for i in range(1, n + 1):
        past, applied = (
            np.concatenate([np.full(i, start), kept[name][:-i]])
            for name, start in (("y", kept["y"][0]), ("r_tilde", np.clip(kept["y"][0], 0.0, 10.0)))
        )
        base = base + law.y_past[i - 1] * (past - kept["y"]) + law.r_tilde_past[i - 1] * applied
    np.testing.assert_allclose(base + 5.0 * kept["action"], kept["r_tilde"], atol=1e-3)  # also of what was recorded
    moves = np.abs(np.diff(kept["r_tilde"])), np.abs(kept["y_next"] - kept["y"])[1:]
    e, width = np.abs(kept["r"] - kept["y_next"])[1:], 0.003 * np.ptp(loop.live.env.plant.setpoint_range)
    small = np.minimum(e, width)  # rounded at zero
    price = 0.3 * small * (e - small / 2) / width + 0.1 * moves[0] + 0.1 * moves[1]
    np.testing.assert_allclose(kept["reward"][1:], -price / 2, atol=1e-5)


@pytest.mark.slow
@of_single_draws
def test_it_is_better_than_r_passed_and_no_worse_than_the_lq_law_it_falls_back_to():
    plant, live = Lag(), Live.of(*declared(DT, 200, OPTIONS), 500, "static")
    loop, _ = ran(live, 1600, plant, learn=True, record=300, most_updates=4)
    assert loop.accepted + loop.refused >= 3
    _, rows = ran(live, 500, plant, state=loop.state)  # without learning, and so without exploring
    assert rows[-1].why in ("lq", "learned")
    r, y, law, passed = (np.array([getattr(row, name) for row in rows]) for name in ("r", "y", "y_kept", "y_passed"))
    came, of_law, of_passed = (np.abs(r[:-1] - each[1:]).mean() for each in (y, law, passed))
    assert came < 0.5 * of_passed
    assert came < 1.05 * of_law  # what is compared is the reward, which prices moves too


def test_a_missed_deadline_passes_r_and_is_counted():
    clock = Clock()
    plant = Lag(clock, taken={5: 0.6 * DT, 10: 1.2 * DT, 20: 2.7 * DT})
    live = tiny()
    inverse = affine(1 / 0.7, -1 / 0.7)
    state = live.fresh(jax.random.key(0))._replace(begun=jnp.ones((), bool), base=inverse)
    loop, rows = ran(live, 30, plant, clock, state)
    assert [row.step for row in rows if row.why == "late"] == [10, 20]
    assert loop.counts["late"] == 2
    assert {row.why for row in rows} == {"static", "late"}
    for row in rows:
        assert (row.r_tilde == row.r) == (row.why == "late")
    periods = np.round([row.time / DT for row in rows]).astype(int)
    assert periods[[5, 10, 11, 20, 21]].tolist() == [5, 10, 11, 20, 22]  # the grid is kept
    assert plant.shown[11] == rows[10].r


@pytest.mark.parametrize(("y", "why"), [(None, "missing"), (math.nan, "not finite"), (1e3, "out of range")])
def test_what_is_no_output_passes_r_and_is_not_learned_from(y, why):
    live = tiny(10**6)
    loop, rows = ran(live, 80, Lag(given={40: y}), learn=True, record=200)
    assert [row.step for row in rows if row.why == why] == [40]
    assert loop.counts[why] == 1
    assert rows[40].r_tilde == rows[40].r
    layout = live.replay
    ages = np.asarray(loop.state.replay.rows)[0, layout.mirror : layout.mirror + 77, FIELDS.index("age")]
    np.testing.assert_array_equal(ages, [*range(39), *range(38)])  # neither the step to it nor the one from it


def test_updates_do_not_run_into_the_deadline():
    clock = Clock(tick=DT / 50)
    loop, rows = ran(tiny(), 300, Lag(), clock, learn=True, record=100, most_updates=1000)
    assert loop.counts["late"] == 0
    assert loop.updates > 5 * 150
    assert np.diff([row.time for row in rows]) == pytest.approx(DT)


def test_an_update_that_does_not_fit_is_said_before_anything_begins():
    with pytest.raises(ValueError, match=r"the period is 0\.02 s; an update takes 0\.02 s here, and must fit into 90%"):
        ran(tiny(), 1, clock=Clock(tick=DT), learn=True)


def test_nothing_is_compiled_in_the_loop(caplog):
    live = tiny(50)
    clock, state, r = Clock(), live.fresh(jax.random.key(0)), staircase()
    loop = Loop(live, state, Lag(), lambda k: float(r[k]), Timing(DT, True, 150, 2), clock=clock)
    with jax.log_compiles(True):
        run(loop, 400, sleep=clock.sleep)
    assert loop.stage != "recording"
    assert loop.updates > 100
    assert not [record for record in caplog.records if "ompiling" in record.message]


def test_what_turns_out_worse_is_sent_back(learned):
    loop, _ = learned
    state = loop.state
    bad = jax.tree.map(lambda leaf: 5.0 * leaf + 1.0, state.agent.actor)
    again, rows = ran(loop.live, 300, state=state._replace(incumbent=bad, leads=jnp.ones((), bool)))
    assert [row.why for row in rows] == 201 * ["learned"] + 99 * ["lq"]
    assert again.sent_back == 1
    assert np.abs(rows[-1].r - rows[-1].y) < 2.0


def test_only_a_candidate_that_is_better_on_the_same_steps_takes_over(learned):
    loop, _ = learned
    inverse, zero = loop.live.identify(loop.state.replay)[0], loop.state.kept
    worse = inverse._replace(r=0.9 * inverse.r)
    late = jnp.asarray(10**6, jnp.int32)  # updates done, so that a candidate may act at once
    nudged = jax.tree.map(lambda leaf: leaf + 0.5, zero)
    for base, kept, candidate, accepted in (
        (inverse, nudged, zero, 1),
        (inverse, zero, nudged, 0),
        (worse, zero, zero, 0),
    ):
        state = jax.tree.map(jnp.copy, loop.state)  # which learning donates
        state = state._replace(base=base, kept=kept, candidate=candidate, leads=jnp.zeros((), bool), updates=late)
        again, rows = ran(loop.live, 202, state=state, learn=True, most_updates=1)
        assert (again.accepted, again.refused) == (accepted, 1 - accepted)
        assert rows[-1].why == ("learned" if accepted else "static")
        if accepted:
            chex.assert_trees_all_equal(again.state.incumbent, candidate)


def test_the_fallback_takes_back_by_the_mean_and_a_candidate_must_be_worse_nowhere():
    changed = np.asarray(5 * [0.0, 0.05])
    better = np.where(changed == 0.0, -0.1, 1.0) + np.linspace(0.0, 0.01, 10)
    of_kept, of_candidate = judged(better, np.zeros(10), better, changed)
    assert of_kept > SURE
    assert of_candidate == 0.0


def test_a_record_that_tells_nothing_leaves_r_as_it_is():
    loop, rows = ran(tiny(), 250, learn=True, record=100, r=np.array([4.0]))
    assert {row.why for row in rows} == {"recording"}
    assert loop.trouble == "r~ has not moved"


def test_a_trained_policy_acts_as_it_is():
    trainer, params = build(small("heaters"))
    trained = trainer.fresh(jax.random.key(3), params)
    live = Live.of(trainer.config, trainer.env, 100, "trained")
    state = live.trained(jax.random.key(0), trained, trained.agent.actor)
    r = np.linspace(*trainer.env.plant.setpoint_range, 40)
    clock, rows = Clock(), []
    settings = Timing(DT, transfer_steps=1)
    loop = Loop(live, state, Lag(given=dict(enumerate(r + 1.0))), lambda k: float(r[k]), settings, clock=clock)
    run(loop, 40, report=rows.append, sleep=clock.sleep)
    policy, known = trainer.policy, trainer.policy_params(trained)
    carry, act = policy.init(known, *jnp.asarray([r[0], r[0] + 1.0], float)), jax.jit(policy.act)
    for row in rows:
        carry, r_tilde = act(known, carry, *jnp.asarray([row.r, row.y], float))
        assert row.r_tilde == pytest.approx(float(r_tilde), abs=1e-4)
    assert {row.why for row in rows} == {"trained"}
    assert loop.updates == 0


@pytest.mark.parametrize(
    ("plant", "text"),
    [
        (lambda r_tilde: "high", "it returned 'high'; it must return a number, or None"),
        (lambda r_tilde: 1 / 0, "it failed: ZeroDivisionError"),
    ],
)
def test_a_function_that_fails_is_said(plant, text):
    with pytest.raises(StepError, match=text):
        ran(tiny(), 3, plant)


def test_it_stops_while_it_waits():
    live, began = tiny(), time.monotonic()
    settings = Timing(3600.0)
    loop = Loop(live, live.fresh(jax.random.key(0)), Lag(), lambda k: 4.0, settings)
    run(loop, None, stop=lambda: loop.steps == 1)
    assert loop.steps == 1
    assert time.monotonic() - began < 60


def test_the_example_is_what_it_says():
    plant = load("scripts/examples", "loop")
    y = [plant.step(5.0) for _ in range(400)]
    assert np.mean(y[-100:]) == pytest.approx(1.0 + 0.7 * 5.0, abs=0.01)
