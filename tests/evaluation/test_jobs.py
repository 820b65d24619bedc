import multiprocessing
import os
import signal
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from types import ModuleType
from typing import Any

import jax
import msgspec
import numpy as np
import pytest

from jaxouter.evaluation import cache, jobs, scenarios, sweeps
from jaxouter.evaluation.baselines import BASELINES, identified
from jaxouter.evaluation.baselines.clairvoyant import plan
from jaxouter.evaluation.cache import Tuned
from jaxouter.evaluation.jobs import WITHIN, Done, Entrant, Job
from jaxouter.evaluation.metrics import FiguresOfMerit, figures_of_merit
from jaxouter.evaluation.results import GridErrors, Row, StabilityRow
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.scenarios import Known
from jaxouter.evaluation.stability import analyse
from jaxouter.identification import steady_state
from jaxouter.loop.policy import none
from jaxouter.plants import REGISTRY
from jaxouter.training.run import RunFolder, write_json
from tests import interrupts, lag
from tests.precision import makes_nan
from tests.training.small import small

LEARNED = [Entrant("learned", "learned", "runs/a", seed) for seed in (1, 0)]
OTHER_RUN = Entrant("learned", "learned", "runs/b", 5)
USER = Entrant("own.py:Twice", "user", "own.py", None, "Twice")
NONE, STATIC = Entrant("none", "baseline"), Entrant("static", "baseline")
ORACLE, CLAIRVOYANT = Entrant("oracle", "limit"), Entrant("clairvoyant", "preview")

OWN = '''
"""Policies of a user."""
import time
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp


@dataclass(frozen=True)
class Jax:
    """2 r plus what params say, traced."""

    bounds: tuple
    host: bool = False
    params = (0.25,)

    def __init__(self, plant):
        object.__setattr__(self, "bounds", plant.r_tilde_bounds)

    def init(self, params, r0, y0):
        return ()

    def act(self, params, carry, r, y, key=None):
        return carry, jnp.clip(2.0 * r + params[0], *self.bounds)


class Host:
    """The same in plain Python, without params."""

    host = True

    def __init__(self, plant):
        self.bounds = plant.r_tilde_bounds

    def init(self, params, r0, y0):
        assert params == ()
        return 0

    def act(self, params, carry, r, y, key=None):
        low, high = self.bounds
        return carry + 1, min(max(2.0 * r + 0.25, low), high)


class GivesUp(Host):
    """Its arithmetic fails where r~ is asked for."""

    def act(self, params, carry, r, y, key=None):
        return carry, 1 / 0


class Broken(Host):
    def act(self, params, carry, r, y, key=None):
        raise RuntimeError("out of ideas")


class Late(Broken):
    """Fails when it is told to."""

    def act(self, *seen):
        while not Path(__file__).with_name("fail").exists():
            time.sleep(0.02)
        super().act(*seen)


class NoPlant:
    host = True


class NoHost:
    def __init__(self, plant):
        pass
'''


def register_lag() -> None:
    """In this process or in one of a pool."""
    REGISTRY["lag"] = lag.make


@pytest.fixture(autouse=True)
def own_world(tmp_path, monkeypatch):
    """A cache of its own, and the lag as a third plant, which is cheap."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    jobs.load.cache_clear()


@pytest.fixture
def own(tmp_path):
    """Entrants of a user's file, by class."""
    path = tmp_path / "own.py"
    path.write_text(OWN)
    return lambda name: Entrant(f"own.py:{name}", "user", str(path), None, name)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run on the lag of two seeds, that has only begun; the second counts as the median."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(REGISTRY, "lag", lag.make)
        run = RunFolder.create(small("lag", seeds=2), tmp_path_factory.mktemp("runs") / "run")
        trainer, params = run.trainer
        for seed in run.seeds:
            run.save(seed, 1, trainer.start(seed, params))
        write_json(run.path / "summary.json", {"median_seed": 1})
        return run


