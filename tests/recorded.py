"""Recorded data of known plants, as files."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxouter.identification.recorded_data import RecordedData
from jaxouter.loop.references import telegraph
from jaxouter.plants import Plant, simulate


def recorded(
    plant: Plant, params: Any, rows: int, redraw: float = 0.1, noise: float = 0.0, seed: int = 0
) -> RecordedData:
    """R~ over its whole range, redrawn with a probability at each step; a sensor with noise."""
    r_tilde = telegraph(jax.random.key(seed), rows, *plant.r_tilde_bounds, redraw)
    y = np.asarray(simulate(plant, params, r_tilde, jax.random.key(seed + 1)), np.float64)
    state = plant.init(jax.random.key(0), params)
    y = np.append(float(plant.output(params, state)), y[:-1])
    y = y + noise * np.random.default_rng(seed).standard_normal(rows)
    return RecordedData(plant.control_step * np.arange(rows), np.asarray(r_tilde, np.float64), y)


def write(path: Path, data: RecordedData) -> Path:
    """As CSV."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(data._fields)
        writer.writerows(zip(*data, strict=True))
    return path
