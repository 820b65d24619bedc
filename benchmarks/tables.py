"""Tables of results, and where they were made."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (columns, ["---"] * len(columns), *rows))


def machine() -> dict[str, Any]:
    """What the figures depend on beside the code."""
    info = Path("/proc/cpuinfo")
    models = (
        [line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        if info.exists()
        else []
    )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    names = ("jax", "jaxlib", "numpy", "jaxouter")
    return {
        "cpu": models[0] if models else platform.processor() or platform.machine(),
        "cores": cores,
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: version(name) for name in names},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "load_before": round(os.getloadavg()[0], 2),
        "date": date.today().isoformat(),
    }


def made(command: str) -> str:
    """Machine, date and command in a sentence."""
    on = machine()
    versions = ", ".join(f"{name} {on[name]}" for name in ("jax", "python"))
    return f"Made on {on['date']} on {on['cores']} cores of {on['cpu']} ({versions}) by `{command}`."