def evaluated(entrant: Entrant, on: str, mae: float | None, outside: float | None = 0.0, stable: bool = True) -> Done:
    figures = {"mae": mae, "improvement": None, "violation_time": outside, "return": -1.0}
    diverged = {"diverged": True} if mae is None else {}
    arrays = {"mae": np.array([mae, mae], float)}
    settings = figures | diverged | {"stable_alone": stable}
    return Done(Job("evaluate", entrant, "pitch", on), Tuned(settings, arrays, 0), 0.5)


def by_policy(done: list[Done]) -> dict[str, Row]:
    return {row.policy: row for row in jobs.rows(done)}


def after(*arguments):
    """Jobs that follow identification."""
    return [job for job in jobs.jobs(*arguments) if job.what != "identify"]


def test_rows_have_ratios_to_limit_and_bound_and_the_improvement_over_the_inner_loop():
    entrants = {LEARNED[0]: 3.0, LEARNED[1]: 6.0, NONE: 8.0, ORACLE: 2.0, CLAIRVOYANT: 1.5}
    rows = jobs.rows([evaluated(c, "pitch/paper", mae) for c, mae in entrants.items()])
    assert [(row.policy, row.run, row.seed, row.mae) for row in rows] == [
        ("learned", "runs/a", 1, 3.0),
        ("learned", "runs/a", 0, 6.0),
        ("none", None, None, 8.0),
        ("oracle", None, None, 2.0),
        ("clairvoyant", None, None, 1.5),
    ]
    assert [row.ratio_to_limit for row in rows] == [1.5, 3.0, 4.0, 1.0, 0.75]
    assert [row.ratio_to_bound for row in rows] == [2.0, 4.0, 8.0 / 1.5, 2.0 / 1.5, 1.0]
    assert [row.improvement for row in rows] == [62.5, 25.0, 0.0, 75.0, 81.25]
    assert {row.scenario for row in rows} == {"pitch/paper"}
    assert all(row.episode_return == -1.0 for row in rows)


def test_rows_compare_within_a_scenario_only():
    done = [evaluated(c, on, mae) for on, mae in (("pitch/paper", 2.0), ("pitch/steps", 4.0)) for c in (NONE, ORACLE)]
    done += [evaluated(USER, "pitch/paper", 1.0), evaluated(USER, "pitch/steps", 1.0)]
    assert [row.ratio_to_limit for row in jobs.rows(done)] == [1.0, 1.0, 1.0, 1.0, 0.5, 0.25]


def test_no_ratio_without_what_it_relates_to():
    row = by_policy([evaluated(NONE, "pitch/paper", 8.0)])["none"]
    assert (row.ratio_to_limit, row.ratio_to_bound, row.improvement) == (None, None, 0.0)
    row = by_policy([evaluated(USER, "pitch/paper", 1.0)])[USER.name]
    assert (row.run, row.improvement) == (None, None)


def test_improvement_means_nothing_where_the_inner_loop_is_unstable_but_ratios_do():
    done = [
        evaluated(c, "pitch/delay-5.7", mae, stable=False) for c, mae in ((NONE, 27.0), (STATIC, 9.0), (ORACLE, 3.0))
    ]
    row = by_policy(done)["static"]
    assert (row.improvement, row.ratio_to_limit) == (None, 3.0)


def test_episodes_in_which_static_is_better_are_counted():
    done = [evaluated(c, "pitch/paper", mae) for c, mae in ((USER, 1.0), (STATIC, 2.0), (NONE, 3.0), (ORACLE, None))]
    done[0].found.arrays["mae"][1] = 2.5
    assert {name: row.worse_than_static for name, row in by_policy(done).items()} == {
        USER.name: 0.5, "static": 0.0, "none": 1.0, "oracle": 1.0
    }  # fmt: skip
    assert by_policy(done[2:3])["none"].worse_than_static is None


def test_rows_of_what_diverged():
    done = [evaluated(c, "pitch/paper", mae) for c, mae in ((NONE, None), (STATIC, 2.0), (ORACLE, None), (USER, None))]
    rows = by_policy(done)
    for name in ("none", "oracle", USER.name):
        row = rows[name]
        assert row.diverged is True
        assert row.within_limits is False
        assert (row.mae, row.ratio_to_limit, row.ratio_to_bound, row.improvement) == (None,) * 4
    assert not rows["static"].diverged
    assert (rows["static"].mae, rows["static"].ratio_to_limit, rows["static"].improvement) == (2.0, 1.0, None)


