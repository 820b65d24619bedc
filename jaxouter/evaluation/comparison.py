"""Every policy beside its baselines and beside the limit, on every scenario: results, statistics, figures, report."""

from __future__ import annotations

import csv
import datetime
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from jaxouter import plants
from jaxouter.evaluation import cache, comparison_figures, jobs, pace, report, scenarios, statistics, sweeps
from jaxouter.evaluation.baselines import BUDGET, SIMPLE
from jaxouter.evaluation.jobs import Done, Entrant, Job
from jaxouter.evaluation.metrics import FiguresOfMerit
from jaxouter.evaluation.policies import check, several
from jaxouter.evaluation.results import Comparison
from jaxouter.evaluation.scenarios import Known
from jaxouter.plants import Plant, host
from jaxouter.plants.registry import REGISTRATIONS, Maker, own_errors
from jaxouter.progress import Progress, showing
from jaxouter.terminal import optional
from jaxouter.training.run import RUNS, add_agent, add_plant, open_run, own_agents, surroundings, write_json

COLUMNS = ("policy", "run", "seed", "scenario", "mae", "ratio_to_limit", "ratio_to_bound", "within_limits")
COLUMNS += ("worse_than_static", *FiguresOfMerit.__struct_encode_fields__[:-1])  # `diverged` only where it is
OVERALL = 3  # figures of all scenarios: errors, effort, stability
REPORT = "report.html"


@dataclass(frozen=True)
class Selection:
    """What is compared, on what."""

    plant: str
    entrants: tuple[Entrant, ...]
    scenarios: tuple[str, ...]
    sweeps: tuple[str, ...]
    family_seed: int
    out: Path


def compare(
    plant: str | Maker | None = None,
    runs: Path | str | Sequence[Path | str] = (),
    policies: str | Sequence[str] = (),
    scenario: str | Sequence[str] = (),
    sweep: str | Sequence[str] | None = None,
    *,
    set: Mapping[str, Any] | None = None,
    agents: str | Sequence[str] = (),
    family_seed: int = scenarios.FAMILY_SEED,
    out: Path | str | None = None,
    progress: bool | Progress = True,
    command: str = "jaxouter.evaluation.compare",
) -> Comparison:
    """Compare policies with their baselines, with the limit and with a lower bound, and write a report.

    Args:
        plant: as a command names it; None: that of the runs, or pitch.
        runs: one or several run folders (all seeds), or folders of one seed.
        policies: baselines and limits, or `FILE.py:CLASS`; empty: all. `none` always takes part.
        scenario: ids, such as `pitch/paper` or `paper`; empty: all of the plant.
        sweep: ids, such as `pitch/gain` or `gain`; None: all of the plant; empty: none.
        set: parameters of the plant; scenarios that set one themselves keep theirs.
        agents: agents of the runs, if your own.
        family_seed: of the families of references.
        out: new folder for the report, its figures and data; None: runs/compare-PLANT.
        progress: whether to show progress.
        command: what the report says that made it.

    Returns:
        All results, as in comparison.json; `folder` holds the report.

    Raises:
        ValueError: something named does not exist, does not fit together, or failed.
    """
    begun = time.perf_counter()
    with own_errors(), showing(progress) as progress:
        selection = select(plant, runs, policies, scenario, sweep, set, agents, family_seed, out)
        cache.use_compilation_cache()
        try:
            selection.out.mkdir(parents=True)
        except OSError as error:
            raise ValueError(f"the folder {selection.out} can't be made: {error.strerror}") from None
        try:
            done = work(selection, progress)
        except BaseException:
            selection.out.rmdir()  # still empty, and its name is wanted again
            raise
        progress.phase("statistics", 0)
        content = assemble(selection, done, command, begun)
        write(selection, content, done, progress)
    return content


