"""The comparison: every policy on every scenario, every sweep and every stability analysis, spread over the cores.

Work is cut into jobs, plain picklable values, that `run` executes in this or another process. What depends on nothing
but code and configuration, all that concerns the built-in baselines, is kept in the cache.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache, partial
from multiprocessing import resource_tracker
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import jax
import msgspec
import numpy as np
from msgspec.structs import asdict

from jaxouter import terminal
from jaxouter.evaluation import cache, scenarios, stability, sweeps
from jaxouter.evaluation.baselines import CLAIRVOYANT, LIMITS, NAMES, OWN, SIMPLE, Baseline, Kind, identified, resolve
from jaxouter.evaluation.baselines.clairvoyant import Replay, plan
from jaxouter.evaluation.baselines.tuning import Report
from jaxouter.evaluation.cache import Tuned
from jaxouter.evaluation.metrics import FiguresOfMerit, figures_of_merit
from jaxouter.evaluation.results import GridErrors, PolicyInfo, Row, StabilityRow, SweepErrors
from jaxouter.evaluation.rollout import Traces, rollout
from jaxouter.evaluation.scenarios import Known
from jaxouter.loop.policy import Policy
from jaxouter.plants import Plant, make
from jaxouter.plants.errors import PlantError
from jaxouter.plants.registry import REGISTRATIONS, Registration, add, attribute, own_errors
from jaxouter.training.run import RunFolder, add_agent

TUNED = ("baseline", "limit")  # kinds of policies that are identified first
WITHIN = 1e-3  # share of the steps that may lie outside the limits
SET_POINTS = 19  # of the stability analysis, over the range of evaluation
LEARNED_NOTE = "The learned outer loop, without exploration."
TRACES = ("y0", "r", "y", "r_tilde")  # that are kept
Labels = Mapping[tuple[str, str | None], str]  # of the lines, by policy and run
IDENTIFY = {
    "oracle": 300.0,
    "mpc-exact": 60.0,
    "inverse": 30.0,
    "mpc": 60.0,
    "deepc": 90.0,
    "pi": 15.0,
    "lq": 5.0,
}  # about seconds that it takes
NEEDS = {**dict.fromkeys(LIMITS, "differentiable"), CLAIRVOYANT: "affine"}  # what the plant must be declared
PREVIEW_NOTE = "Least MAE of any r~, with preview: knows plant, state, noise and the whole reference."


class Entrant(NamedTuple):
    """A policy of the comparison and where it comes from."""

    name: str
    kind: Kind
    path: str | None = None  # run folder, or the user's file
    seed: int | None = None  # of a run
    attribute: str = ""  # class in the user's file

    @property
    def line(self) -> tuple[str, str | None]:
        """Policy and run, the same for all seeds."""
        return self.name, self.path if self.kind == "learned" else None


class Job(NamedTuple):
    """One piece of work."""

    what: Literal["identify", "evaluate", "sweep", "stability"]
    entrant: Entrant
    plant: str
    on: str = ""  # scenario or sweep; of an identification the first scenario that it is for, "" the nominal plant
    family_seed: int = scenarios.FAMILY_SEED

    @property
    def work(self) -> float:
        """What it takes, in about seconds."""
        if self.what == "identify":
            return IDENTIFY.get(self.entrant.name, 1.0)
        return {"evaluate": 1.0, "sweep": 5.0, "stability": 3.0}[self.what]

    @property
    def needs(self) -> tuple[Entrant, Known]:
        """Policy, and the plant on which it is identified."""
        nominal = self.what == "sweep" or not self.on
        return self.entrant, Known(self.plant) if nominal else made_for(self.entrant, self.plant, self.on)

    def __str__(self) -> str:
        seed = "" if self.entrant.seed is None else f" seed {self.entrant.seed}"
        return f"{self.what} {self.entrant.name}{seed} {self.on}".strip()


class Done(NamedTuple):
    """A job, what it gave, and how long it took."""

    job: Job
    found: Tuned
    seconds: float


def entrant(name: str, plant: Plant) -> Entrant:
    """The policy that a command line names: a built-in one, or FILE.py:CLASS.

    Raises:
        ValueError: there is no such policy or file, or the plant does not allow it.
    """
    file, colon, attribute_name = name.rpartition(":")
    if colon and file.endswith(".py"):
        if isinstance(attribute(Path(file), attribute_name, OWN), Baseline):
            return Entrant(name, resolve(name).kind)
        return Entrant(short(name), "user", file, None, attribute_name)
    if name not in NAMES:
        raise ValueError(f"there is no policy {name!r}; it may be FILE.py:CLASS or one of: {', '.join(NAMES)}")
    if name not in possible(plant):
        raise ValueError(f"there is no {name} for {plant.name}, which is not declared {NEEDS[name]}")
    return Entrant(name, "preview" if name == CLAIRVOYANT else resolve(name).kind)


def made_for(entrant: Entrant, plant: str, on: str) -> Known:
    """The plant for which a policy is made that acts in a scenario: a limit knows the scenario's own."""
    return scenarios.known(on) if entrant.kind == "limit" else Known(plant)


