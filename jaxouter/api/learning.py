"""Learning an outer loop: configure, choose what depends on the plant, train with progress, evaluate, draw."""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from jaxouter.api.run import Run, load
from jaxouter.evaluation import pace, scenarios, verdict
from jaxouter.evaluation.baselines import SIMPLE
from jaxouter.evaluation.cache import use_compilation_cache
from jaxouter.evaluation.metrics import mae, number, reward_terms, trained_return
from jaxouter.evaluation.policies import (
    NamedPolicy,
    Results,
    TrainedReward,
    TrainingSummary,
    baseline,
    counter,
    evaluate_on,
    result,
)
from jaxouter.evaluation.rollout import rollout
from jaxouter.identification import bank
from jaxouter.identification.dynamics import exploration
from jaxouter.loop import rewards
from jaxouter.loop.bank import Bank
from jaxouter.loop.policy import Linear
from jaxouter.plants import Plant, base, make, slug
from jaxouter.plants.base import in_words
from jaxouter.plants.errors import PlantError
from jaxouter.plants.registry import REGISTRATIONS, Maker, add, own_errors
from jaxouter.plants.simulators import PlantOptions
from jaxouter.progress import Progress, clock, showing
from jaxouter.tasks.presets import implied
from jaxouter.terminal import Interrupt, optional
from jaxouter.training import devices, trackers
from jaxouter.training.choice import choose
from jaxouter.training.config import TrainConfig, from_dict, preset, to_dict, with_options
from jaxouter.training.devices import Fleet, Processes
from jaxouter.training.environments import TrainState
from jaxouter.training.epochs import NotFiniteError, Pace, Report, Row, train
from jaxouter.training.policy import LearnedParams
from jaxouter.training.pretraining import PretrainingState
from jaxouter.training.resources import arithmetic, resources
from jaxouter.training.run import FORMAT, RUNS, RunFolder, add_agent, lock, write_json
from jaxouter.training.trainer import Trainer

LOOK_SECONDS = 5.0  # least time between two evaluations of the MAE during pretraining
FRESH = 4  # folded into a key
MAIN_FIGURE = "paper.png"
ANIMATION = "episode.webp"
WATCHING = 0.1  # share of the learning time so far that the first evaluation may take on a plant outside JAX


class Stopped(KeyboardInterrupt):
    """A training was stopped by Ctrl-C or SIGTERM; the text says what is saved, and how to resume."""


class ChoiceWarning(UserWarning):
    """A setting that does not suit the plant."""


def learn(
    plant: str | Maker = "pitch",
    preset: str = "default",
    seed: int = 0,
    out: Path | str | None = None,
    progress: bool | Progress = True,
    *,
    agent: str | Mapping[str, Any] | None = None,
    set: Mapping[str, Any] | None = None,
    episodes: int | None = None,
    tensorboard: bool = False,
    wandb: bool = False,
    on_epoch: Report | None = None,
    **settings: Any,
) -> Run:
    """Learn an outer loop, as `python -m jaxouter.train` does, and evaluate it.

    For example: `run = jaxouter.learn("pitch", seed=0)`.

    Args:
        plant: as the command names it: pitch, heaters, FILE.py:NAME, gym:ID, fmu:FILE or log:FILE; or your own function
            or `Task` that makes the plant.
        preset: supplies the defaults of the settings.
        seed: of all random numbers.
        out: new folder for the run; None: runs/PLANT-PRESET-SEED.
        progress: whether to show progress.
        agent: None: the preset's; another one by name, or FILE.py:CLASS. Settings such as `{"discount": 0.9}` are of
            the preset's, or of the agent that is named among them: `{"name": NAME, "discount": 0.9}`.
        set: parameters of the plant, such as `{"tau": 0.7}`.
        episodes: of each scenario in the evaluation; None: the scenario's own number.
        tensorboard, wandb: whether to write the metrics for these tools too.
        on_epoch: called with the seed and the row of metrics.jsonl after each epoch. What it raises ends the training;
            what was saved is intact.
        **settings: options of the command, such as `steps=20_000` or `pretraining={"gradient_steps": 500}`.

    Raises:
        ValueError: something named does not exist, a setting is wrong, or the plant's code failed.
        Stopped: Ctrl-C; what was learned is saved.
        OSError, NotFiniteError: a file can't be written, or parameters became infinite; what was saved is intact.
    """
    with own_errors():
        config = configured(plant, preset, agent, set, {"seed": seed, **settings})
        return training(
            config, out, progress=progress, episodes=episodes, follow=following(tensorboard, wandb), on_epoch=on_epoch
        )


