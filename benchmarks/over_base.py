"""What rounds of pairs add to what they start from, and whether that is ever worse: 20 seeds of `default` on six loops.

    python benchmarks/over_base.py                    # an hour
    python benchmarks/over_base.py pitch --seeds 5    # one loop

They start from what the same training gives without them: base law or pretrained policy. MAEs are those
of scenarios that training never sees. The return is that of the reward that is trained on, on 512 fresh training
episodes that all policies of a seed share. Table and numbers go to results/.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxouter
from jaxouter import cli
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.policies import NamedPolicy, baseline, evaluate_on
from jaxouter.training.gate import reward_of
from jaxouter.training.policy import LearnedParams
from jaxouter.training.run import RunFolder, surroundings, write_json
from jaxouter.training.trainer import Trainer

HERE = Path(__file__).parent
RESULTS = HERE / "results"
FAMILIES = ("steps", "staircase", "ramps")
LOOPS: Mapping[str, tuple[str, Sequence[str]]] = {
    "pitch": ("pitch", ("paper", *FAMILIES, "load")),
    "heaters": ("heaters", ("paper-4", "paper-1000", "cold", "riccati", "load", *FAMILIES)),
    "tanks": (f"{HERE.parent}/scripts/examples/tanks.py:Tanks", FAMILIES),
    "dead-band": (f"{HERE}/loops.py:DeadBand", FAMILIES),
    "saturating": (f"{HERE}/loops.py:Saturating", FAMILIES),
    "rate-limited": (f"{HERE}/loops.py:RateLimited", FAMILIES),
}
EPISODES = 512
FRESH = 1_000_003  # of the key of these episodes


@partial(jax.jit, static_argnums=0)
def returns(trainer: Trainer, params: Any, base: Any, actors: Any, key: jax.Array) -> jax.Array:
    """Mean reward per step of each actor (C, ...) on fresh training episodes; (C,)."""
    env, policy = trainer.improvement.env, trainer.policy
    each = jax.vmap(lambda actor, key: reward_of(env, policy, actor, base, params, key)[0], (None, 0))
    return jnp.mean(jax.vmap(each, (0, None))(actors, jax.random.split(key, EPISODES)), 1)


def policies(folder: RunFolder, before: RunFolder | None) -> Iterator[tuple[LearnedParams, LearnedParams]]:
    """What each seed starts from, and what it learned."""
    for seed in folder.seeds:
        learned = folder.policy(seed)[1]
        nothing = jax.tree.map(np.zeros_like, learned.actor)
        yield (learned._replace(actor=nothing) if before is None else before.policy(seed)[1]), learned


def measured(name: str, seeds: int, out: Path) -> dict[str, Any]:
    """MAEs and returns of a loop, by seed."""
    plant, names = LOOPS[name]
    run = RunFolder.open(jaxouter.learn(plant, out=out / "run", progress=False, seeds=seeds).path)
    before = None
    if run.config.pretraining.gradient_steps:
        fewer: dict[str, Any] = {"pairs": {"rounds": 0}, "compared": 0}
        before = RunFolder.open(jaxouter.learn(plant, out=out / "before", progress=False, seeds=seeds, **fewer).path)
    on = [scenarios.get(f"{run.config.plant}/{each}") for each in names]
    trainer, params = run.trainer
    found: dict[str, Any] = {"static": [], "lq": [], "before": [], "default": [], "gain": []}

    def maes(named: NamedPolicy) -> list[float]:
        return [each.figures.mae or float("nan") for each in evaluate_on(named, on).values()]

    for each in ("static", "lq"):
        found[each].append(maes(baseline(each, run.config.plant)))
    for seed, both in zip(run.seeds, policies(run, before), strict=True):
        for which, one in zip(("before", "default"), both, strict=True):
            found[which].append(maes(NamedPolicy(which, trainer.policy, one, run.config.plant)))
        actors = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(one.actor for one in both))
        key = jax.random.fold_in(jax.random.key(FRESH), seed)
        old, new = np.asarray(returns(trainer, params, both[1].base, actors, key)).tolist()
        found["gain"].append((new - old) / abs(old))
    return found | {"scenarios": names}


def table(name: str, found: Mapping[str, Any]) -> Iterator[str]:
    """Rows of a loop."""
    for i, scenario in enumerate(found["scenarios"]):
        static, lq = (found[each][0][i] for each in ("static", "lq"))
        before, after = (median(each[i] for each in found[which]) for which in ("before", "default"))
        cells = " | ".join(f"{each:.3g}" for each in (static, lq, before, after))
        yield f"| {name} | {scenario} | {cells} | {100 * (after / before - 1):+.1f} % |"


def written(known: Mapping[str, Any]) -> str:
    """Both tables."""
    lines = [
        "| loop | scenario | `static` | `lq` | before pairs | `default` | pairs |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [row for name, found in known.items() for row in table(name, found)]
    lines += ["", "Gain by pairs in return on fresh training episodes, in percent:", ""]
    lines += ["| loop | seeds | least | median | greatest | date |", "|---|---|---|---|---|---|"]
    for name, found in known.items():
        gains = [100 * each for each in found["gain"]]
        numbers = f"{min(gains):+.2f} | {median(gains):+.2f} | {max(gains):+.2f}"
        lines.append(f"| {name} | {len(gains)} | {numbers} | {found['date']} |")
    return "\n".join([*lines, "", "`python benchmarks/over_base.py`; MAE: medians over the seeds."])


def main(loops: tyro.conf.Positional[tuple[str, ...]] = tuple(LOOPS), seeds: int = 20) -> None:
    """The command.

    Args:
        loops: which of them; results of the others stay as they are.
        seeds: from 0 on.
    """
    path = RESULTS / "over-base.json"
    known = json.loads(path.read_text())["loops"] if path.exists() else {}
    for name in loops:
        with tempfile.TemporaryDirectory() as folder:
            known[name] = measured(name, seeds, Path(folder)) | {"date": date.today().isoformat()}
        write_json(path, {"machine": surroundings(), "loops": known})
        text = written(known)
        (RESULTS / "over-base.md").write_text(text + "\n")
        print(text, flush=True)


if __name__ == "__main__":
    cli.run(lambda: tyro.cli(main, description=__doc__))