def short(name: str) -> str:
    """A policy's name in results: of FILE.py:CLASS without the folder."""
    return Path(name).name if is_own(name) else name


def is_own(name: str | None) -> bool:
    """Whether a command line names what a file of the user's holds."""
    return name is not None and ".py:" in name


def possible(plant: Plant) -> list[str]:
    """The built-in policies that the plant allows."""
    return [name for name in NAMES if name not in NEEDS or getattr(plant, NEEDS[name])]


@contextmanager
def blamed(name: str, what: str, own: bool = True) -> Iterator[None]:
    """Turns whatever a user's own policy raises in here into a ValueError that names it."""
    try:
        yield
    except PlantError:
        raise
    except Exception as error:
        if not own:
            raise
        raise ValueError(f"{name} {what}: {type(error).__name__}: {error}") from error


@lru_cache(maxsize=64)
def load(entrant: Entrant, of: Known) -> tuple[Policy, Any]:
    """The policy and its parameters.

    Raises:
        ValueError: a run has no checkpoint, or a user's policy can't be made.
    """
    plant, _ = make(of.plant)
    if entrant.kind == "learned":
        return RunFolder.open(Path(entrant.path or "")).policy(entrant.seed or 0)
    if entrant.kind == "user":
        with blamed(entrant.name, "can't be made"):
            policy = attribute(Path(entrant.path or ""), entrant.attribute, OWN)(plant)
        return policy, getattr(policy, "params", ())
    return resolve(entrant.name).build(plant, identified(entrant.name, of))


def evaluate(entrant: Entrant, plant_name: str, on: str, family_seed: int) -> Tuned:
    """Figures of merit on a scenario, the traces of its first episode, and the MAE of each (episodes,)."""
    scenario = scenarios.get(on, family_seed=family_seed)
    if entrant.kind == "preview":
        best = plan(scenario)
        traces = rollout(Replay(), best.r_tilde, scenario, per_episode=True)
    else:
        traces = rollout(*load(entrant, made_for(entrant, plant_name, on)), scenario)
    arrays = {name: getattr(traces, name)[:1] for name in TRACES}
    arrays["mae"] = np.mean(np.abs(traces.r - traces.y), axis=1)
    figures = msgspec.to_builtins(figures_of_merit(traces, scenario))
    return Tuned(figures | {"stable_alone": scenario.stable_alone}, arrays, 0)