@pytest.mark.parametrize(
    ("figures", "limit"),
    [
        ({"oracle": (2.0, 0.0), "lq-exact": (1.5, 0.0), "static": (3.0, 0.0)}, 1.5),
        ({"oracle": (2.0, 0.0), "lq-exact": (1.5, 0.01), "static": (3.0, 0.0)}, 2.0),  # outside the limits
        ({"oracle": (2.0, 0.05), "lq-exact": (1.5, 0.01), "static": (3.0, 0.02)}, 1.5),  # all are; it is so least
        ({"oracle": (2.0, 0.02), "lq-exact": (2.5, 0.01), "static": (3.0, 0.0)}, 2.5),  # static is not all there is
        ({"oracle": (2.0, None), "none": (1.0, None), "learned": (0.5, None)}, 1.0),  # the inner loop knows as much
        ({"static": (3.0, 0.0), "learned": (0.5, 0.0)}, None),  # none that is made from the true plant
    ],
)
def test_limit_is_the_least_error_of_the_privileged_within_the_limits(figures, limit):
    found = {name: FiguresOfMerit(mae=mae, violation_time=outside) for name, (mae, outside) in figures.items()}
    assert jobs.limit(found) == limit


@pytest.mark.parametrize(
    ("outside", "within"), [(0.0, True), (WITHIN, True), (1.01 * WITHIN, False), (1.0, False), (None, True)]
)
def test_limits_are_kept_up_to_a_thousandth_of_the_steps_or_where_there_are_none(outside, within):
    assert by_policy([evaluated(NONE, "pitch/paper", 1.0, outside)])["none"].within_limits is within


ALL = (*LEARNED, OTHER_RUN, USER, NONE, STATIC, ORACLE, CLAIRVOYANT)


def test_every_entrant_is_evaluated_on_every_scenario():
    names = ["pitch/paper", "pitch/steps"]
    rest = after("pitch", ALL, names, [], 7)
    evaluated = [(job.entrant, job.on) for job in rest if job.what == "evaluate"]
    assert evaluated == [(c, on) for on in names for c in ALL]
    assert {job.family_seed for job in rest if job.what == "evaluate"} == {7}
    assert {job.plant for job in rest} == {"pitch"}


def test_only_baselines_and_the_limit_are_identified():
    first = [job for job in jobs.jobs("pitch", ALL, ["pitch/paper"], [], 7) if job.what == "identify"]
    assert {job.what for job in first} == {"identify"}
    assert [job.entrant for job in first] == [ORACLE, STATIC, NONE]  # the longest first


def test_the_limit_is_identified_on_each_plant_of_the_scenarios():
    all_of = jobs.jobs("pitch", ALL, ["pitch/paper", "pitch/delay-0.57", "pitch/noise"], ["pitch/gain"], 7)
    first = [(job.entrant, job.on) for job in all_of if job.what == "identify"]
    own, noisy = Known("pitch(d1=0.57, d2=0.57)"), Known("pitch", 0.2)
    assert first == [(ORACLE, ""), (ORACLE, "pitch/delay-0.57"), (ORACLE, "pitch/noise"), (STATIC, ""), (NONE, "")]
    needs = {(job.what, job.on): job.needs[1] for job in all_of if job.entrant == ORACLE}
    of_own = [needs.pop((what, "pitch/delay-0.57")) for what in ("identify", "evaluate", "stability")]
    assert of_own == [own, own, own]
    assert needs.pop(("identify", "pitch/noise")) == needs.pop(("evaluate", "pitch/noise")) == noisy
    assert set(needs.values()) == {Known("pitch")}
    assert {job.needs[1] for job in all_of if job.entrant != ORACLE} == {Known("pitch")}


