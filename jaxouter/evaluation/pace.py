"""How long episodes of a plant outside JAX take, and how many of them a given time allows."""

from __future__ import annotations

import math
from collections.abc import Iterable

from jaxouter.evaluation import scenarios
from jaxouter.evaluation.scenarios import FAMILY_MEMBERS
from jaxouter.plants import Plant, host, make

SAID = 10.0  # s, of an evaluation; how long it takes is printed from there on


def seconds(identifiers: Iterable[str], episodes: int | None, rollouts: int = 1) -> float:
    """About how long the simulators run.

    Args:
        identifiers: of the scenarios; those of plants in JAX count for nothing.
        episodes: of each scenario; None: its own number.
        rollouts: how often each is run.
    """
    total = 0.0
    for identifier in identifiers:
        each = host.step_seconds(_plant(identifier))
        if each is not None:
            total += each * scenarios.get(identifier, 1).r.shape[1] * (episodes or FAMILY_MEMBERS)
    return rollouts * total


def affordable(identifiers: Iterable[str], rollouts: int, time: float) -> int | None:
    """Episodes of each scenario, at most a family's own number, that take no longer than `time` (s); at least one.

    Rounded down to a power of two, so that machines of similar speed get the same number. None: the plant is JAX, and
    its scenarios have their own numbers.
    """
    names = list(identifiers)
    if host.of(_plant(names[0])) is None:
        return None
    most = time / max(seconds(names, 1, rollouts), 1e-9)
    return min(FAMILY_MEMBERS, 2 ** int(math.log2(max(1.0, most))))


def told(identifiers: Iterable[str], episodes: int | None, rollouts: int) -> str:
    """How long an evaluation is going to take, in a line."""
    names = list(identifiers)
    each = 1e3 * (host.step_seconds(_plant(names[0])) or 0.0)
    many = "1 scenario" if len(names) == 1 else f"{len(names)} scenarios"
    return (
        f"{many} of {episodes or FAMILY_MEMBERS} episodes: about "
        f"{duration(seconds(names, episodes, rollouts))}, at {each:.2g} ms a control step"
    )


def duration(seconds: float) -> str:
    """For people: 40 s, 12 min, 2.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def _plant(identifier: str) -> Plant:
    return make(scenarios.plant_of(identifier))[0]
