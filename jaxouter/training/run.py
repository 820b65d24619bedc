"""The run folder: config.json, summary.json, figures, and the metrics and checkpoints of each seed."""

from __future__ import annotations

import errno
import json
import os
import platform
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from filelock import FileLock, Timeout

import jaxouter
from jaxouter import agents, plants
from jaxouter.agents import AGENTS, AgentConfig
from jaxouter.loop.environment import EnvParams
from jaxouter.plants import Ranges
from jaxouter.plants.registry import REGISTRATIONS, Maker, add, attribute
from jaxouter.training import checkpoint
from jaxouter.training.config import TrainConfig, from_dict, to_dict
from jaxouter.training.devices import Fleet
from jaxouter.training.environments import TrainState
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from jaxouter.training.pretraining import PretrainingState
from jaxouter.training.trainer import Trainer, build

FORMAT = 4
RUNS = Path("runs")  # default parent of run folders
KEEP = 2  # checkpoints per seed
SAVED = ("checkpoint-*.npz", "pretraining.npz")  # files that a seed can resume from


class RunWarning(UserWarning):
    """A problem with a run folder: a damaged file was replaced by another, or the plant has changed."""


@dataclass(frozen=True)
class RunFolder:
    """A run folder and its configuration."""

    path: Path
    config: TrainConfig

    @classmethod
    def create(cls, config: TrainConfig, out: Path | None) -> RunFolder:
        """Make a new folder; `out` None: runs/PLANT-PRESET-SEED, with -2, -3, ... if that exists.

        Raises:
            ValueError: `out` exists or can't be made.
        """
        base = RUNS / f"{plants.slug(config.plant)}-{config.preset}-{config.seed}"
        candidates = (
            [out] if out is not None else [base, *(base.with_name(f"{base.name}-{i}") for i in range(2, 10_000))]
        )
        for path in candidates:
            made = None
            try:
                if path.exists():
                    continue
                path.parent.mkdir(parents=True, exist_ok=True)
                made = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
                run = cls(made, config)
                write_json(made / "config.json", {"format": FORMAT, "config": to_dict(config)} | surroundings(config))
                for seed in run.seeds:
                    run.seed_folder(seed).mkdir()
                made.chmod(0o755)
                made.rename(path)  # atomic: a folder of this name is always a complete run
            except OSError as error:
                if made is not None:
                    shutil.rmtree(made, ignore_errors=True)
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST):  # another process has made it meanwhile
                    continue
                raise ValueError(f"the folder {path} can't be made: {error.strerror}") from None
            return cls(path, config)
        raise ValueError(f"{candidates[0]} exists; choose another --out, or resume it with --resume {candidates[0]}")

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Open a folder that `create` made.

        Raises:
            ValueError: it is not a run, or of another format.
        """
        config, was = _read(path)
        run = cls(path, config)
        if (name := plants.base(run.config.plant)) not in plants.REGISTRY:
            raise ValueError(
                f"{path} is a run on {name} ({was.get('reference', 'a plant in Python')}); code is never imported "
                "because a run folder names it, so name the plant on the command line, or give plant="
            )
        if name in REGISTRATIONS and was.get("sha256") != REGISTRATIONS[name].sha256:
            message = f"{path}: {REGISTRATIONS[name].reference} has changed since the run was made"
            warnings.warn(message, RunWarning, stacklevel=2)
        return run

    @contextmanager
    def gone_if_nothing_is_learned(self) -> Iterator[None]:
        """Remove the new folder if the block fails before anything is saved in it."""
        try:
            yield
        except BaseException:
            folders = list(map(self.seed_folder, self.seeds))
            if not any(path for folder in folders for name in SAVED for path in folder.glob(name)):
                shutil.rmtree(self.path, ignore_errors=True)
                with suppress(OSError):  # it holds other runs
                    if self.path.parent == RUNS:
                        RUNS.rmdir()
            raise

    def changes(self) -> list[str]:
        """Changes, since the run was made, of versions, device and flags that results depend on."""
        before, now = json.loads((self.path / "config.json").read_text()), surroundings(self.config)
        pairs = []
        for group, values in now.items():
            was = before.get(group)
            known = was if isinstance(was, dict) else {}
            pairs += [(name, known.get(name), value) for name, value in values.items()]
        return [f"{name} was {was} and is {value}" for name, was, value in pairs if was != value]

    @property
    def seeds(self) -> range:
        """Seeds of the run."""
        return range(self.config.seed, self.config.seed + self.config.seeds)

    @property
    def figures(self) -> Path:
        """Folder for figures."""
        return self.path / "figures"

    def seed_folder(self, seed: int) -> Path:
        """Folder of one seed."""
        return self.path / f"seed-{seed}"

    @cached_property
    def trainer(self) -> tuple[Trainer, EnvParams]:
        """The trainer of the configuration and the parameters of its environments."""
        return build(self.config)

    @property
    def drawn(self) -> tuple[str, Ranges, float]:
        """The plant of the training, ranges of its parameters, and the largest standard deviation of sensor noise."""
        noise = self.config.disturbances.noise * self.trainer[0].env.observer.y_scale
        return self.config.plant, self.config.ranges, noise

    @cached_property
    def fleet(self) -> Fleet:
        """The trainer on the configured devices."""
        return Fleet.of(self.config)

    def checkpoints(self, seed: int) -> dict[int, Path]:
        """Checkpoints of a seed by number of epochs, oldest first."""
        paths = sorted(self.seed_folder(seed).glob("checkpoint-*.npz"))
        return {int(path.stem.removeprefix("checkpoint-")): path for path in paths}

    def whole(self, seed: int) -> dict[int, Path]:
        """The undamaged checkpoints of a seed; warns of each damaged one."""
        found = self.checkpoints(seed)
        for epoch, path in list(found.items()):
            try:
                checkpoint.read(path)
            except ValueError as error:
                warnings.warn(f"{error}; it is ignored", RunWarning, stacklevel=2)
                del found[epoch]
        return found

    def common_epoch(self) -> int:
        """The newest epoch of which every seed has an undamaged checkpoint, to resume from; 0: from the start.

        Raises:
            ValueError: there is none, although a seed is past the first epoch.
        """
        kept = {seed: set(self.whole(seed)) for seed in self.seeds}
        common = set.intersection(*kept.values())
        if not common and any(max(self.checkpoints(seed), default=0) > 1 for seed in self.seeds):
            found = "; ".join(f"seed {seed}: {sorted(epochs) or 'none'}" for seed, epochs in kept.items())
            raise ValueError(f"{self.path}: the seeds have no whole checkpoint of the same epoch ({found})")
        return max(common, default=0)

    def save(self, seed: int, epoch: int, state: TrainState) -> None:
        """Save a checkpoint after `epoch` epochs, and remove old ones.

        Raises:
            OSError: it can't be written; the old ones are kept.
        """
        path, rows = self.seed_folder(seed) / f"checkpoint-{epoch:06d}.npz", self.seed_folder(seed) / "metrics.jsonl"
        if rows.exists():
            with rows.open("rb+") as file:
                os.fsync(file.fileno())  # rows must reach the disk before the checkpoint that follows them
        checkpoint.save(path, state, seed=seed, epoch=epoch)
        for old in list(self.checkpoints(seed).values())[:-KEEP]:
            old.unlink()

    def load(self, seed: int, epoch: int | None = None) -> tuple[TrainState, int]:
        """State and number of epochs of a checkpoint; `epoch` None: the newest undamaged one.

        Raises:
            ValueError: there is none, or it is not readable.
        """
        paths = self.checkpoints(seed)
        if not paths:
            raise ValueError(f"{self.seed_folder(seed)} has no checkpoint yet")
        if epoch is None:
            epoch = max(self.whole(seed) or paths)
        trainer, params = self.trainer
        like = jax.eval_shape(trainer.fresh, jax.random.key(0), params)
        state, header = checkpoint.load(paths[epoch], like)
        return state, header["epoch"]

    def policy(self, seed: int) -> tuple[LearnedPolicy, LearnedParams]:
        """The policy of a seed, without exploration, from its newest undamaged checkpoint.

        Raises:
            ValueError: there is none, or it is not readable.
        """
        trainer, _ = self.trainer
        return trainer.policy.trimmed(trainer.policy_params(self.load(seed)[0]))

    def save_pretraining(self, seed: int, at: PretrainingState) -> None:
        """Save the state of a seed's pretraining, until there is a checkpoint.

        Raises:
            OSError: it can't be written; the previous one is kept.
        """
        checkpoint.save(self._pretraining(seed), at, seed=seed)

    def load_pretraining(self, seed: int) -> PretrainingState | None:
        """The saved state of a seed's pretraining; None: there is none. Warns if it is damaged."""
        path = self._pretraining(seed)
        if not path.exists():
            return None
        trainer, _ = self.trainer
        try:
            actor = jax.eval_shape(trainer.policy.init_actor, jax.random.key(0))
            return checkpoint.load(path, jax.eval_shape(PretrainingState.begin, actor))[0]
        except ValueError as error:
            warnings.warn(f"{error}; the pretraining starts over", RunWarning, stacklevel=2)
            return None

    def forget_pretraining(self) -> None:
        """Delete the saved states of the pretraining."""
        for seed in self.seeds:
            self._pretraining(seed).unlink(missing_ok=True)

    def _pretraining(self, seed: int) -> Path:
        return self.seed_folder(seed) / "pretraining.npz"

    def median_seed(self) -> int:
        """The seed with the median MAE on the first of the paper's scenarios; without a summary, the first seed."""
        path = self.path / "summary.json"
        if not path.exists():
            return self.config.seed
        try:
            return self.seeds[self.seeds.index(json.loads(path.read_text())["median_seed"])]
        except (ValueError, KeyError, TypeError, RecursionError):
            seeds = ", ".join(map(str, self.seeds))
            raise ValueError(f"{path} is damaged: it names no median seed of {seeds}") from None

    def verdict(self) -> dict[str, Any]:
        """The verdict on the learned policies in summary.json; empty if there is none."""
        try:
            found = json.loads((self.path / "summary.json").read_text())["verdict"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def rows(self, seed: int) -> list[dict[str, Any]]:
        """Rows of metrics.jsonl, one per epoch; an incomplete last line is ignored.

        Raises:
            ValueError: another line is not readable.
        """
        path = self.seed_folder(seed) / "metrics.jsonl"
        lines = path.read_text().split("\n")[:-1] if path.exists() else []
        try:
            rows = [json.loads(line) for line in lines]
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is damaged: {error}") from None
        if not all(isinstance(row, dict) and {"epoch", "steps", "seconds"} <= set(row) for row in rows):
            raise ValueError(f"{path} is damaged: a row has no epoch, steps or seconds")
        return rows

    def append(self, seed: int, row: dict[str, Any]) -> None:
        """Append a row."""
        with (self.seed_folder(seed) / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")

    def forget(self, seed: int, epoch: int) -> None:
        """Delete rows and checkpoints after `epoch`; these epochs will run again."""
        for later, path in self.checkpoints(seed).items():
            if later > epoch:
                path.unlink()
        for partial in self.seed_folder(seed).glob("*.partial"):  # left when a run was killed
            partial.unlink()
        rows = [json.dumps(row) + "\n" for row in self.rows(seed) if row["epoch"] <= epoch]
        checkpoint.write(self.seed_folder(seed) / "metrics.jsonl", "".join(rows).encode())


@contextmanager
def lock(path: Path) -> Iterator[None]:
    """Lock the folder for this process, until the block or the process ends.

    Raises:
        ValueError: another process has locked it.
    """
    holder, lock = path / "process", FileLock(path / "lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        number = holder.read_text().strip() if holder.exists() else "?"
        raise ValueError(f"{path} is in use by process {number}; wait until it ends, or stop it") from None
    except OSError as error:
        raise ValueError(f"{path} can't be locked: {error.strerror}") from None
    with suppress(OSError):  # on a full disk, do without the process number
        holder.write_text(str(os.getpid()))
    try:
        yield
    finally:
        lock.release()


def _read(path: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """The configuration of a run, and the origin of its plant.

    Raises:
        ValueError: the folder is not a run, or of another format.
    """
    try:
        content = json.loads((path / "config.json").read_text())
    except (OSError, ValueError, RecursionError):
        raise ValueError(f"{path} is not a run folder: it has no readable config.json") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(_of_other_format(path, content))
    try:
        config = from_dict(content["config"])
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path}/config.json is not a configuration: {error}") from None
    plant = content.get("plant")
    return config, plant if isinstance(plant, dict) else {}


def _of_other_format(path: Path, content: Any) -> str:
    """Why a run of another format is not read, and which version reads it."""
    found, versions = (content.get(name) if isinstance(content, dict) else None for name in ("format", "versions"))
    by = versions.get("jaxouter") if isinstance(versions, dict) else None
    made = f"jaxouter {by} made it, and reads it" if isinstance(by, str) else "another version of jaxouter made it"
    return f"{path}/config.json is of format {found}, and this version reads format {FORMAT}: {made}"


def add_plant(reference: str | Maker, path: Path | None) -> str:
    """Register the plant that a command line names, with the options of the run in a folder; returns its short name.

    Raises:
        ValueError: there is no such plant, or the folder is not a run.
    """
    if path is None or not isinstance(reference, str):
        return add(reference)
    folder = path if (path / "config.json").exists() else path.resolve().parent
    return add(reference, _read(folder)[0].plant_options)


def add_agent(reference: str | None) -> str | None:
    """Register the agent that a command line names, if any, and return its name: a registered one, or FILE.py:CLASS.

    The class is the agent's settings, see `jaxouter.agents.AgentConfig`.

    Raises:
        ValueError: there is no such agent.
    """
    if reference is None:
        return None
    file, colon, name = reference.rpartition(":")
    if colon and file.endswith(".py") and reference not in AGENTS:
        kind = attribute(Path(file), name, "an agent of your own")
        if isinstance(kind, type) and (missing := getattr(kind, "__abstractmethods__", ())):
            raise ValueError(f"{reference} does not define {', '.join(sorted(missing))}")
        if not (isinstance(kind, type) and issubclass(kind, AgentConfig)):
            raise ValueError(f"{reference} is {kind!r}; it must be a subclass of jaxouter.agents.AgentConfig")
        AGENTS[reference] = kind
    agents.resolve(reference)
    return reference


def own_agents() -> tuple[str, ...]:
    """References of agents given as FILE.py:CLASS."""
    return tuple(name for name in AGENTS if ".py:" in name)


def open_run(path: Path) -> tuple[RunFolder, int, tuple[int, ...]]:
    """The run in a folder, its median seed and all its seeds; for the folder of one seed, only that seed.

    Raises:
        ValueError: the folder is not a run.
    """
    name = path.resolve().name
    if name.startswith("seed-") and not (path / "config.json").exists():
        run = RunFolder.open(path.resolve().parent)
        seed = next((seed for seed in run.seeds if run.seed_folder(seed).name == name), None)
        if seed is None:
            raise ValueError(f"{path} is not a seed of its run, which has: {', '.join(map(str, run.seeds))}")
        return run, seed, (seed,)
    run = RunFolder.open(path)
    return run, run.median_seed(), tuple(run.seeds)


def surroundings(config: TrainConfig | None = None) -> dict[str, Any]:
    """What results depend on besides the configuration; given one, also the origin of its plant if not built in."""
    packages = ("jax", "jaxlib", "flax", "optax", "numpy")
    device = jax.devices()[0]
    registered = None if config is None else REGISTRATIONS.get(plants.base(config.plant))
    return {
        "versions": {"jaxouter": jaxouter.__version__, "python": platform.python_version()}
        | {name: version(name) for name in packages},
        "device": {"kind": device.device_kind, "platform": device.platform, "count": jax.device_count()},
        "flags": {"XLA_FLAGS": os.environ.get("XLA_FLAGS", ""), "x64": bool(jax.config.read("jax_enable_x64"))},
    } | ({} if registered is None else {"plant": {"reference": registered.reference, "sha256": registered.sha256}})


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically.

    Raises:
        OSError: it can't be written; `path` is unchanged.
    """
    checkpoint.write(path, (json.dumps(content, indent=2) + "\n").encode())