def sweep(entrant: Entrant, plant_name: str, on: str, family_seed: int) -> Tuned:
    """MAE over the grid of a sweep, a coarser one for policies that run on the host."""
    del family_seed
    policy, params = load(entrant, Known(plant_name))
    swept = sweeps.get(on, coarse=policy.host)
    found = swept.mae(rollout(policy, params, swept.scenario))
    mae = np.where(np.isfinite(found), found.astype(object), np.array(None)).tolist()
    return Tuned({"values": [list(axis.values) for axis in swept.axes], "mae": mae}, {}, 0)


def analyse(entrant: Entrant, plant_name: str, on: str, family_seed: int) -> Tuned:
    """Local stability at set-points over the range of evaluation, on the plant of a scenario."""
    scenario = scenarios.get(on, 1, family_seed)
    params = jax.tree.map(lambda leaf: leaf[0], scenario.params)
    points = np.linspace(*scenario.plant.evaluation_range, SET_POINTS)
    acting = load(entrant, made_for(entrant, plant_name, on))
    rows = stability.analyse(*acting, scenario.plant, params, points.tolist())
    return Tuned({"rows": msgspec.to_builtins(rows)}, {}, 0)


def run(job: Job, report: Report = lambda text, share: None) -> Done:
    """Do one job.

    Raises:
        ValueError: it can't be done, or a user's policy or plant failed at it.
    """
    with own_errors():
        return _run(job, report)


def _run(job: Job, report: Report) -> Done:
    begin, c = time.perf_counter(), job.entrant
    report("", 0.0)
    if job.what == "identify":
        return Done(job, identified(c.name, job.needs[1], report), time.perf_counter() - begin)
    work = {"evaluate": evaluate, "sweep": sweep, "stability": analyse}[job.what]
    if c.kind == "learned":
        found = work(c, job.plant, job.on, job.family_seed)
    elif is_own(c.name):
        with blamed(c.name, f"failed on {job.on}"), own_errors():
            found = work(c, job.plant, job.on, job.family_seed)
    else:
        key = {"on": job.on, "family_seed": job.family_seed}
        make_it = partial(work, c, job.plant, job.on, job.family_seed)
        found = cache.cached(f"{job.plant}-{c.name}-{job.what}", key, make_it)
    return Done(job, found, time.perf_counter() - begin)


def jobs(
    plant: str, entrants: Sequence[Entrant], selected: Sequence[str], swept: Sequence[str], family_seed: int
) -> list[Job]:
    """All jobs: identification first, of it the long ones."""
    work: list[Job] = []
    for c in reversed([c for c in entrants if c.kind in TUNED]):
        first = {Known(plant): ""}
        for on in selected:
            first.setdefault(made_for(c, plant, on), on)
        work += [Job("identify", c, plant, on) for on in first.values()]
    acting = [c for c in entrants if c.kind != "preview"]
    first_seeds = {c.line: c for c in reversed(acting)}  # of each run, for sweeps and stabilities
    one_seed = [c for c in acting if first_seeds[c.line] == c]
    work += [Job("evaluate", c, plant, on, family_seed) for on in selected for c in entrants]
    work += [Job("sweep", c, plant, on) for on in swept for c in one_seed]
    work += [
        Job("stability", c, plant, on, family_seed)
        for on in scenarios.for_stability(plant)
        if on in selected and make(plant)[0].differentiable
        for c in one_seed
    ]
    return work


class _Worker:
    """What a process of the pool knows: where to say how far it is."""

    messages: Any = None

    @classmethod
    def begin(cls, messages: Any, initialise: Callable[[], None]) -> None:
        cls.messages = messages
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent alone
        threading.Thread(target=cls.end_with_parent, daemon=True).start()
        initialise()

    @staticmethod
    def end_with_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)  # however the command ended, its workers don't outlive it

    @classmethod
    def run(cls, job: Job) -> Done:
        return run(job, lambda text, share: cls.messages.put((job, text, share)))


