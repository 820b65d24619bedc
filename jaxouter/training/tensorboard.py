"""Rows of metrics.jsonl as TensorBoard events (extra `tensorboard`)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from jaxouter.training.run import RunFolder


def require() -> None:
    """Raises ValueError if tensorboardX is not installed."""
    try:
        import tensorboardX  # noqa: F401
    except ImportError:
        raise ValueError('--tensorboard needs tensorboardX: pip install "jaxouter[tensorboard]"') from None


class Events:
    """Writes the rows of a run to the folder of their seed. No background thread, whose errors would be lost."""

    def __init__(self, run: RunFolder) -> None:
        self._run, self._writers = run, {}

    def __call__(self, seed: int, row: Mapping[str, Any]) -> None:
        """Write a row, at its environment steps. The first call rewrites all rows of the run, so that none is double.

        Raises:
            OSError: it can't be written.
        """
        from tensorboardX.event_file_writer import EventsWriter

        if self._writers:
            return self._write(seed, row)
        for each in self._run.seeds:
            folder = self._run.seed_folder(each)
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
            self._writers[each] = EventsWriter(str(folder / "events"))
            for known in self._run.rows(each):
                self._write(each, known)

    def _write(self, seed: int, row: Mapping[str, Any]) -> None:
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboardX.summary import scalar

        for name, value in row.items():
            event = Event(wall_time=time.time(), step=row["steps"], summary=scalar(name, value))
            self._writers[seed].write_event(event)
        self._writers[seed].flush()

    def close(self) -> None:
        """Close the files."""
        for writer in self._writers.values():
            writer.close()
