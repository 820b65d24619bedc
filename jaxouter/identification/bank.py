"""A bank of base laws for many plants: each is identified from records of its own, some of them in closed loop.

Episodes under random r~ give a first model and its LQ law. Under this law and a dither more episodes are recorded, in
two rounds. The pretraining of one actor for all of these plants replays the episodes (`counterfactual`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter import plants
from jaxouter.identification import lq, unstable
from jaxouter.identification.counterfactual import CounterfactualParams
from jaxouter.identification.linear_models import impulse_response
from jaxouter.identification.records import Record, record, within
from jaxouter.loop import bank
from jaxouter.loop.bank import BaseLaw
from jaxouter.loop.policy import LinearLaw
from jaxouter.plants import Plant, Ranges
from jaxouter.plants.arx import Model

Member = tuple[float, tuple[tuple[str, float], ...]]
"""A plant that a bank has a law for: the price of moves in it, see `lq.PRICES`, and the plant's numbers by name."""


class Basis(NamedTuple):
    """Base law, and models to pretrain an actor on."""

    base: BaseLaw
    params: CounterfactualParams  # of their models, on which each episode replays a recorded start


class _Law(NamedTuple):
    """What the records of one plant gave."""

    law: LinearLaw
    model: Model
    replayed: Record


def ranges(params: Any, members: Sequence[Member]) -> Ranges:
    """Least and greatest value of each number that differs between the members and the nominal plant.

    Raises:
        ValueError: a name is not a number of the plant; lists those.
    """
    known = plants.numbers(params)
    found: dict[str, list[float]] = {}
    for _, numbers in members:
        for name, value in numbers:
            if name not in known:
                raise ValueError(f"a plant of the bank sets {name!r}; the numbers are: {', '.join(sorted(known))}")
            leaf, element = known[name]
            nominal = float(jax.tree.leaves(params)[leaf][element])
            found.setdefault(name, [nominal]).append(value)
    return tuple((name, min(values), max(values)) for name, values in found.items())


def drawing(plant: Plant, params: Any, members: Sequence[Member]) -> tuple[Plant, Any]:
    """The plant that draws one of the members for each episode, and its parameters; arguments as for `identify`."""
    each = [plants.with_numbers(_widened(plant, params, members), dict(numbers)) for _, numbers in members]

    def draw(key: chex.PRNGKey, params: Any) -> Any:
        i = jax.random.randint(key, (), 0, len(members))
        return jax.tree.map(lambda leaf: leaf[i], params)

    return replace(plant, draw=draw), jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def _widened(plant: Plant, params: Any, members: Sequence[Member]) -> Any:
    """The parameters of a plant that can take those of all members."""
    return plant.widened(params, {name: (low, high) for name, low, high in ranges(params, members)})


def identify(
    plant: Plant,
    params: Any,
    members: Sequence[Member],
    key: chex.PRNGKey,
    lags: int,
    episodes: int,
    closed_loop: int,
    say: Callable[[int], None] = lambda done: None,
) -> Basis:
    """Laws and models of all members.

    Args:
        plant: with episodes as long as those to record.
        params: nominal ones, of which the members change some.
        members: see `Member`; the law of the first acts at first.
        key: of the records.
        lags: of each model and law.
        episodes: to record under random r~, of each member.
        closed_loop: to record in closed loop, likewise.
        say: hears how many members are done.

    Raises:
        ValueError: a name is not a number of the plant, or no recorded start of a member can be brought back.
    """
    params = _widened(plant, params, members)
    found = []
    for i, (price, numbers) in enumerate(members):
        say(i)
        one = plants.with_numbers(params, dict(numbers))
        of_member = _law(plant, one, price, jax.random.fold_in(key, i), lags, episodes, closed_loop)
        if not len(of_member.replayed.y):
            raise ValueError(
                f"{plant.name}: r~ within {plant.r_tilde_bounds} brings back none of the {episodes} recorded starts "
                f"of a plant of the bank: {', '.join(f'{name} {value:g}' for name, value in numbers)}"
            )
        found.append(of_member)
    a, b = (np.stack([getattr(each.model, name) for each in found]) for name in ("a", "b"))
    kept = [len(each.replayed.y) for each in found]
    counts = [round(math.sqrt(n * max(kept))) for n in kept]  # episodes are repeated where few can be brought back
    repeated = [[np.resize(x, (n, x.shape[1])) for x in each.replayed] for n, each in zip(counts, found, strict=True)]
    r_tilde, y = map(np.concatenate, zip(*repeated, strict=True))
    known = (np.repeat(a, counts, 0), np.repeat(b, counts, 0), r_tilde, y, y)
    half = float(np.ptp(plant.setpoint_range)) / 2
    made = bank.of([each.law for each in found], a, b, half)
    return Basis(made, CounterfactualParams(*(jnp.asarray(each, float) for each in known)))


def _law(
    plant: Plant, params: Any, price: float, key: chex.PRNGKey, lags: int, episodes: int, closed_loop: int
) -> _Law:
    """Law, model and episodes of one member."""
    key_open, *keys = jax.random.split(key, 1 + unstable.ROUNDS)
    known = within(record(plant, params, key_open, episodes), plant.divergence_bounds, 0.0)
    for i, key_run in enumerate(keys):
        law, _ = _of(plant, known, price, lags)
        ran = (closed_loop + i) // unstable.ROUNDS
        known = unstable.joined(known, unstable.in_closed_loop(plant, params, law, key_run, ran))
    law, model = _of(plant, known, price, lags)
    if np.isfinite(known.y).all():
        return _Law(law, model, known)
    replayed = unstable.continued(plant, known, model)
    alive = unstable.can_be_brought_back(plant, replayed, impulse_response(model, plant.episode_steps))
    return _Law(law, model, Record(*(each[alive] for each in replayed)))


def _of(plant: Plant, data: Record, price: float, lags: int) -> tuple[LinearLaw, Model]:
    """LQ law and model of a record."""
    model = unstable.fit(plant, data, lags)
    return lq.law_for(plant, model.a, model.b, price), model
