"""`python -m jaxouter.train`: learn an outer loop, and evaluate it."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import jax
import msgspec
import numpy as np
import tyro

from jaxouter import cli, plants
from jaxouter.evaluation import figures, pace, scenarios
from jaxouter.evaluation.baselines import SIMPLE
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.policies import NamedPolicy, Results, TrainingSummary, baseline, counter, evaluate, result
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.verdict import judge
from jaxouter.plants import Plant
from jaxouter.plants.errors import PlantError
from jaxouter.plants.registry import add, own_errors
from jaxouter.progress import Progress, clock
from jaxouter.training import devices, tensorboard
from jaxouter.training.choice import choose
from jaxouter.training.config import TrainConfig, from_dict, preset, to_dict
from jaxouter.training.devices import Fleet, Processes
from jaxouter.training.environments import TrainState
from jaxouter.training.epochs import NotFiniteError, Pace, Row, train
from jaxouter.training.pretraining import PretrainingState
from jaxouter.training.resources import arithmetic, arithmetic_lines, resources
from jaxouter.training.run import FORMAT, RunFolder, add_agent, lock, write_json
from jaxouter.training.trainer import Trainer

LOOK_SECONDS = 5.0  # least time between two evaluations of the MAE during pretraining
FRESH = 4  # folded into a key
PROCESSES = tuple(Processes.__dataclass_fields__)
WATCHING = 0.1  # share of the learning time so far that the first evaluation may take on a plant outside JAX


@dataclass(frozen=True)
class Options:
    """Train an outer loop on a plant (pitch, heaters or your own) and evaluate it.

    Without options it trains on the pitch plant with the default preset. The preset supplies all defaults; options
    override it. `--list` prints plants, presets, scenarios, agents and policies.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    agent: str | None = None
    """Agent (see --list), or your own: FILE.py:CLASS of its settings; default: the preset's."""
    out: Path | None = None
    """New folder for the run; default: runs/PLANT-PRESET-SEED."""
    resume: Path | None = None
    """Resume the run in this folder; name a plant or agent of your own again. Another --devices may change results.
    Also allowed: --episodes, --tensorboard, --dry-run, --debug, --coordinator, --num-processes, --process-id."""
    coordinator: str | None = None
    """HOST:PORT of process 0, if there are several processes; --devices then counts those of all processes.
    In a SLURM step of several tasks or an indexed Kubernetes job (with `jax[k8s]`), JAX finds this and the next two."""
    num_processes: int | None = None
    """Number of processes. Start each with the same options, except --process-id."""
    process_id: int | None = None
    """Number of this process, from 0; process 0 writes the run folder, evaluates and prints."""
    episodes: int | None = None
    """Episodes of each scenario in the evaluation after the training; default: the scenario's own number.
    On a plant outside JAX (gym:, fmu:) the default is as many as take no longer than the training."""
    tensorboard: bool = False
    """Also write the metrics as TensorBoard events; needs the extra `tensorboard`."""
    dry_run: bool = False
    """Print configuration, shapes, memory and arithmetic, and exit before any training."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""
    list: bool = False
    """Print plants, presets, scenarios, agents and policies, and exit."""


def parse(arguments: list[str]) -> Options:
    """Parse the options; agent, plant and preset are read first, as they set the defaults of the others."""
    program = "python -m jaxouter.train"
    named = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    named.add_argument("--agent")
    agent = named.parse_known_args(arguments)[0].agent
    agent = add_agent(agent)
    first = Options(preset("pitch", agent=agent), agent)
    plain = [argument for argument in arguments if argument not in ("-h", "--help")]
    config = tyro.cli(Options, prog=program, args=plain, default=first).config
    plant = add(config.plant, config.plant_options)
    default = Options(preset(plant, config.preset, agent), agent)
    options = tyro.cli(Options, prog=program, args=arguments, default=default)
    options = dataclasses.replace(options, config=dataclasses.replace(options.config, plant=plant))
    if options.resume is not None:
        execution = {
            name: getattr(options, name)
            for name in ("agent", "resume", "dry_run", "tensorboard", "debug", "episodes", *PROCESSES)
        }
        config = dataclasses.replace(
            preset(plant, agent=agent), devices=options.config.devices, plant_options=options.config.plant_options
        )
        if options != dataclasses.replace(first, config=config, **execution):
            raise ValueError(
                "--resume takes no other options than your own plant or agent, --devices, --coordinator, "
                "--num-processes, --process-id, --episodes, --tensorboard, --dry-run and --debug; the run folder holds "
                "the rest"
            )
        run = RunFolder.open(options.resume).config
        if plant not in (run.plant, first.config.plant):
            raise ValueError(f"{options.resume} is a run on {run.plant}, not on {plant}")
        given = any(argument.split("=")[0] == "--devices" for argument in arguments)
        options = dataclasses.replace(
            options, config=dataclasses.replace(run, devices=options.config.devices if given else run.devices)
        )
    return options


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    begun = time.perf_counter()
    with cli.user_errors(arguments):
        options = parse(sys.argv[1:] if arguments is None else arguments)
        if options.list:
            return cli.print_lists()
        cli.use_compilation_cache()
        config = options.config.check()
        if options.episodes is not None and options.episodes < 1:
            raise ValueError(f"--episodes is {options.episodes}; it must be at least 1")
        if options.dry_run:
            config = config if options.resume is not None else chosen(config)
            lines = resources(config).lines + arithmetic_lines(config)
            print(json.dumps(to_dict(config), indent=2))
            return cli.table(f"{config.plant}, preset {config.preset}", ["what", "is"], lines)
        if options.tensorboard:
            tensorboard.require()
        processes = Processes(options.coordinator, options.num_processes, options.process_id)
        devices.connect(config.devices, processes.check(config.devices))
        with cli.progress(devices.is_first()) as progress, ExitStack() as stack:
            progress.phase("preparing")
            config = config if options.resume is not None else chosen(config)
            resources(config).check()
            Fleet.of(config)  # the last checks before anything is written
            path = devices.text_from_first(lambda: str(options.resume or RunFolder.create(config, options.out).path))
            run = RunFolder(Path(path), config)
            devices.text_from_first(lambda: stack.enter_context(lock(run.path)) or "")
            try:
                new = options.resume is None and devices.is_first()
                with own_errors():
                    with run.gone_if_nothing_is_learned() if new else nullcontext():
                        finals = learn(run, options, progress)
                    if devices.is_first() and finals is not None:
                        report(run, finals, begun, progress, options.episodes)
            except PlantError as error:
                kept = f"; what was learned is in {run.path}" if run.path.exists() else ""
                raise ValueError(f"{error}{kept}") from error
            except (OSError, NotFiniteError) as error:
                saved = f"what was saved before is intact, {go_on(run)}" if run.path.exists() else "nothing was saved"
                raise SystemExit(f"error: {error}; {saved}") from None
            except KeyboardInterrupt:  # the second Ctrl-C, or one after the training
                finals = None
    if finals is None:
        if devices.is_first():
            print(f"saved; {go_on(run)}" if run.path.exists() else "nothing was saved", file=sys.stderr)
        raise SystemExit(130)


def chosen(config: TrainConfig) -> TrainConfig:
    """Choose and print the plant-dependent settings of the configuration."""

    def choice() -> str:
        found = choose(config)
        if found.said is not None:
            print(f"{config.plant}: {found.said}", flush=True)
        for warning in found.warnings:
            cli.show(warning)
        return json.dumps(to_dict(found.config))

    return from_dict(json.loads(devices.text_from_first(choice)))


def go_on(run: RunFolder) -> str:
    """How to resume the run."""
    return f"resume with: python -m jaxouter.train --resume {run.path}"


def learn(run: RunFolder, options: Options, progress: Progress) -> dict[int, TrainState] | None:
    """Train with progress, to the end or until a signal."""
    config = run.config
    progress.print(f"{config.plant}, preset {config.preset}, seeds {', '.join(map(str, run.seeds))} -> {run.path}")
    for name, low, high in config.randomise:
        progress.print(f"{name} is drawn from {low:g} to {high:g}")
    if devices.is_first():
        for change in run.changes() if options.resume is not None else ():
            print(f"warning: {change}: results may differ from those of an uninterrupted run", file=sys.stderr)
    begun, first = time.perf_counter(), scenarios.reported(config.plant)[0]

    @cache
    def watched() -> scenarios.Scenario:
        return scenarios.get(first, pace.affordable([first], 1, WATCHING * (time.perf_counter() - begun)))

    def watch(trainer: Trainer, state: TrainState) -> dict[str, float]:
        # The members are recorded only to share a compiled function with the report, which needs them.
        traces = rollout(trainer.policy, trainer.policy_params(state), watched(), record_members=True)
        return {"mae": mae(traces)}

    shown = Learning(progress, config, plants.make(config.plant)[0], first)
    stopping = cli.Interrupt("what runs now ends, then everything is saved")
    with stopping as interrupt, closing(tensorboard.Events(run)) as events:

        def on_row(seed: int, row: Row) -> None:
            shown.epoch(seed, row)
            if options.tensorboard:
                events(seed, row)

        finals = train(run, watch, on_row, lambda: interrupt.requested, shown.pretrained, shown.begins)
    if finals is not None:
        shown.end()
    devices.part()
    return finals


class Learning:
    """Shows a training: one bar over the gradient steps of all seeds, and the current MAE of each."""

    def __init__(self, progress: Progress, config: TrainConfig, plant: Plant, watched: str) -> None:
        """Args: watched: id of the scenario of the MAE."""
        self._progress, self._config, self._plant, self._watched = progress, config, plant, watched
        start, updates = config.pretraining.gradient_steps, config.total_updates
        self._gradient_steps = config.seeds * (start + updates)
        # Weights matter only if there are both gradient steps of the pretraining and updates.
        self._weights = arithmetic(config) if start and updates else (1.0, 1.0)
        self._work = config.seeds * sum(n * w for n, w in zip((start, updates), self._weights, strict=True))
        self._done: dict[int, tuple[int, int]] = dict.fromkeys(range(config.seed, config.seed + config.seeds), (0, 0))
        self._maes: dict[int, str] = {}
        self._pace, self._what, self._begun = Pace(LOOK_SECONDS), "compiling", time.monotonic()
        progress.phase(self._what, self._work)

    def begins(self, what: str, done: int, of: int) -> None:
        """A phase before the gradient steps, and its progress; see `Say`."""
        if what != self._what:
            slow = counter([self._plant])
            if slow is not None and what == "recording":
                self._progress.phase(what, self._config.identification_steps, counter=slow)
            elif slow is not None and self._what == "recording":
                self._progress.phase(what, self._work, self._worked())
            else:
                self._progress.phase(what)
            self._what = what
        self._progress.say(pieces=f"{done} of {of} plants" if of > 1 else "")

    def pretrained(self, seed: int, at: PretrainingState, look: Callable[[], Row]) -> None:
        """Progress of the pretraining: now and then the MAE, if quick to evaluate, else the cost on the model."""
        if self._plant.differentiable:
            if self._pace.due():
                self._maes[seed] = cli.number(self._pace.do(look)["mae"])
        elif math.isfinite(at.best):
            self._progress.say(cost=f"cost a step on the model {cli.number(-float(at.best), 3)}")
        self._reached(seed, int(at.done), 0)

    def epoch(self, seed: int, row: Row) -> None:
        """An epoch has ended; the pretraining counts as epoch 0."""
        self._maes[seed] = cli.number(row["mae"])
        for name, what in (("skipped", "updates skipped"), ("no_action", "actions not finite")):
            self._progress.say(**{name: f"{row[name]:.1%} of the {what}" if row.get(name) else ""})
        self._progress.say(cost="")
        self._reached(seed, self._config.pretraining.gradient_steps, row["updates"])

    def _reached(self, seed: int, gradient_steps: int, updates: int) -> None:
        if self._what != "learning":
            self.begins("learning", 0, 0)
        self._done[seed] = gradient_steps, updates
        steps = sum(map(sum, self._done.values()))
        self._progress.reach(
            self._worked(), mae=self._mae(), count=f"{steps:,} of {self._gradient_steps:,} gradient steps"
        )

    def end(self) -> None:
        """Print a final line if anything was learned."""
        steps = sum(map(sum, self._done.values()))
        if steps:
            took = clock(time.monotonic() - self._begun)
            self._progress.print(f"learned in {took}  {self._mae()}  {steps:,} gradient steps")

    def _worked(self) -> float:
        return sum(n * w for each in self._done.values() for n, w in zip(each, self._weights, strict=True))

    def _mae(self) -> str:
        if not self._maes:
            return ""
        every = self._maes.items() if len(self._done) > 1 else ()
        found = ", ".join(f"seed {seed} {mae}" for seed, mae in sorted(every)) or next(iter(self._maes.values()))
        unit = "" if self._plant.y_unit == "1" else f" {self._plant.y_unit}"
        return f"MAE {found}{unit} on {self._watched}"


def report(
    run: RunFolder, finals: dict[int, TrainState], begun: float, progress: Progress, episodes: int | None
) -> None:
    """Evaluate on the paper's scenarios, write summary and figures, print the table."""
    plant, (trainer, params) = run.config.plant, run.trainer
    seconds = sum(row["seconds"] for seed in run.seeds for row in run.rows(seed)) / run.config.side_by_side
    identifiers, rollouts = scenarios.reported(plant), len(finals) + len(SIMPLE)
    if episodes is None:
        episodes = pace.affordable(identifiers, rollouts, seconds)
        if episodes is not None and episodes < scenarios.FAMILY_MEMBERS:
            text = pace.told(identifiers, episodes, rollouts)
            progress.print(f"evaluation: {text}, as long as learning took at most; --episodes sets another number")
    selected = [scenarios.get(identifier, episodes) for identifier in identifiers]
    total = rollouts * sum(scenario.r.size for scenario in selected)
    progress.phase("evaluating", total, counter=counter([selected[0].plant]))
    places = {scenario.id: scenarios.place(scenario, *run.drawn) for scenario in selected}
    simple = {name: baseline(name, plant) for name in SIMPLE}
    of_seeds = {seed: trainer.policy_params(state) for seed, state in finals.items()}
    policies = {seed: NamedPolicy("learned", trainer.policy, params) for seed, params in of_seeds.items()}

    def evaluated(named: NamedPolicy, alone: Results | None) -> Results:
        return evaluate(named, selected, True, alone, lambda scenario: progress.advance(scenario.r.size))

    alone = evaluated(simple["none"], None)
    simple_results = {name: alone if name == "none" else evaluated(named, alone) for name, named in simple.items()}
    learned = {seed: evaluated(named, alone) for seed, named in policies.items()}
    by_mae = sorted(learned, key=lambda seed: learned[seed][selected[0].id].figures.mae or np.inf)
    median = by_mae[(len(by_mae) - 1) // 2]
    key = jax.random.fold_in(jax.random.key(run.config.seed), FRESH)
    affine = {name: named.params for name, named in simple.items()}
    verdict = judge(trainer.env.plant, params.plant, key, trainer.policy, of_seeds, affine)
    summary = TrainingSummary(
        format=FORMAT,
        median_seed=median,
        training_seconds=seconds,
        steps=run.config.steps,
        identification_steps=run.config.identification_steps,
        updates=run.config.total_updates,
        places=places,
        episodes={scenario.id: len(scenario.r) for scenario in selected},
        verdict=verdict,
        results=[result(policies[seed], results, seed=seed) for seed, results in learned.items()]
        + [result(simple[name], results) for name, results in simple_results.items()],
    )
    write_json(run.path / "summary.json", msgspec.to_builtins(summary))
    show(selected, simple_results, learned, places if run.config.randomise else {})
    progress.print(verdict.text)
    progress.phase("drawing", len(selected) + 2)
    main_figure = ""
    with cli.optional("figures"):
        main_figure = f", main figure {draw(run, selected, simple_results, learned[median], progress.advance)}"
    progress.print(f"{time.perf_counter() - begun:.0f} s in all; run folder {run.path}{main_figure}")


def draw(
    run: RunFolder,
    selected: list[scenarios.Scenario],
    simple: dict[str, Results],
    learned: Results,
    drawn: Callable[[], None],
) -> Path:
    """Write every figure, of each of which `drawn` hears; returns the main one."""
    inner_traces, traces = (
        {name: found.traces for name, found in results.items()} for results in (simple["none"], learned)
    )
    for scenario in selected:
        name = scenario.id.replace("/", "-")
        figures.response(run.figures / f"{name}.png", scenario, inner_traces[scenario.id], traces[scenario.id])
        drawn()
    maes = {name: results[selected[0].id].figures.mae for name, results in simple.items()}
    levels = {name: value for name, value in maes.items() if value is not None}
    levels |= {"paper's DRL": selected[0].paper[1]} if selected[0].paper else {}
    rows = {seed: run.rows(seed) for seed in run.seeds}
    title = f"{selected[0].id}, MAE [{selected[0].plant.y_unit}]"
    if run.config.epochs:
        figures.learning_curve(run.figures / "learning-curve.png", rows, levels, title)
        drawn()
    return figures.paper(run.figures / "paper.png", selected, inner_traces, traces)


def show(
    selected: list[scenarios.Scenario],
    simple: dict[str, Results],
    learned: dict[int, Results],
    places: Mapping[str, str],
) -> None:
    """Print the table; with several seeds the median, least and largest MAE; places and the paper's figures if any."""
    rows, of_paper = [], any(scenario.paper for scenario in selected)
    for scenario in selected:
        of_seeds = [results[scenario.id].figures for results in learned.values()]
        values = [figures.mae for figures in of_seeds if figures.mae is not None]
        ours = cli.number(statistics.median(values)) if len(values) == len(of_seeds) else "diverged"
        if len(values) > 1:
            ours += f" ({cli.number(min(values))}-{cli.number(max(values))})"
        better = [figures.improvement for figures in of_seeds if figures.improvement is not None]
        paper = "-" if scenario.paper is None else f"{scenario.paper[1]:.2f} of {scenario.paper[0]:.2f}"
        inner, static = (simple[name][scenario.id].figures.mae for name in ("none", "static"))
        improvement = cli.number(statistics.median(better), 3) if better else "-"
        place = [places[scenario.id]] if places else []
        printed = [paper] if of_paper else []
        rows.append([scenario.id, *place, cli.number(inner), cli.number(static), *printed, ours, improvement])
    unit = selected[0].plant.y_unit
    columns = ["scenario", *(["plant"] if places else [])]
    columns += [
        "inner loop alone",
        "static prefilter",
        *(["paper's DRL"] if of_paper else []),
        "ours",
        "improvement, %",
    ]
    cli.table(f"MAE in {unit}", columns, rows)
    if places:
        print("plant: where it lies among those of the training")


if __name__ == "__main__":
    cli.run(main)
