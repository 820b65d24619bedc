"""`python -m jaxouter.train`: learn an outer loop, and see what it is worth."""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jaxouter import cli
from jaxouter.evaluation import figures, pace, scenarios
from jaxouter.evaluation.evaluate import Named, Results, evaluate, result, rival
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rivals import SIMPLE
from jaxouter.evaluation.rollout import rollout
from jaxouter.plants.errors import PlantError
from jaxouter.plants.sources import add, own_errors
from jaxouter.training import devices, tensorboard
from jaxouter.training.config import TrainConfig, preset, to_dict
from jaxouter.training.devices import Fleet, Processes
from jaxouter.training.plan import plan
from jaxouter.training.run import FORMAT, Run, write_json
from jaxouter.training.train import NotFiniteError, Row, train
from jaxouter.training.trainer import Trainer, TrainState

WATCHING = 0.1  # of the time of learning so far, which the first look at the MAE may take of a plant outside JAX


@dataclass(frozen=True)
class Options:
    """Train an outer loop on a plant (pitch, heaters or your own) and show what came out.

    Without options the pitch plant is learned with the default preset. The preset sets every other field; what is
    given here overrides it. `--list` prints plants, presets, scenarios and policies.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    out: Path | None = None
    """Folder for the run, which must not exist; default: runs/PLANT-PRESET-SEED."""
    resume: Path | None = None
    """Go on with the run in this folder; takes no other option but a plant of your own, which is named
    again, --episodes, --tensorboard, --dry-run, --debug, --devices (draws go on
    otherwise where a learner then spans another number of them) and how to find the other processes."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where there is more than one process; --devices then counts those of all. In a step of
    several SLURM tasks or an indexed Kubernetes job (with `jax[k8s]`) JAX finds this and the next two by itself."""
    num_processes: int | None = None
    """Processes in all, each started with the same options but its own --process-id."""
    process_id: int | None = None
    """Number of this process, from 0; process 0 writes the run folder, evaluates and prints."""
    episodes: int | None = None
    """Episodes of each scenario after the training; default: its own number, on a plant outside JAX (gym:, fmu:) as
    many as take no longer than the learning did."""
    tensorboard: bool = False
    """Write the metrics as TensorBoard events too, beside metrics.jsonl; needs the extra `tensorboard`."""
    dry_run: bool = False
    """Print configuration, shapes, memory and arithmetic, and end before any work."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the trace of an error too."""
    list: bool = False
    """Print plants, presets, scenarios and policies, and end."""


def parse(arguments: list[str]) -> Options:
    """The options; plant and preset are read first, since they set the defaults of all others."""
    program = "python -m jaxouter.train"
    first = Options(preset("pitch"))
    plain = [argument for argument in arguments if argument not in ("-h", "--help")]
    config = tyro.cli(Options, prog=program, args=plain, default=first).config
    plant = add(config.plant, config.plant_options)
    options = tyro.cli(Options, prog=program, args=arguments, default=Options(preset(plant, config.preset)))
    options = dataclasses.replace(options, config=dataclasses.replace(options.config, plant=plant))
    if options.resume is not None:
        execution = {
            name: getattr(options, name)
            for name in ("resume", "dry_run", "tensorboard", "debug", "episodes", *Processes.__dataclass_fields__)
        }
        config = dataclasses.replace(
            preset(plant), devices=options.config.devices, plant_options=options.config.plant_options
        )
        if options != dataclasses.replace(first, config=config, **execution):
            raise ValueError(
                "--resume takes no other option but a plant of your own, --devices, --coordinator, --num-processes, "
                "--process-id, --episodes, --tensorboard, --dry-run and --debug: the run folder holds them all"
            )
        run = Run.open(options.resume).config
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
            print(json.dumps(to_dict(config), indent=2))
            return cli.table(f"{config.plant}, preset {config.preset}", ["what", "is"], plan(config).lines)
        if options.tensorboard:
            tensorboard.require()
        processes = Processes(options.coordinator, options.num_processes, options.process_id)
        devices.connect(config.devices, processes.check(config.devices))
        plan(config).check()
        Fleet.of(config)  # what is left of the checks, before anything is written
        path = devices.text_from_first(lambda: str(options.resume or Run.create(config, options.out).path))
        run = Run(Path(path), config)
        with ExitStack() as stack:
            devices.text_from_first(lambda: stack.enter_context(run.lock()) or "")
            try:
                new = options.resume is None and devices.is_first()
                with own_errors():
                    with run.gone_if_nothing_is_learned() if new else nullcontext():
                        finals = learn(run, options)
                    if devices.is_first() and finals is not None:
                        report(run, finals, begun, options.episodes)
            except PlantError as error:
                kept = f"; what was learned is in {run.path}" if run.path.exists() else ""
                raise ValueError(f"{error}{kept}") from error
            except (OSError, NotFiniteError) as error:
                saved = f"what was saved before is whole, {go_on(run)}" if run.path.exists() else "nothing was saved"
                raise SystemExit(f"error: {error}; {saved}") from None
    if finals is None:
        if devices.is_first():
            print(f"saved; {go_on(run)}", file=sys.stderr)
        raise SystemExit(130)