def test_sweeps_take_the_first_seed_of_each_run_and_nothing_with_preview():
    rest = after("pitch", ALL, ["pitch/steps"], ["pitch/gain", "pitch/pilot-delay"], 7)
    acting = {LEARNED[0], OTHER_RUN, USER, NONE, STATIC, ORACLE}
    for name in ("pitch/gain", "pitch/pilot-delay"):
        swept = [job.entrant for job in rest if (job.what, job.on) == ("sweep", name)]
        assert len(swept) == len(acting)
        assert set(swept) == acting


def test_only_scenarios_that_were_asked_for_are_analysed():
    rest = after("pitch", ALL, ["pitch/steps", "pitch/uncertainty", "pitch/paper", "pitch/noise"], [], 7)
    analysed = [(job.on, job.entrant) for job in rest if job.what == "stability"]
    acting = {LEARNED[0], OTHER_RUN, USER, NONE, STATIC, ORACLE}
    assert len(analysed) == 2 * len(acting)
    assert set(analysed) == {(on, c) for on in ("pitch/paper", "pitch/uncertainty") for c in acting}
    rest = after("pitch", ALL, ["pitch/steps"], [], 7)
    assert {job.what for job in rest} == {"evaluate"}


def test_jobs_say_what_they_are():
    assert str(Job("evaluate", LEARNED[0], "pitch", "pitch/paper")) == "evaluate learned seed 1 pitch/paper"
    assert str(Job("identify", NONE, "pitch")) == "identify none"


def assert_same_trees(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_load_gives_a_baseline_as_it_was_identified():
    policy, params = jobs.load(STATIC, Known("lag"))
    expected = steady_state.static(*lag.make(), jax.random.key(0))
    assert policy == expected[0]
    assert_same_trees(params, expected[1])
    assert float(params.r) == pytest.approx(2.0, abs=1e-3)  # of the lag, 1 / K


def test_load_gives_the_seed_of_a_run(run):
    trainer, _ = run.trainer
    actors = []
    for seed in run.seeds:
        policy, params = jobs.load(Entrant("learned", "learned", str(run.path), seed), Known("lag"))
        assert policy == trainer.policy
        assert_same_trees(params, trainer.policy_params(run.load(seed)[0]))
        actors.append(jax.tree.leaves(params.actor))
    assert any((a != b).any() for a, b in zip(*actors, strict=True))


def test_users_policies_in_jax_and_in_plain_python_do_the_same(own):
    maes = [jobs.evaluate(own(name), "lag", "lag/steps", 2024).settings["mae"] for name in ("Jax", "Host")]
    assert maes[0] == pytest.approx(maes[1], rel=1e-5)
    assert jobs.load(own("Jax"), Known("lag"))[1] == (0.25,)
    assert jobs.load(own("Host"), Known("lag"))[1] == ()


def test_file_whose_annotations_are_strings_can_be_imported(tmp_path):
    """Dataclasses look for them in `sys.modules`."""
    path = tmp_path / "own.py"
    path.write_text("from __future__ import annotations\n" + OWN.strip())
    assert jobs.attribute(path, "Jax", jobs.OWN)(lag.LAG).bounds == (-4.0, 4.0)


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("absent.py", None, "absent.py is not a Python file; a policy of your own is named FILE.py:NAME"),
        ("own.txt", "x = 1", "own.txt is not a Python file; a policy of your own is named FILE.py:NAME"),
        ("own.py", "x = 1", "own.py has no 'Own'"),
        ("own.py", "class Own", "own.py can't be imported: SyntaxError: "),
        ("own.py", "1 / 0", "own.py can't be imported: ZeroDivisionError: division by zero"),
        ("own.py", "import no_such_thing", "own.py can't be imported: ModuleNotFoundError: "),
    ],
)
def test_file_without_the_class_is_named(tmp_path, name, content, text):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ValueError) as error:
        jobs.attribute(tmp_path / name, "Own", jobs.OWN)
    assert text in str(error.value)