def resume(
    run: Run | Path | str,
    progress: bool | Progress = True,
    *,
    episodes: int | None = None,
    tensorboard: bool = False,
    wandb: bool = False,
    on_epoch: Report | None = None,
) -> Run:
    """Resume a run that was stopped, or that in a folder; other arguments and errors as for `learn`."""
    with own_errors():
        run = run if isinstance(run, Run) else load(run)
        return training(
            run.config,
            resumes=run.path,
            progress=progress,
            episodes=episodes,
            follow=following(tensorboard, wandb),
            on_epoch=on_epoch,
        )


def configured(
    plant: str | Maker,
    name: str,
    agent: str | Mapping[str, Any] | None,
    parameters: Mapping[str, Any] | None,
    settings: Mapping[str, Any],
) -> TrainConfig:
    """The configuration of a training; arguments as for `learn`.

    Raises:
        ValueError: unknown plant, preset, agent or setting, or a wrong value.
    """
    of_agent = {"name": agent} if agent is None or isinstance(agent, str) else {"name": None, **agent}
    known_agent = add_agent(of_agent.pop("name"))
    flat: dict[str, Any] = {}
    for key, value in {**settings, "agent": of_agent}.items():
        flat |= (
            {f"{key}.{each}": inner for each, inner in value.items()} if isinstance(value, Mapping) else {key: value}
        )
    of_plant = {key: flat.pop(key) for key in list(flat) if key in PlantOptions.__dataclass_fields__}
    options = PlantOptions(**of_plant)
    name = implied(name, flat.get("base", "lq"), known_agent)
    default = preset(add(plant, options, parameters), name, known_agent)
    return from_dict(to_dict(with_options(default, {**flat, "plant_options": options})))  # which looks at types too


def following(tensorboard: bool, wandb: bool) -> tuple[str, ...]:
    """Names of the trackers that are wanted."""
    return tuple(name for name, wanted in (("tensorboard", tensorboard), ("wandb", wandb)) if wanted)