def go_on(run: Run) -> str:
    """How to."""
    return f"go on with: python -m jaxouter.train --resume {run.path}"


def learn(run: Run, options: Options) -> dict[int, TrainState] | None:
    """Train with progress, until the end or a signal."""
    config, trainer = run.config, run.trainer[0]
    if devices.is_first():
        print(f"{config.plant}, preset {config.preset}, seeds {', '.join(map(str, run.seeds))} -> {run.path}")
        for name, low, high in config.randomise:
            print(f"each plant has its own {name}, from {low:g} to {high:g}")
        for change in run.changes() if options.resume is not None else ():
            print(f"warning: {change}: the run may end otherwise than it would have", file=sys.stderr)
    begun, first = time.perf_counter(), scenarios.paper_scenarios(config.plant)[0]

    @cache
    def watched() -> scenarios.Scenario:
        return scenarios.get(first, pace.affordable([first], 1, WATCHING * (time.perf_counter() - begun)))

    def watch(trainer: Trainer, state: TrainState) -> dict[str, float]:
        # With the single outputs only because the report asks for them too, in the same compiled function.
        traces = rollout(trainer.policy, trainer.policy_params(state), watched(), record_members=True)
        return {"mae": mae(traces)}

    bars = cli.TrainingProgress(config, trainer.env.plant.y_unit)
    with cli.Interrupt() as interrupt, bars as progress, closing(tensorboard.Events(run)) as events:

        def heard(seed: int, row: Row) -> None:
            progress(seed, row)
            if options.tensorboard:
                events(seed, row)

        finals = train(run, watch, heard, lambda: interrupt.requested, progress.pretrained)
    devices.part()
    return finals