def test_folder_is_no_file_of_a_policy(tmp_path):
    with pytest.raises(ValueError, match="is not a Python file"):
        jobs.attribute(tmp_path, "Own", jobs.OWN)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("Broken", "own.py:Broken failed on lag/steps: RuntimeError: out of ideas"),
        ("NoPlant", "own.py:NoPlant failed on lag/steps: ValueError: own.py:NoPlant can't be made: "),
        ("NoHost", "own.py:NoHost failed on lag/steps: AttributeError: 'NoHost' object has no attribute 'host'"),
    ],
)
def test_users_policy_that_fails_is_named(own, name, text):
    with pytest.raises(ValueError) as error:
        jobs.run(Job("evaluate", own(name), "lag", "lag/steps"))
    assert str(error.value).startswith(text)


@makes_nan
def test_users_policy_whose_arithmetic_fails_has_diverged(own):
    done = jobs.run(Job("evaluate", own("GivesUp"), "lag", "lag/steps"))
    assert done.found.settings["diverged"] is True
    assert by_policy([done])["own.py:GivesUp"].within_limits is False
    swept = jobs.run(Job("sweep", own("GivesUp"), "pitch", "pitch/gain"))
    assert swept.found.settings["mae"] == [None] * 5  # the coarse grid of policies on the host


def test_evaluate_is_the_evaluation_of_the_policy(run):
    scenario = scenarios.get("lag/ramps", family_seed=3)
    seed = Entrant("learned", "learned", str(run.path), 1)
    trainer, _ = run.trainer
    for entrant, policy in (
        (NONE, none(lag.LAG)),
        (seed, (trainer.policy, trainer.policy_params(run.load(1)[0]))),
    ):
        found, traces = jobs.evaluate(entrant, "lag", "lag/ramps", 3), rollout(*policy, scenario)
        assert found.settings == msgspec.to_builtins(figures_of_merit(traces, scenario)) | {"stable_alone": True}
        assert found.arrays.keys() == {"y0", "r", "y", "r_tilde", "mae"}
        assert found.arrays["mae"].mean() == pytest.approx(found.settings["mae"], rel=1e-5)
        for name in jobs.TRACES:
            np.testing.assert_array_equal(found.arrays[name], getattr(traces, name)[:1])
    assert jobs.evaluate(NONE, "lag", "lag/ramps", 4).settings["mae"] != found.settings["mae"]


def test_clairvoyant_is_evaluated_by_its_plan(monkeypatch):
    monkeypatch.setitem(REGISTRY, "lag", lambda: (replace(lag.LAG, episode_steps=20), lag.make()[1]))
    found = jobs.evaluate(CLAIRVOYANT, "lag", "lag/steps", 2024)
    planned = plan(scenarios.get("lag/steps"))
    assert found.settings["mae"] == pytest.approx(planned.mae.mean(), rel=1e-4)
    np.testing.assert_allclose(found.arrays["r_tilde"], planned.r_tilde[:1])
    assert found.settings["mae"] < jobs.evaluate(STATIC, "lag", "lag/steps", 2024).settings["mae"]


def test_sweep_is_the_error_over_the_grid():
    found = jobs.sweep(NONE, "pitch", "pitch/gain", 2024).settings
    swept = sweeps.get("pitch/gain")
    assert found["values"] == [list(swept.axes[0].values)]
    assert found["mae"] == swept.mae(rollout(*none(swept.scenario.plant), swept.scenario)).tolist()


def test_stability_goes_over_the_range_of_evaluation(own):
    rows = jobs.analyse(STATIC, "lag", "lag/steps", 2024).settings["rows"]
    assert [row["set_point"] for row in rows] == pytest.approx(np.linspace(-1.0, 1.0, 19).tolist())
    expected = analyse(*jobs.load(STATIC, Known("lag")), *lag.make(), [1.0])[0]
    assert rows[-1] == pytest.approx(msgspec.to_builtins(expected))
    assert rows[-1]["spectral_radius"] == pytest.approx(np.exp(-lag.CONTROL_STEP / 0.3), rel=1e-6)
    assert rows[-1]["y"] == pytest.approx(1.0, abs=1e-3)
    notes = {row["note"] for row in jobs.analyse(own("Host"), "lag", "lag/steps", 2024).settings["rows"]}
    assert notes == {"policy is not a JAX function"}


def cached_files() -> list[str]:
    return sorted(path.name.rsplit("-", 1)[0] for path in (cache.folder() / "baselines").glob("*.npz"))


