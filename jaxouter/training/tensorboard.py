"""Rows of metrics.jsonl as TensorBoard events (extra `tensorboard`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxouter.training.run import Run


def require() -> Any:
    """The writer's class.

    Raises:
        ValueError: tensorboardX is not installed.
    """
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise ValueError('--tensorboard needs tensorboardX: pip install "jaxouter[tensorboard]"') from None
    return SummaryWriter


class Events:
    """Writes each row of a run as it comes, into the folder of its seed."""

    def __init__(self, run: Run) -> None:
        self._run, self._writers = run, {}

    def __call__(self, seed: int, row: Mapping[str, Any]) -> None:
        """One row, over its environment steps; with the first one all that the run has, so that none is there twice."""
        if self._writers:
            return self._write(seed, row)
        for each in self._run.seeds:
            folder = self._run.seed_folder(each)
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
            self._writers[each] = require()(str(folder), flush_secs=5)
            for known in self._run.rows(each):
                self._write(each, known)

    def _write(self, seed: int, row: Mapping[str, Any]) -> None:
        for name, value in row.items():
            self._writers[seed].add_scalar(name, value, row["steps"])

    def close(self) -> None:
        """Write what is left."""
        for writer in self._writers.values():
            writer.close()