def select(
    plant: str | Maker | None = None,
    runs: Path | str | Sequence[Path | str] = (),
    policies: str | Sequence[str] = (),
    scenario: str | Sequence[str] = (),
    sweep: str | Sequence[str] | None = None,
    set: Mapping[str, Any] | None = None,
    agents: str | Sequence[str] = (),
    family_seed: int = scenarios.FAMILY_SEED,
    out: Path | str | None = None,
) -> Selection:
    """Resolve everything that is named, before any work; arguments as for `compare`.

    Raises:
        ValueError: the arguments do not fit together, or name what does not exist.
    """
    check(None, family_seed)
    for reference in several(agents):
        add_agent(reference)
    paths = [Path(path) for path in several(runs)]
    named_plant = None if plant is None else add_plant(plant, *paths[:1] or (None,))
    opened = [open_run(path) for path in paths]
    of_run = opened[0][0].config.plant if opened else "pitch"
    name = of_run if named_plant in (None, plants.base(of_run)) else named_plant
    name = plants.with_parameters(name, set or {})
    for path, (run, _, _) in zip(paths, opened, strict=True):
        if plants.base(run.config.plant) != plants.base(name):
            raise ValueError(f"{path} is a run on {run.config.plant}; the comparison is on {name}")
    chosen = scenarios.identifiers(name, several(scenario))
    swept = list(sweeps.catalogue(name)) if sweep is None else sweeps.identifiers(name, several(sweep))
    entrants = [
        Entrant("learned", "learned", str(run.path), seed)
        for run, median, of_run in opened
        for seed in (of_run if len(of_run) == 1 else sorted(of_run, key=lambda seed: seed != median))
    ]
    entrants = list(dict.fromkeys([*entrants, *named(several(policies), plants.make(name)[0])]))
    for entrant in entrants:
        if entrant.kind in ("learned", "user"):
            jobs.load(entrant, Known(name))  # what can't be loaded is said before minutes of tuning
    return Selection(name, tuple(entrants), tuple(chosen), tuple(swept), family_seed, folder(out, name))


def named(names: Sequence[str], plant: Plant) -> list[Entrant]:
    """The policies with these names, and a user's own; where no name is given, all that the plant allows.

    Raises:
        ValueError: there is no such policy or file, or the plant does not allow it.
    """
    own, built_in = [], []
    for name in dict.fromkeys(names):
        found = jobs.entrant(name, plant)
        if jobs.is_own(name):
            same = found.kind == "user" and any(
                found.name == other.name for other in own
            )  # of several files with this name
            own.append(found._replace(name=name) if same else found)
        else:
            built_in.append(name)
    chosen = [name for name in jobs.possible(plant) if name == "none" or not built_in or name in built_in]
    return own + [jobs.entrant(name, plant) for name in chosen]


def folder(out: Path | str | None, plant: str) -> Path:
    """The folder to write to; by default runs/compare-PLANT, with -2, -3, ... where that exists.

    Raises:
        ValueError: `out` exists.
    """
    if out is not None:
        if Path(out).exists():
            raise ValueError(f"{out} exists; choose another --out")
        return Path(out)
    base = RUNS / f"compare-{plants.slug(plant)}"
    return next(p for p in (base, *(base.with_name(f"{base.name}-{i}") for i in range(2, 10_000))) if not p.exists())


def told(selection: Selection) -> str | None:
    """How long a plant outside JAX is going to take, where that is long."""
    each = host.step_seconds(plants.make(selection.plant)[0])
    if each is None:
        return None
    tuned = [c for c in selection.entrants if c.kind == "baseline" and c.name not in SIMPLE]
    seconds = each * BUDGET * len(tuned) + pace.seconds(selection.scenarios, None, len(selection.entrants))
    seconds /= min(os.cpu_count() or 1, len(selection.entrants))
    if seconds < pace.SAID:
        return None
    return (
        f"the plant takes {1e3 * each:.2g} ms a control step: up to {pace.duration(seconds)}, where nothing of it is "
        "in the cache; --policy and --scenario take fewer"
    )


