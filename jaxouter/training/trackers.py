"""Rows of metrics.jsonl in other tools too: TensorBoard, Weights & Biases (extras `tensorboard` and `wandb`)."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Any, Protocol

from jaxouter.training.config import to_dict
from jaxouter.training.run import RunFolder

MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb"}  # what each needs
PROJECT = "jaxouter"  # of Weights & Biases


def require(names: Sequence[str]) -> None:
    """Raises ValueError if a tracker's package is not installed."""
    for name in names:
        if find_spec(MODULES[name]) is None:
            raise ValueError(f'--{name} needs {MODULES[name]}: pip install "jaxouter[{name}]"')


class Tracker(Protocol):
    """Takes the rows of one seed."""

    def write(self, row: Mapping[str, Any]) -> None:
        """Take a row, at its environment steps.

        Raises:
            OSError: it can't be written.
        """
        ...

    def close(self) -> None:
        """No more rows follow."""
        ...


class TensorBoard:
    """Events in the folder of the seed. No background thread, whose errors would be lost."""

    def __init__(self, run: RunFolder, seed: int) -> None:
        from tensorboardX.event_file_writer import EventsWriter

        folder = run.seed_folder(seed)
        for old in folder.glob("events.out.tfevents.*"):
            old.unlink()
        self._writer = EventsWriter(str(folder / "events"))

    def write(self, row: Mapping[str, Any]) -> None:
        """Write an event for each number."""
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboardX.summary import scalar

        for name, value in row.items():
            event = Event(wall_time=time.time(), step=row["steps"], summary=scalar(name, value))
            self._writer.write_event(event)
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


class WeightsAndBiases:
    """A run of the project `jaxouter`, in the run folder; sent nowhere unless WANDB_MODE or WANDB_API_KEY is set."""

    def __init__(self, run: RunFolder, seed: int) -> None:
        import wandb  # pyright: ignore[reportMissingImports]

        name = run.path.resolve().name
        mode: Any = os.environ.get("WANDB_MODE", "online" if "WANDB_API_KEY" in os.environ else "offline")
        self._run = wandb.init(
            project=PROJECT,
            group=name,
            name=f"{name}, seed {seed}",
            config=to_dict(run.config),
            dir=run.path,
            mode=mode,
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
        self._run.define_metric("*", step_metric="steps")

    def write(self, row: Mapping[str, Any]) -> None:
        """Log the row."""
        self._run.log(dict(row))

    def close(self) -> None:
        """Wait until all is written or sent."""
        self._run.finish()


TRACKERS: dict[str, type[TensorBoard] | type[WeightsAndBiases]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
}


class Trackers:
    """The trackers of a run, one of each name for each seed. They begin with the first row."""

    def __init__(self, run: RunFolder, names: Sequence[str]) -> None:
        self._run, self._names = run, names
        self._of_seeds: dict[int, list[Tracker]] = {}

    def __call__(self, seed: int, row: Mapping[str, Any]) -> None:
        """Write a row. The first call writes all rows of the run anew, so that none is double.

        Raises:
            OSError: it can't be written.
        """
        if not self._names:
            return
        if not self._of_seeds:
            for each in self._run.seeds:
                self._of_seeds[each] = [TRACKERS[name](self._run, each) for name in self._names]
                for known in self._run.rows(each):
                    self._write(each, known)
        else:
            self._write(seed, row)

    def _write(self, seed: int, row: Mapping[str, Any]) -> None:
        for tracker in self._of_seeds[seed]:
            tracker.write(row)

    def close(self) -> None:
        """Close all."""
        for of_seed in self._of_seeds.values():
            for tracker in of_seed:
                tracker.close()