def report(run: Run, finals: dict[int, TrainState], begun: float, episodes: int | None) -> None:
    """Evaluate on the paper's scenarios, write summary and figures, print the table."""
    plant, (trainer, _) = run.config.plant, run.trainer
    seconds = sum(row["seconds"] for seed in run.seeds for row in run.rows(seed)) / run.config.side_by_side
    identifiers = scenarios.paper_scenarios(plant)
    if episodes is None:
        episodes = pace.affordable(identifiers, rollouts := len(finals) + len(SIMPLE), seconds)
        if episodes is not None and episodes < scenarios.FAMILY_MEMBERS:
            text = pace.told(identifiers, episodes, rollouts)
            print(f"evaluation: {text}, as long as learning took at most; --episodes sets another number", flush=True)
    met = [scenarios.get(identifier, episodes) for identifier in identifiers]
    places = {scenario.id: scenarios.place(scenario, *run.drawn) for scenario in met}
    simple = {name: rival(name, plant) for name in SIMPLE}
    policies = {seed: Named("learned", trainer.policy, trainer.policy_params(state)) for seed, state in finals.items()}
    alone = evaluate(simple["none"], met, record_members=True)
    others = {name: named for name, named in simple.items() if name != "none"}
    simple_results = {"none": alone} | {name: evaluate(named, met, True, alone) for name, named in others.items()}
    learned = {seed: evaluate(named, met, record_members=True, alone=alone) for seed, named in policies.items()}
    by_mae = sorted(learned, key=lambda seed: learned[seed][met[0].id][1]["mae"] or np.inf)
    median = by_mae[(len(by_mae) - 1) // 2]
    main_figure = draw(run, met, simple_results, learned[median])
    summary = {
        "format": FORMAT,
        "median_seed": median,
        "training_seconds": seconds,
        "steps": run.config.steps,
        "identification_steps": run.config.identification_steps,
        "updates": run.config.total_updates,
        "places": places,
        "episodes": {scenario.id: len(scenario.r) for scenario in met},
        "results": [result(policies[seed], results, seed=seed) for seed, results in learned.items()]
        + [result(simple[name], results) for name, results in simple_results.items()],
    }
    write_json(run.path / "summary.json", summary)
    show(met, simple_results, learned, places if run.config.randomise else {})
    print(f"{time.perf_counter() - begun:.0f} s in all; run folder {run.path}, main figure {main_figure}")


def draw(run: Run, met: list[scenarios.Scenario], simple: dict[str, Results], learned: Results) -> Path:
    """Write every figure; returns the main one."""
    inner_traces, traces = ({name: t for name, (t, _) in results.items()} for results in (simple["none"], learned))
    for scenario in met:
        name = scenario.id.replace("/", "-")
        figures.response(run.figures / f"{name}.png", scenario, inner_traces[scenario.id], traces[scenario.id])
    levels = {name: results[met[0].id][1]["mae"] for name, results in simple.items()}
    levels |= {"paper's DRL": met[0].paper[1]} if met[0].paper else {}
    rows = {seed: run.rows(seed) for seed in run.seeds}
    title = f"{met[0].id}, MAE [{met[0].plant.y_unit}]"
    if run.config.epochs:
        figures.learning_curve(run.figures / "learning-curve.png", rows, levels, title)
    return figures.paper(run.figures / "paper.png", met, inner_traces, traces)


def show(
    met: list[scenarios.Scenario],
    simple: dict[str, Results],
    learned: dict[int, Results],
    places: Mapping[str, str],
) -> None:
    """Print the table; with several seeds the median, least and largest MAE. Places are shown where there are any."""
    rows = []
    for scenario in met:
        of_seeds = [results[scenario.id][1] for results in learned.values()]
        values = [figures["mae"] for figures in of_seeds if figures["mae"] is not None]
        ours = cli.number(statistics.median(values)) if len(values) == len(of_seeds) else "diverged"
        if len(values) > 1:
            ours += f" ({cli.number(min(values))}-{cli.number(max(values))})"
        better = [figures["improvement"] for figures in of_seeds if figures["improvement"] is not None]
        paper = "-" if scenario.paper is None else f"{scenario.paper[1]:.2f} of {scenario.paper[0]:.2f}"
        inner, static = (simple[name][scenario.id][1]["mae"] for name in ("none", "static"))
        improvement = cli.number(statistics.median(better), 3) if better else "-"
        place = [places[scenario.id]] if places else []
        rows.append([scenario.id, *place, cli.number(inner), cli.number(static), paper, ours, improvement])
    unit = met[0].plant.y_unit
    columns = ["scenario", *(["plant"] if places else [])]
    columns += ["inner loop alone", "static prefilter", "paper's DRL", "ours", "improvement, %"]
    cli.table(f"MAE in {unit}", columns, rows)
    if places:
        print("plant: where it lies among those of the training")


if __name__ == "__main__":
    cli.run(main)