@contextmanager
def _starting() -> Iterator[None]:
    """Processes that start in here are deaf to Ctrl-C from the first, and don't run the script of this one again.

    That script, or notebook, holds nothing that they need, and they need not be guarded against. Where signals can be
    blocked, a Ctrl-C that comes meanwhile is heard afterwards.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    in_main_thread = threading.current_thread() is threading.main_thread()  # the one that may set a handler
    can_block = in_main_thread and hasattr(signal, "pthread_sigmask")
    handler = before = None
    if can_block:
        resource_tracker.ensure_running()  # whose start would unblock it
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    elif in_main_thread:
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, before or set())
        elif in_main_thread:
            signal.signal(signal.SIGINT, handler)


def spread(
    work: Sequence[Job], initialise: Callable[[], None], report: Callable[[Job, str, float], None]
) -> Iterator[Done]:
    """The jobs as they get done: on a CPU in a process a core, on an accelerator one after the other.

    Args:
        work: jobs; those of a policy begin when its identification, where that is among them, is done.
        initialise: called first in each process; picklable.
        report: told now and then how far each is: what was done, and which share of it that is.
    """
    cores = os.cpu_count() or 1
    alone = cores == 1 or len(work) == 1 or multiprocessing.current_process().daemon  # which may have no children
    alone |= any(each.session for each in REGISTRATIONS.values())
    if jax.default_backend() != "cpu" or alone:
        for job in work:
            yield run(job, partial(report, job))
        return
    context = multiprocessing.get_context("spawn")  # JAX has threads, which a fork would not survive
    messages = context.SimpleQueue()
    with ProcessPoolExecutor(min(cores, len(work)), context, _Worker.begin, (messages, initialise)) as pool:
        identifying = {job.needs for job in work if job.what == "identify"}
        free = [job for job in work if job.what == "identify" or job.needs not in identifying]
        try:
            with _starting():
                waiting = {pool.submit(_Worker.run, job) for job in free}
            while waiting:
                done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
                while not messages.empty():
                    report(*messages.get())
                for future in done:
                    finished = future.result()
                    if finished.job.what == "identify":
                        freed = (job for job in work if job.needs == finished.job.needs and job != finished.job)
                        with _starting():
                            waiting |= {pool.submit(_Worker.run, job) for job in freed}
                    yield finished
        except BrokenProcessPool:
            raise ValueError(
                "a process of the comparison ended at once: memory ran out, or a library crashed"
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def prepare(registered: Iterable[Registration], agents: Iterable[str]) -> None:
    """Set up a child process: the plants and agents that its parent has registered, and the compilation cache."""
    terminal.last()
    for plant in registered:
        add(plant.reference, plant.options)
    for agent in agents:
        add_agent(agent)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the parent has already warned about the cache
        cache.use_compilation_cache()
    warnings.showwarning = terminal.show


def policies(entrants: Sequence[Entrant], done: Sequence[Done]) -> dict[str, PolicyInfo]:
    """What each policy is, and what its identification and tuning took."""
    tuned = {d.job.entrant.name: d.found for d in done if d.job.what == "identify" and not d.job.on}
    paths = dict.fromkeys(Path(c.path or "") for c in entrants if c.kind == "learned")
    configs = {path.name: RunFolder.open(path).config for path in paths}

    def about(c: Entrant) -> PolicyInfo:
        if c.kind == "learned":
            steps = max(config.environment_steps for config in configs.values())
            settings = {name: config.preset for name, config in configs.items()}
            return PolicyInfo(c.kind, steps, settings=settings, note=LEARNED_NOTE)
        if c.kind in ("preview", "user"):
            return PolicyInfo(c.kind, note=PREVIEW_NOTE if c.kind == "preview" else f"{c.attribute} of {c.path}")
        found = tuned[c.name]
        return PolicyInfo(c.kind, found.steps, found.seconds, found.settings, resolve(c.name).note)

    return {c.name: about(c) for c in entrants}


def rows(done: Sequence[Done]) -> list[Row]:
    """A row for each policy, seed and scenario, with its ratios to the limit, the bound and the inner loop alone."""
    selected = [(d, msgspec.convert(d.found.settings, FiguresOfMerit)) for d in done if d.job.what == "evaluate"]
    static = {d.job.on: d.found.arrays["mae"] for d, _ in selected if d.job.entrant.name == "static"}
    by_scenario: dict[str, dict[str, FiguresOfMerit]] = {}
    for d, figures in selected:
        by_scenario.setdefault(d.job.on, {})[d.job.entrant.name] = figures
    reference = {(name, on): figures.mae for on, each in by_scenario.items() for name, figures in each.items()}

    limits = {on: limit(each) for on, each in by_scenario.items()}

    def over(mae: float | None, against: float | None) -> float | None:
        return None if mae is None or not against else mae / against

    found = []
    for d, figures in selected:
        c, on, mae, outside = d.job.entrant, d.job.on, figures.mae, figures.violation_time
        alone = over(mae, reference.get(("none", on))) if d.found.settings["stable_alone"] else None
        others: dict[str, Any] = asdict(figures)
        others["improvement"] = None if alone is None else 100.0 * (1.0 - alone)
        row = Row(
            policy=c.name,
            run=c.line[1],
            seed=c.seed,
            scenario=on,
            ratio_to_limit=over(mae, limits[on]),
            ratio_to_bound=over(mae, reference.get((CLAIRVOYANT, on))),
            within_limits=mae is not None and (outside or 0.0) <= WITHIN,
            worse_than_static=float(np.mean(~(d.found.arrays["mae"] <= static[on]))) if on in static else None,
            **others,
        )
        found.append(row)
    return found


def limit(figures: Mapping[str, FiguresOfMerit]) -> float | None:
    """The least MAE that a policy which knows the plant reaches in a scenario, while it keeps the plant's limits.

    Where none of `LIMITS` keeps these, those count that leave them about as seldom as the best, and `none` and `static`
    that do so no more often. A policy with a lower MAE that leaves them more often is no counter-example. None where
    there is none of `LIMITS`.
    """
    if not any(name in figures for name in LIMITS):
        return None
    known = {name: figures[name] for name in (*LIMITS, *SIMPLE) if name in figures and figures[name].mae is not None}
    outside = {name: each.violation_time or 0.0 for name, each in known.items()}
    allowed = min((outside[name] for name in LIMITS if name in known), default=1.0) + WITHIN
    return min((known[name].mae or 0.0 for name in known if outside[name] <= allowed), default=None)


def first_episodes(done: Sequence[Done], on: str) -> dict[Entrant, Traces]:
    """Traces of the first episode of a scenario under each policy; of a run its first seed."""
    nothing = dict(reward=None, each_outside=None, each_excess=None, members=None)
    found: dict[Any, tuple[Entrant, Traces]] = {}
    for d in done:
        if d.job.what == "evaluate" and d.job.on == on:
            c = d.job.entrant
            found.setdefault(c.line, (c, Traces(**{name: d.found.arrays[name] for name in TRACES}, **nothing)))
    return dict(found.values())


def swept(done: Sequence[Done], names: Sequence[str], label: Labels) -> dict[str, SweepErrors]:
    """The sweeps under every policy, by name."""
    found = {}
    for name in names:
        own = [d for d in done if d.job.what == "sweep" and d.job.on == name]
        errors = {label[d.job.entrant.line]: GridErrors(**d.found.settings) for d in own}
        found[name] = SweepErrors(sweeps.get(name).axes, errors)
    return found


def stabilities(done: Sequence[Done], label: Labels) -> list[StabilityRow]:
    """Local stability of every policy, scenario and set-point."""
    analysed = [d for d in done if d.job.what == "stability"]
    return [
        StabilityRow(policy=label[d.job.entrant.line], scenario=d.job.on, **row)
        for d in analysed
        for row in d.found.settings["rows"]
    ]