def test_what_concerns_baselines_alone_is_kept_and_the_rest_is_not(run, own):
    learned = Entrant("learned", "learned", str(run.path), 0)
    for entrant in (own("Jax"), learned):
        jobs.run(Job("evaluate", entrant, "lag", "lag/steps"))
    assert cached_files() == []
    for job in (
        Job("identify", STATIC, "lag"),
        Job("evaluate", STATIC, "lag", "lag/steps"),
        Job("evaluate", STATIC, "lag", "lag/steps", 7),
        Job("stability", STATIC, "lag", "lag/steps"),
    ):
        done, again = jobs.run(job), jobs.run(job)
        assert again.found.settings == done.found.settings
        jax.tree.map(np.testing.assert_array_equal, again.found.arrays, done.found.arrays)
    assert cached_files() == ["lag-static", "lag-static-evaluate", "lag-static-evaluate", "lag-static-stability"]


def test_identified_knows_its_baselines():
    with pytest.raises(
        ValueError, match="no policy 'clairvoyant'; the policies are: none, static, lq, lq-return, pi, mpc"
    ):
        identified("clairvoyant", Known("lag"))
    with pytest.raises(ValueError, match="no plant 'boat'"):
        identified("static", Known("boat"))
    assert identified("none", Known("lag")).steps == 0
    assert identified("static", Known("lag")).steps == steady_state.LEVELS * lag.LAG.episode_steps
    for name, baseline in BASELINES.items():
        assert baseline.kind == ("limit" if name in ("oracle", "lq-exact", "mpc-exact") else "baseline")


def test_processes_do_what_one_does_and_hand_on_what_fails(monkeypatch, tmp_path, own):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    work = [Job("evaluate", c, "lag", "lag/steps") for c in (own("Late"), NONE, own("Host"))]
    work += [Job("identify", STATIC, "lag"), Job("stability", NONE, "lag", "lag/steps")]
    said = []
    doing = jobs.spread(work, register_lag, lambda job, text, share: said.append((job, share)))
    spread = {done.job: done for done in (next(doing) for _ in work[1:])}
    (tmp_path / "fail").touch()
    with pytest.raises(ValueError, match=r"own\.py:Late failed on lag/steps: RuntimeError: out of ideas"):
        next(doing)
    assert {(job, 0.0) for job in work} <= set(said)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another"))
    for job in work[1:]:
        alone = jobs.run(job)
        assert spread[job].job == alone.job
        assert spread[job].found.settings == alone.found.settings
        assert spread[job].found.steps == alone.found.steps
        assert_same_trees(spread[job].found.arrays, alone.found.arrays)
        assert spread[job].seconds > 0


@pytest.mark.parametrize("in_thread", [False, True])
def test_processes_do_not_run_the_script_again_that_starts_them_and_are_deaf_to_ctrl_c(
    tmp_path, monkeypatch, in_thread
):
    script = ModuleType("__main__")
    script.__file__ = str(tmp_path / "unguarded.py")
    (tmp_path / "unguarded.py").write_text("1 / 0")
    monkeypatch.setitem(sys.modules, "__main__", script)
    before = signal.getsignal(signal.SIGINT)

    def started() -> Any:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            with jobs._starting():
                future = pool.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ())
            return future.result(100)

    if in_thread:
        with ThreadPoolExecutor(1) as threads:
            threads.submit(started).result()
    else:
        assert signal.SIGINT in started()
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert sys.modules["__main__"] is script
    assert signal.getsignal(signal.SIGINT) == before


def test_ctrl_c_while_processes_are_started_is_heard():
    def started():
        with jobs._starting():
            os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1_000):  # a thread that does not block it may take it, and some time over that
            time.sleep(0.01)

    with interrupts.heard(), pytest.raises(KeyboardInterrupt):
        started()


def test_one_job_needs_no_other_process(own):
    said = []
    job = Job("evaluate", own("Jax"), "lag", "lag/steps")
    (done,) = jobs.spread([job], no_process, lambda *told: said.append(told))
    assert done.found.settings["mae"] > 0
    assert said == [(job, "", 0.0)]


