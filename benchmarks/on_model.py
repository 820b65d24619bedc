"""What pairs are worth where the plant can't be branched: learned on the model of the record, and on the plant itself.

    python benchmarks/on_model.py                  # pitch and tanks, three seeds; 20 minutes
    python benchmarks/on_model.py tanks --seeds 1

All rows begin with the LQ law of one record. A round's actors are compared where its pairs are made, and what was
learned is compared with the law on fresh episodes of the plant at the end. Numbers go to results/on-model.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path
from statistics import median

import jax
import tyro

from jaxouter import cli
from jaxouter.api.learning import configured
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.policies import NamedPolicy, evaluate_on
from jaxouter.loop.environment import EnvParams
from jaxouter.training.choice import choose
from jaxouter.training.environments import TrainState
from jaxouter.training.pretraining import model_of, recorded
from jaxouter.training.trainer import Trainer, build

HERE = Path(__file__).parent
LOOPS = {"pitch": "pitch", "tanks": f"{HERE.parent}/scripts/examples/tanks.py:Tanks"}
FAMILIES = ("steps", "staircase", "ramps")


def on_model(trainer: Trainer, params: EnvParams, seed: int) -> tuple[Trainer, EnvParams]:
    """The trainer whose rounds run on the model of a record, and the parameters of that."""
    plant, start, horizon = trainer.env.plant, trainer.config.pretraining, trainer.config.pairs.horizon
    data = recorded(start, plant, params.plant, jax.random.key(seed))
    model, found = model_of(start, plant, params.plant, data, trainer.env.observer.history)
    shorter = replace(model, episode_steps=plant.episode_steps - horizon)  # a pair must end within the record
    improvement = trainer.improvement
    improvement = replace(improvement, env=replace(improvement.env, plant=shorter))
    return replace(trainer, improvement=improvement), replace(params, plant=found)


def rounds(trainer: Trainer, params: EnvParams, state: TrainState) -> TrainState:
    """All rounds of pairs."""
    for _ in range(trainer.config.pairs.rounds):
        state, _ = trainer.improve(state, params)
    return state


def learned(plant: str, seed: int) -> Iterator[tuple[str, list[float]]]:
    """MAEs of each way to learn."""

    def measured(trainer: Trainer, params: EnvParams, state: TrainState) -> list[float]:
        state, _ = trainer.check(state, params)
        policy = NamedPolicy("learned", trainer.policy, trainer.policy_params(state), trainer.config.plant)
        on = [scenarios.get(f"{trainer.config.plant}/{family}") for family in FAMILIES]
        return [each.figures.mae or float("nan") for each in evaluate_on(policy, on).values()]

    for name, steps in (("", 0), ("model-based pretraining", 1_500)):
        settings = {"seed": seed, "pretraining": {"gradient_steps": steps}}
        trainer, params = build(choose(configured(plant, "default", None, None, settings)).config)
        begun = jax.device_get(trainer.start(seed, params))
        yield name or "LQ law", measured(trainer, params, begun)
        modelled, of_model = on_model(trainer, params, seed)
        after = f"{name}, then pairs" if name else "pairs"
        yield f"{after} on the model", measured(trainer, params, rounds(modelled, of_model, begun))
        yield f"{after} on the plant", measured(trainer, params, rounds(trainer, params, begun))


def main(loops: tyro.conf.Positional[tuple[str, ...]] = tuple(LOOPS), seeds: int = 3) -> None:
    """The command."""
    lines = ["| loop | learned by | " + " | ".join(FAMILIES) + " |", "|---|---|" + "---|" * len(FAMILIES)]
    for loop in loops:
        found: dict[str, list[list[float]]] = {}
        for seed in range(seeds):
            for name, maes in learned(LOOPS[loop], seed):
                found.setdefault(name, []).append(maes)
                print(loop, seed, name, *(f"{mae:.4g}" for mae in maes), flush=True)
        for name, of_seeds in found.items():
            cells = " | ".join(f"{median(column):.3g}" for column in zip(*of_seeds, strict=True))
            lines.append(f"| {loop} | {name} | {cells} |")
    lines += ["", f"MAE, medians of {seeds} seeds. `python benchmarks/on_model.py`, {date.today().isoformat()}"]
    (HERE / "results" / "on-model.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