def learners(
    plant: str | Maker,
    agents: Sequence[str],
    seeds: int = 1,
    steps: int | None = None,
    set: Mapping[str, Any] | None = None,
    progress: bool | Progress = True,
) -> list[Run]:
    """Runs of several agents with the preset `scratch`: those in runs/PLANT-scratch-AGENT, else trained there.

    Args:
        plant: as for `learn`.
        agents: names, or FILE.py:CLASS.
        seeds: of each agent, from 0.
        steps: environment steps of each; what is left of whole unrolls is not used; None: the preset's.
        set, progress: as for `learn`.

    Raises:
        ValueError: something named does not exist, a setting is wrong, or a folder holds another or an unfinished run.
        Stopped, OSError, NotFiniteError: as for `learn`.
    """
    with own_errors():
        name = add(plant, parameters=set)
        configs = {agent: preset(name, "scratch", add_agent(agent)) for agent in agents}
    found = []
    for agent, config in configs.items():
        data, wanted = config.agent.data, config.steps if steps is None else steps
        each = config.environments * getattr(data, "unroll", 1)
        whole = data.before + max(1, (wanted - data.before) // each) * each
        config = replace(config, seeds=seeds, steps=whole)
        path = RUNS / f"{slug(config.plant)}-scratch-{agent.rpartition(':')[2]}"
        if not path.exists():
            found.append(training(config, path, progress=progress))
            continue
        run = RunFolder.open(path)
        as_chosen = {field: getattr(run.config, field) for field in ("history", "explored_steps", "pretraining")}
        if replace(config, **as_chosen) != run.config:
            raise ValueError(f"{path} holds a run with other settings, steps or seeds; move it elsewhere")
        if not (path / "summary.json").exists():
            raise ValueError(f"{path} is not finished; {go_on(run)}")
        found.append(Run(run))
    return found


def training(
    config: TrainConfig,
    out: Path | str | None = None,
    *,
    resumes: Path | None = None,
    progress: bool | Progress = True,
    episodes: int | None = None,
    follow: Sequence[str] = (),
    on_epoch: Report | None = None,
    processes: Processes = Processes(),  # noqa: B008 - frozen
) -> Run:
    """Train, evaluate and draw a configuration; in all processes, of which the first writes.

    Args:
        config: of the run.
        out: new folder; None: the default one.
        resumes: folder of a run to resume instead.
        progress, episodes: as for `learn`.
        follow: trackers of the metrics, see `jaxouter.training.trackers`.
        on_epoch: as for `learn`.
        processes: how this process finds the others.
    """
    use_compilation_cache()
    config.check()
    if episodes is not None and episodes < 1:
        raise ValueError(f"--episodes is {episodes}; it must be at least 1")
    trackers.require(follow)
    devices.connect(config.devices, processes.check(config.devices))
    shown = progress if isinstance(progress, Progress) else progress and devices.is_first()
    with showing(shown) as progress, ExitStack() as stack:
        config = config if resumes is not None else chosen(config, progress)
        resources(config).check()
        Fleet.of(config)  # the last checks before anything is written
        new = None if out is None else Path(out)
        path = devices.text_from_first(lambda: str(resumes or RunFolder.create(config, new).path))
        run = RunFolder(Path(path), config)
        devices.text_from_first(lambda: stack.enter_context(lock(run.path)) or "")
        fresh = resumes is None and devices.is_first()
        try:
            with own_errors():
                with run.gone_if_nothing_is_learned() if fresh else nullcontext():
                    finals = _trained(run, resumes is not None, follow, on_epoch, progress)
                if devices.is_first() and finals is not None:
                    report(run, finals, progress, episodes)
        except PlantError as error:
            kept = f"; what was learned is in {run.path}" if run.path.exists() else ""
            raise ValueError(f"{error}{kept}") from error
        except (OSError, NotFiniteError) as error:
            saved = f"what was saved before is intact, {go_on(run)}" if run.path.exists() else "nothing was saved"
            raise type(error)(f"{error}; {saved}") from error
        except KeyboardInterrupt:  # the second Ctrl-C, or one after the training
            finals = None
    if finals is None:
        raise Stopped(f"saved; {go_on(run)}" if run.path.exists() else "nothing was saved")
    return Run(run)


def chosen(config: TrainConfig, progress: Progress) -> TrainConfig:
    """Choose the plant-dependent settings of the configuration, and say which."""
    plant, _ = make(config.plant)
    if (slow := counter([plant])) is not None:
        progress.phase("identifying", exploration(plant), counter=slow)

    def choice() -> str:
        found = choose(config)
        if found.said is not None:
            progress.print(f"{config.plant}: {found.said}")
        for warning in found.warnings:
            warnings.warn(warning, ChoiceWarning, stacklevel=2)
        return json.dumps(to_dict(found.config))

    return from_dict(json.loads(devices.text_from_first(choice)))


def go_on(run: RunFolder) -> str:
    """How to resume the run."""
    registered = REGISTRATIONS.get(base(run.config.plant))
    if registered is not None and registered.session:
        return f"resume with: jaxouter.resume(jaxouter.load({str(run.path)!r}, plant=...))"
    return f"resume with: python -m jaxouter.train --resume {run.path}"


def _trained(
    run: RunFolder, resumed: bool, follow: Sequence[str], on_epoch: Report | None, progress: Progress
) -> dict[int, TrainState] | None:
    """Train with progress, to the end or until a signal."""
    config = run.config
    progress.print(f"{config.plant}, preset {config.preset}, seeds {', '.join(map(str, run.seeds))} -> {run.path}")
    for name, low, high in config.ranges:
        how = "of the plants of the bank is" if config.bank else "is drawn from"
        progress.print(f"{name} {how} {low:g} to {high:g}")
    plant, _ = make(config.plant)
    if (changed := reward_changes(config, plant)) is not None:
        progress.print(f"trained on {changed}; `return` is reported with the paper's weights")
    if devices.is_first():
        for change in run.changes() if resumed else ():
            warnings.warn(
                f"{change}: results may differ from those of an uninterrupted run", ChoiceWarning, stacklevel=2
            )
    begun, first = time.perf_counter(), scenarios.reported(config.plant)[0]

    @cache
    def watched() -> scenarios.Scenario:
        return scenarios.get(first, pace.affordable([first], 1, WATCHING * (time.perf_counter() - begun)))

    def watch(trainer: Trainer, state: TrainState) -> dict[str, float]:
        # The members are recorded only to share a compiled function with the report, which needs them.
        traces = rollout(trainer.policy, trainer.policy_params(state), watched(), record_members=True)
        return {"mae": mae(traces), **reward_terms(traces, plant)}

    shown = Learning(progress, config, plant, first)
    stopping = Interrupt("what runs now ends, then everything is saved")
    with stopping as interrupt, closing(trackers.Trackers(run, follow)) as followed:

        def on_row(seed: int, row: Row) -> None:
            shown.epoch(seed, row)
            followed(seed, row)
            if on_epoch is not None:
                on_epoch(seed, row)

        finals = train(run, watch, on_row, lambda: interrupt.requested, shown.pretrained, shown.begins)
    if finals is not None:
        shown.end()
    devices.part()
    return finals


def reward_changes(config: TrainConfig, plant: Plant) -> str | None:
    """How the reward that is trained on differs from the paper's; None: it does not."""
    paper = vars(rewards.PAPER)
    changes = [f"{name} {value} (paper: {paper[name]})" for name, value in vars(config.reward).items()]
    changes = [text for text, name in zip(changes, paper, strict=True) if getattr(config.reward, name) != paper[name]]
    changes += [f"the plant's term {term.__name__}" for term in plant.reward_terms]
    return ", ".join(changes) or None


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
                steps = self._config.identification_steps - self._config.explored_steps  # those came before
                self._progress.phase(what, steps, counter=slow)
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
                self._maes[seed] = number(self._pace.do(look)["mae"])
        elif math.isfinite(at.best):
            self._progress.say(cost=f"cost a step on the model {number(-float(at.best), 3)}")
        self._reached(seed, int(at.done), 0)

    def epoch(self, seed: int, row: Row) -> None:
        """An epoch has ended; the pretraining counts as epoch 0."""
        self._maes[seed] = number(row["mae"])
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
        return f"MAE {found}{in_words(self._plant.y_unit)} on {self._watched}"


def report(run: RunFolder, finals: dict[int, TrainState], progress: Progress, episodes: int | None) -> None:
    """Evaluate on the reported scenarios; write summary.json and the figures."""
    config, (trainer, params) = run.config, run.trainer
    plant = config.plant
    seconds = sum(row["seconds"] for seed in run.seeds for row in run.rows(seed)) / config.side_by_side
    of_seeds = {seed: trainer.policy_params(state) for seed, state in finals.items()}
    simple = {name: baseline(name, plant) for name in SIMPLE}
    law, actor = of_seeds[config.seed].base, of_seeds[config.seed].actor
    if isinstance(law, Bank):
        idle = LearnedParams(jax.tree.map(np.zeros_like, actor), law)
        simple["bank"] = NamedPolicy("bank", trainer.policy, idle, plant)
    elif np.any(law.y_past):
        simple["lq"] = NamedPolicy("lq", Linear(trainer.env.plant.r_tilde_bounds), law, plant)
    identifiers, rollouts = scenarios.reported(plant), len(finals) + len(simple)
    if episodes is None:
        episodes = pace.affordable(identifiers, rollouts, seconds)
        if episodes is not None and episodes < scenarios.FAMILY_MEMBERS:
            text = pace.told(identifiers, episodes, rollouts)
            progress.print(f"evaluation: {text}, as long as learning took at most; --episodes sets another number")
    selected = [scenarios.get(identifier, episodes) for identifier in identifiers]
    judged = verdict.steps(trainer.env.plant)
    total = rollouts * (sum(scenario.r.size for scenario in selected) + judged)
    progress.phase("evaluating", total, counter=counter([selected[0].plant]))
    policies = {seed: NamedPolicy("learned", trainer.policy, params, plant) for seed, params in of_seeds.items()}

    def evaluated(named: NamedPolicy, alone: Results | None) -> Results:
        return evaluate_on(named, selected, True, alone, lambda scenario: progress.advance(scenario.r.size))

    def trained(results: Results) -> dict[str, float | None]:
        of = {scenario.id: scenario.plant for scenario in selected}
        return {name: trained_return(found.traces, of[name], config.reward) for name, found in results.items()}

    alone = evaluated(simple["none"], None)
    simple_results = {name: alone if name == "none" else evaluated(named, alone) for name, named in simple.items()}
    learned = {seed: evaluated(named, alone) for seed, named in policies.items()}
    by_mae = sorted(learned, key=lambda seed: learned[seed][selected[0].id].figures.mae or np.inf)
    median = by_mae[(len(by_mae) - 1) // 2]
    key = jax.random.fold_in(jax.random.key(config.seed), FRESH)
    trained_on = trainer.env.plant, params.plant
    if config.bank:
        trained_on = bank.drawing(*trained_on, config.bank)
    linear = {name: named.params for name, named in simple.items() if name != "bank"}
    terms = [term.__name__ for term in trainer.env.plant.reward_terms]
    summary = TrainingSummary(
        format=FORMAT,
        median_seed=median,
        training_seconds=seconds,
        steps=config.steps,
        identification_steps=config.identification_steps,
        updates=config.total_updates,
        reward=TrainedReward(vars(config.reward), terms, vars(rewards.PAPER) | {"terms": 0.0}),
        places={scenario.id: scenarios.place(scenario, *run.drawn) for scenario in selected},
        episodes={scenario.id: len(scenario.r) for scenario in selected},
        verdict=verdict.judge(*trained_on, key, trainer.policy, of_seeds, linear),
        results=[
            result("learned", results, seed=seed, trained_return=trained(results)) for seed, results in learned.items()
        ]
        + [result(name, results, trained_return=trained(results)) for name, results in simple_results.items()],
    )
    write_json(run.path / "summary.json", msgspec.to_builtins(summary))
    progress.phase("drawing", len(selected) + 2)
    with optional("figures"):
        draw(run, selected, simple_results, learned[median], progress.advance)


def draw(
    run: RunFolder,
    selected: list[scenarios.Scenario],
    simple: dict[str, Results],
    learned: Results,
    drawn: Callable[[], None],
) -> None:
    """Write every figure, of each of which `drawn` hears."""
    from jaxouter.evaluation import figures  # matplotlib takes two seconds, also where nothing is drawn

    inner_traces, traces = (
        {name: found.traces for name, found in results.items()} for results in (simple["none"], learned)
    )
    for scenario in selected:
        name = f"{slug(scenario.id)}.png"
        figure = figures.response([scenario], inner_traces, traces)
        figures.keep(figure, run.figures / name)
        if scenario is selected[0]:
            figures.animate(figure, run.figures / ANIMATION)
        drawn()
    maes = {name: results[selected[0].id].figures.mae for name, results in simple.items()}
    levels = {name: value for name, value in maes.items() if value is not None}
    levels |= {"paper's DRL": selected[0].paper[1]} if selected[0].paper else {}
    rows = {seed: run.rows(seed) for seed in run.seeds}
    title = f"{selected[0].id}, MAE" + in_words(figures.symbol(selected[0].plant.y_unit), " [{}]")
    if run.config.epochs:
        figures.keep(figures.learning_curve(rows, levels, title), run.figures / "learning-curve.png")
        drawn()
    figures.keep(figures.response(selected[:2], inner_traces, traces), run.figures / MAIN_FIGURE)
