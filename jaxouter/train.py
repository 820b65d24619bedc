"""`python -m jaxouter.train`: learn an outer loop, and evaluate it."""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxouter import cli, plants
from jaxouter.api.learning import MAIN_FIGURE, Stopped, chosen, following, training
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.cache import use_compilation_cache
from jaxouter.evaluation.metrics import FiguresOfMerit, number
from jaxouter.evaluation.policies import TrainingSummary
from jaxouter.plants.base import in_words
from jaxouter.plants.registry import add
from jaxouter.progress import Progress, showing
from jaxouter.tasks.presets import implied
from jaxouter.terminal import console
from jaxouter.training.config import TrainConfig, preset, to_dict
from jaxouter.training.devices import Processes, is_first
from jaxouter.training.epochs import NotFiniteError
from jaxouter.training.resources import arithmetic_lines, resources
from jaxouter.training.run import RunFolder, add_agent

PROCESSES = tuple(Processes.__dataclass_fields__)


SIMPLE = {
    "none": "inner loop alone",
    "static": "static prefilter",
    "lq": "LQ law",
    "bank": "bank of laws",
}  # columns of the table


@dataclass(frozen=True)
class Options:
    """Train an outer loop on a plant (pitch, heaters or your own) and evaluate it.

    Without options it trains on the pitch plant with the default preset. The preset supplies all defaults; options
    override it. `--list` prints plants, presets, scenarios, agents and policies.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    set: cli.Settings = ()
    """Parameters of the plant, such as --set tau 0.7 or --set W 0.1 0.003 -0.01; scenarios keep those they set."""
    agent: str | None = None
    """Agent (see --list), or your own: FILE.py:CLASS of its settings; default: the preset's."""
    out: Path | None = None
    """New folder for the run; default: runs/PLANT-PRESET-SEED."""
    resume: Path | None = None
    """Resume the run in this folder; name a plant or agent of your own again. Another --devices may change results.
    Also allowed: --episodes, --tensorboard, --wandb, --dry-run, --debug, --coordinator, --num-processes,
    --process-id."""
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
    wandb: bool = False
    """Also write the metrics for Weights & Biases, into the run folder, or to the server if WANDB_API_KEY is set; needs
    the extra `wandb`."""
    dry_run: bool = False
    """Print configuration, shapes, memory and arithmetic, and exit before any training."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also show the traceback of an error."""
    list: bool = False
    """Print plants, presets, scenarios, agents and policies, and exit."""


def parse(arguments: list[str]) -> Options:
    """Parse the options; agent, plant and preset are read first, as they set the defaults of the others."""
    program = cli.program("train")
    named = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    named.add_argument("--agent")
    agent = named.parse_known_args(arguments)[0].agent
    agent = add_agent(agent)
    first = Options(preset("pitch", agent=agent), agent=agent)
    plain = [argument for argument in arguments if argument not in ("-h", "--help")]
    given = tyro.cli(Options, prog=program, args=plain, default=first)
    config = given.config
    with Progress(console, config.plant not in plants.REGISTRY):  # JAX may have to find other processes first
        plant = add(config.plant, config.plant_options, cli.settings(given.set))
    name = implied(config.preset, config.base, agent)
    default = Options(preset(plant, name, agent), agent=agent)
    options = tyro.cli(Options, prog=program, args=arguments, default=default)
    options = dataclasses.replace(options, config=dataclasses.replace(options.config, plant=plant, preset=name))
    if options.resume is not None:
        execution = {
            name: getattr(options, name)
            for name in ("agent", "resume", "dry_run", "tensorboard", "wandb", "debug", "episodes", *PROCESSES)
        }
        config = dataclasses.replace(
            preset(plant, agent=agent), devices=options.config.devices, plant_options=options.config.plant_options
        )
        if options != dataclasses.replace(first, config=config, **execution):
            raise ValueError(
                "--resume takes no other options than your own plant or agent, --devices, --coordinator, "
                "--num-processes, --process-id, --episodes, --tensorboard, --wandb, --dry-run and --debug; the run "
                "folder holds the rest"
            )
        run = RunFolder.open(options.resume).config
        if plant not in (plants.base(run.plant), run.plant, first.config.plant):
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
        if options.dry_run:
            return dry_run(options)
        try:
            run = training(
                options.config,
                options.out,
                resumes=options.resume,
                episodes=options.episodes,
                follow=following(options.tensorboard, options.wandb),
                processes=Processes(options.coordinator, options.num_processes, options.process_id),
            )
        except (OSError, NotFiniteError) as error:
            raise SystemExit(f"error: {error}") from None
        except Stopped as stopped:
            if is_first():
                print(stopped, file=sys.stderr)
            raise SystemExit(130) from None
        if is_first() and run.summary is not None:
            show(run.summary, run.config)
            print(run.summary.verdict.text)
            figure = run.path / "figures" / MAIN_FIGURE
            drawn = f", main figure {figure}" if figure.exists() else ""
            print(f"{time.perf_counter() - begun:.0f} s in all; run folder {run.path}{drawn}")


def dry_run(options: Options) -> None:
    """Print the configuration and what it takes."""
    use_compilation_cache()
    config = options.config.check()
    if options.resume is None:
        with showing(False) as progress:
            config = chosen(config, progress)
    lines = resources(config).lines + arithmetic_lines(config)
    print(json.dumps(to_dict(config), indent=2))
    cli.table(f"{config.plant}, preset {config.preset}", ["what", "is"], lines)


def show(summary: TrainingSummary, config: TrainConfig) -> None:
    """Print the table; with several seeds the median, least and largest MAE; places and the paper's figures if any."""
    by_name: dict[str, list[dict[str, FiguresOfMerit]]] = {}
    for each in summary.results:
        by_name.setdefault(each.policy, []).append(each.scenarios)
    papers = {name: scenarios.get(name, 1).paper for name in summary.episodes}
    rows, of_paper, placed = [], any(papers.values()), bool(config.ranges)
    for name, of_scenario in papers.items():
        of_seeds = [found[name] for found in by_name["learned"]]
        values = [figures.mae for figures in of_seeds if figures.mae is not None]
        ours = number(statistics.median(values)) if len(values) == len(of_seeds) else "diverged"
        if len(values) > 1:
            ours += f" ({number(min(values))}-{number(max(values))})"
        better = [figures.improvement for figures in of_seeds if figures.improvement is not None]
        printed = "-" if of_scenario is None else f"{of_scenario[1]:.2f} of {of_scenario[0]:.2f}"
        simple = [number(by_name[each][0][name].mae) for each in SIMPLE if each in by_name]
        row = [name, *([summary.places[name]] if placed else []), *simple]
        improvement = number(statistics.median(better), 3) if better else "-"
        rows.append([*row, *([printed] if of_paper else []), ours, improvement])
    columns = ["scenario", *(["plant"] if placed else []), *(SIMPLE[each] for each in SIMPLE if each in by_name)]
    columns += [*(["paper's DRL"] if of_paper else []), "ours", "improvement, %"]
    cli.table("MAE" + in_words(plants.make(config.plant)[0].y_unit, " in {}"), columns, rows)
    if placed:
        print("plant: inside, at the edge of, or outside the range of plants trained on")


if __name__ == "__main__":
    cli.run(main)