def work(selection: Selection, progress: Progress) -> list[Done]:
    """All jobs done, in their order, with progress."""
    if (text := told(selection)) is not None:
        progress.print(text)
    every = jobs.jobs(selection.plant, selection.entrants, selection.scenarios, selection.sweeps, selection.family_seed)
    done: dict[Job, Done] = {}
    shares: dict[Job, float] = {}  # of each that has begun
    progress.phase("comparing", sum(job.work for job in every))

    def heard(job: Job, text: str, share: float) -> None:
        shares[job] = share
        progress.reach(
            sum(share * job.work for job, share in shares.items()),
            count=f"{len(done)} of {len(every)} jobs",
            job=f"{job}: {text}" if text else str(job),
        )

    for finished in jobs.spread(every, partial(jobs.prepare, tuple(REGISTRATIONS.values()), own_agents()), heard):
        done[finished.job] = finished
        heard(finished.job, f"{finished.seconds:.0f} s", 1.0)
    return [done[job] for job in every]


def assemble(selection: Selection, done: Sequence[Done], command: str, begun: float) -> Comparison:
    """What the jobs gave, with its statistics.

    Args:
        selection, done: what was asked for, and all of it done.
        command: of the user.
        begun: when, of `time.perf_counter`.
    """
    known = jobs.policies(selection.entrants, done)
    rows = statistics.ranks(jobs.rows(done), known)
    label = {(line.policy, line.run): line.label for line in statistics.lines(rows, known)}
    plant, _ = plants.make(selection.plant)
    swept = jobs.swept(done, selection.sweeps, label)
    return Comparison(
        plant=selection.plant,
        y_unit=plant.y_unit,
        time_unit=plant.time_unit,
        family_seed=selection.family_seed,
        date=datetime.date.today().isoformat(),
        machine=surroundings(),
        policies=known,
        rows=rows,
        statistics=statistics.summarise(rows, known),
        sweeps={
            name: replace(sweep, best_baseline=statistics.best_baseline(sweep, known)) for name, sweep in swept.items()
        },
        stability=jobs.stabilities(done, label),
        seconds=time.perf_counter() - begun,
        command=command,
        folder=str(selection.out),
    )


def write(selection: Selection, content: Comparison, done: Sequence[Done], progress: Progress) -> Path:
    """comparison.json, comparison.csv, figures and the report; returns the report's path."""
    values = msgspec.to_builtins(content, enc_hook=float)  # a user's settings may hold numbers of NumPy
    write_json(selection.out / "comparison.json", values)
    with (selection.out / "comparison.csv").open("w", newline="", encoding="utf-8") as file:
        keys = (key for row in values["rows"] for key in row)
        table = csv.DictWriter(file, list(dict.fromkeys([*COLUMNS, *keys])))
        table.writeheader()
        table.writerows(values["rows"])
    figures: dict[str, Path] = {}
    responses: dict[str, Path] = {}
    lines = statistics.lines(content.rows, content.policies)
    label = {(line.policy, line.run): line.label for line in lines}
    overall = OVERALL + len(selection.sweeps)
    progress.phase("drawing", overall + len(selection.scenarios))
    with optional("figures"):
        unstable = [name for name in selection.scenarios if not scenarios.get(name, 1).stable_alone]
        figures |= comparison_figures.draw(selection.out / "figures", content, unstable)
        progress.advance(overall)
        for name in selection.scenarios:
            traces = {label[c.line]: t for c, t in jobs.first_episodes(done, name).items()}
            traces = {line.label: traces[line.label] for line in lines}
            path = selection.out / "figures" / f"{plants.slug(name)}.png"
            scenario = scenarios.get(name, family_seed=selection.family_seed)
            responses[name] = comparison_figures.responses(path, scenario, traces, [line.label for line in lines])
            progress.advance()
    return report.write(selection.out / REPORT, content, figures, responses)
