"""Tasks: a plant with its presets, scenarios and sweeps. A new task is one file and one line in `TASKS`."""

from __future__ import annotations

import inspect

from jaxouter import plants
from jaxouter.tasks.heaters import HEATERS
from jaxouter.tasks.pitch import PITCH
from jaxouter.tasks.presets import LEARNERS, PRESETS
from jaxouter.tasks.task import Axis, Families, Options, Scenario, Sweep, Task

__all__ = ["TASKS", "Axis", "Families", "Scenario", "Sweep", "Task", "of", "options", "presets"]

TASKS: dict[str, Task] = {"pitch": PITCH, "heaters": HEATERS}


def of(plant: str) -> Task:
    """The task of a plant, whatever parameters its name sets: the declared one, or an empty one around its maker.

    Raises:
        ValueError: there is no such plant; lists the plants.
    """
    maker, name = plants.resolve(plant), plants.base(plant)
    if name in TASKS:
        return TASKS[name]
    declared = inspect.unwrap(maker)
    return declared if isinstance(declared, Task) else Task(maker)


def presets(plant: str) -> list[str]:
    """Names of the plant's presets."""
    return list(dict.fromkeys([*of(plant).presets, *PRESETS]))


def options(plant: str, preset: str, agent: str | None = None) -> Options:
    """The options of a preset, with an agent's own where it is `scratch`.

    Raises:
        ValueError: unknown plant or preset; lists the known ones.
    """
    if preset not in presets(plant):
        raise ValueError(f"there is no preset {preset!r} for {plant}; the presets are: {', '.join(presets(plant))}")
    of_agent = LEARNERS.get(agent or "", {}) if preset == "scratch" else {}
    return {**PRESETS.get(preset, PRESETS["default"]), **of_agent, **of(plant).presets.get(preset, {})}