def no_process() -> None:
    raise AssertionError("a process was started")


def test_policies_say_what_they_are_and_what_they_took(run):
    entrants = [Entrant("learned", "learned", str(run.path), seed) for seed in (1, 0)]
    entrants += [USER, NONE, STATIC, CLAIRVOYANT]
    tuned = [
        Done(Job("identify", c, "lag"), identified(c.name, Known("lag"))._replace(seconds=2.5), 0.0)
        for c in (STATIC, NONE)
    ]
    known = jobs.policies(entrants, tuned)
    assert list(known) == ["learned", USER.name, "none", "static", "clairvoyant"]
    assert {name: each.kind for name, each in known.items()} == {c.name: c.kind for c in entrants}
    assert known["learned"].steps == run.config.steps
    assert known["learned"].settings == {run.path.name: "record"}
    assert known[USER.name].note == "Twice of own.py"
    assert (known["static"].steps, known["static"].seconds) == (400, 2.5)
    assert known["static"].settings == identified("static", Known("lag")).settings
    for name in ("none", "static"):
        assert known[name].note == BASELINES[name].note
    assert all(each.note for each in known.values())


def traced(entrant: Entrant, on: str, level: float) -> Done:
    arrays = {"y0": np.zeros(1), "r": np.ones((1, 3)), "y": np.full((1, 3), level), "r_tilde": np.ones((1, 3))}
    return Done(Job("evaluate", entrant, "pitch", on), Tuned({}, arrays, 0), 0.1)


def test_first_episodes_are_of_the_first_seed_of_each_run():
    done = [traced(c, on, level) for on in ("a", "b") for level, c in enumerate((*LEARNED, OTHER_RUN, NONE))]
    found = jobs.first_episodes(done, "b")
    assert {c: float(traces.y[0, 0]) for c, traces in found.items()} == {LEARNED[0]: 0.0, OTHER_RUN: 2.0, NONE: 3.0}


def test_sweeps_and_stabilities_by_label():
    swept = {"values": [[0.5, 1.0, 1.5]], "mae": [1.0, None, 2.0]}
    done = [Done(Job("sweep", c, "pitch", "pitch/gain"), Tuned(swept, {}, 0), 0.1) for c in (STATIC, NONE)]
    rows = [{"set_point": r, "y": r, "r_tilde": r, "spectral_radius": 0.9, "note": ""} for r in (0.0, 1.0)]
    done += [Done(Job("stability", NONE, "pitch", "pitch/paper"), Tuned({"rows": rows}, {}, 0), 0.1)]
    label = {c.line: c.name for c in (NONE, STATIC)}
    (gain,) = jobs.swept(done, ["pitch/gain"], label).values()
    assert gain.policies == {"none": GridErrors(**swept), "static": GridErrors(**swept)}
    assert gain.axes == sweeps.get("pitch/gain").axes
    assert jobs.stabilities(done, label) == [
        StabilityRow(r, r, r, 0.9, "", policy="none", scenario="pitch/paper") for r in (0.0, 1.0)
    ]


def test_two_runs_keep_their_own_sweeps_and_stabilities():
    runs = {LEARNED[0]: 1.0, OTHER_RUN: 2.0}
    rows = [{"set_point": 0.0, "y": 0.0, "r_tilde": 0.0, "spectral_radius": 0.9, "note": ""}]
    done = [
        Done(Job("sweep", c, "pitch", "pitch/gain"), Tuned({"values": [[1.0]], "mae": [mae]}, {}, 0), 0.1)
        for c, mae in runs.items()
    ] + [Done(Job("stability", c, "pitch", "pitch/paper"), Tuned({"rows": rows}, {}, 0), 0.1) for c in runs]
    label = {c.line: f"learned {c.path[-1]}" for c in runs}
    swept = jobs.swept(done, ["pitch/gain"], label)["pitch/gain"].policies
    assert {name: each.mae for name, each in swept.items()} == {"learned a": [1.0], "learned b": [2.0]}
    assert [row.policy for row in jobs.stabilities(done, label)] == ["learned a", "learned b"]
