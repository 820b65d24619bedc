"""The run folder: config.json, summary.json, figures, and for each seed its metrics and checkpoints."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

import jaxouter
from jaxouter.loop.environment import EnvParams
from jaxouter.plants import Ranges
from jaxouter.training import checkpoint
from jaxouter.training.config import TrainConfig, from_dict, to_dict
from jaxouter.training.devices import Fleet
from jaxouter.training.trainer import Trainer, TrainState, build

FORMAT = 1
KEEP = 2  # checkpoints of each seed


@dataclass(frozen=True)
class Run:
    """A folder and the configuration in it."""

    path: Path
    config: TrainConfig

    @classmethod
    def create(cls, config: TrainConfig, out: Path | None) -> Run:
        """A new folder; `out` None: runs/PLANT-PRESET-SEED, with -2, -3, ... where that exists.

        Raises:
            ValueError: `out` exists or can't be made.
        """
        base = Path("runs") / f"{config.plant}-{config.preset}-{config.seed}"
        candidates = (
            [out] if out is not None else [base, *(base.with_name(f"{base.name}-{i}") for i in range(2, 10_000))]
        )
        for path in candidates:
            try:
                path.mkdir(parents=True)
            except FileExistsError:
                continue
            except OSError as error:
                raise ValueError(f"the folder {path} can't be made: {error.strerror}") from None
            run = cls(path, config)
            write_json(path / "config.json", {"format": FORMAT, "config": to_dict(config)} | surroundings())
            for seed in run.seeds:
                run.seed_folder(seed).mkdir()
            return run
        raise ValueError(f"{candidates[0]} exists; choose another --out, or go on with it by --resume {candidates[0]}")

    @classmethod
    def open(cls, path: Path) -> Run:
        """The run in a folder that `create` made.

        Raises:
            ValueError: it is no run, or one of another format.
        """
        try:
            content = json.loads((path / "config.json").read_text())
        except (OSError, ValueError):
            raise ValueError(f"{path} is not a run folder: it has no readable config.json") from None
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"{path}/config.json is not of format {FORMAT}, the one that this version reads")
        try:
            return cls(path, from_dict(content["config"]))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"{path}/config.json is not a configuration: {error}") from None

    @property
    def seeds(self) -> range:
        """Seeds of the run."""
        return range(self.config.seed, self.config.seed + self.config.seeds)

    @property
    def figures(self) -> Path:
        """Where the pictures go."""
        return self.path / "figures"

    def seed_folder(self, seed: int) -> Path:
        """Folder of one seed."""
        return self.path / f"seed-{seed}"

    @cached_property
    def trainer(self) -> tuple[Trainer, EnvParams]:
        """The trainer of the configuration and the parameters of its environments."""
        return build(self.config)

    @property
    def drawn(self) -> tuple[Ranges, float]:
        """The numbers of the plant that training drew, and the largest standard deviation of its measurement noise."""
        return self.config.randomise, self.config.pretraining.noise * self.trainer[0].env.observer.y_scale

    @cached_property
    def fleet(self) -> Fleet:
        """The trainer over the devices of the configuration."""
        return Fleet.of(self.config)

    def checkpoints(self, seed: int) -> dict[int, Path]:
        """Checkpoints of a seed by the number of epochs, oldest first."""
        paths = sorted(self.seed_folder(seed).glob("checkpoint-*.npz"))
        return {int(path.stem.removeprefix("checkpoint-")): path for path in paths}

    def common_epoch(self) -> int:
        """The newest epoch of which every seed has a checkpoint, where all go on together; 0 at the beginning.

        Raises:
            ValueError: there is none, although some seed is further than the first epoch.
        """
        kept = {seed: set(self.checkpoints(seed)) for seed in self.seeds}
        common = set.intersection(*kept.values())
        if not common and any(max(epochs, default=0) > 1 for epochs in kept.values()):
            found = "; ".join(f"seed {seed}: {sorted(epochs) or 'none'}" for seed, epochs in kept.items())
            raise ValueError(f"{self.path}: the seeds have no checkpoint of the same epoch ({found})")
        return max(common, default=0)

    def save(self, seed: int, epoch: int, state: TrainState) -> None:
        """Checkpoint after so many epochs; old ones are removed."""
        path = self.seed_folder(seed) / f"checkpoint-{epoch:06d}.npz"
        checkpoint.save(path, state, seed=seed, epoch=epoch)
        for old in list(self.checkpoints(seed).values())[:-KEEP]:
            old.unlink()

    def load(self, seed: int, epoch: int | None = None) -> tuple[TrainState, int]:
        """State and number of epochs of the checkpoint after so many epochs; None: the newest.

        Raises:
            ValueError: there is none, or it is not readable.
        """
        paths = self.checkpoints(seed)
        if not paths:
            raise ValueError(f"{self.seed_folder(seed)} has no checkpoint yet")
        trainer, params = self.trainer
        like = jax.eval_shape(trainer.fresh, jax.random.key(0), params)
        state, header = checkpoint.load(paths[max(paths) if epoch is None else epoch], like)
        return state, header["epoch"]

    def median_seed(self) -> int:
        """The seed with the median MAE on the first of the paper's scenarios; before there is a summary the first."""
        path = self.path / "summary.json"
        return json.loads(path.read_text())["median_seed"] if path.exists() else self.config.seed

    def rows(self, seed: int) -> list[dict[str, Any]]:
        """Rows of metrics.jsonl, one an epoch."""
        path = self.seed_folder(seed) / "metrics.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def append(self, seed: int, row: dict[str, Any]) -> None:
        """One row more."""
        with (self.seed_folder(seed) / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")

    def forget(self, seed: int, epoch: int) -> None:
        """Drop rows and checkpoints after so many epochs: those of epochs that will run again."""
        for later, path in self.checkpoints(seed).items():
            if later > epoch:
                path.unlink()
        rows = [json.dumps(row) + "\n" for row in self.rows(seed) if row["epoch"] <= epoch]
        path = self.seed_folder(seed) / "metrics.jsonl"
        partial = path.with_suffix(".partial")
        partial.write_text("".join(rows))
        partial.replace(path)


def open_run(path: Path) -> tuple[Run, int, tuple[int, ...]]:
    """The run in a folder, its median seed and all its seeds; of the folder of one seed that one alone.

    Raises:
        ValueError: the folder is no run.
    """
    name = path.resolve().name
    if name.startswith("seed-") and not (path / "config.json").exists():
        run = Run.open(path.resolve().parent)
        seed = next((seed for seed in run.seeds if run.seed_folder(seed).name == name), None)
        if seed is None:
            raise ValueError(f"{path} is not a seed of its run, which has: {', '.join(map(str, run.seeds))}")
        return run, seed, (seed,)
    run = Run.open(path)
    return run, run.median_seed(), tuple(run.seeds)


def surroundings() -> dict[str, Any]:
    """What a result depends on beside the configuration."""
    packages = ("jax", "jaxlib", "flax", "optax", "numpy")
    device = jax.devices()[0]
    return {
        "versions": {"jaxouter": jaxouter.__version__, "python": platform.python_version()}
        | {name: version(name) for name in packages},
        "device": {"kind": device.device_kind, "platform": device.platform, "count": jax.device_count()},
        "flags": {"XLA_FLAGS": os.environ.get("XLA_FLAGS", ""), "x64": bool(jax.config.read("jax_enable_x64"))},
    }


def write_json(path: Path, content: Any) -> None:
    """Write JSON, whole or not at all."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    partial.replace(path)
