"""The evaluation scenarios (spec section 6). None of them is ever trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.loop import sensor as sensors
from jaxouter.loop.references import FAMILIES
from jaxouter.loop.sensor import SensorParams
from jaxouter.plants import Plant, Ranges, make
from jaxouter.plants.pitch import W_PRINTED

FAMILY_SEED = 2024
FAMILY_MEMBERS = 64
NOISE_SEEDS = 32
Builder = Callable[[int | None], "Scenario"]
Place = Literal["inside", "edge", "outside"]
OF_THE_START = ("x0_mean", "x0_spread", "weights")
ROUNDING = 1e-5  # of a number of the plant, by which it may lie outside its range
PITCH_SETPOINT = 14.66  # crad; the amplitude that gives the paper's baseline of 10.91
PITCH_MAX_DELAY = (
    5.7  # s; one length of the delay lines for all scenarios with delays of u, which so share a compilation
)
HEATERS_SETPOINTS = (15.0, 20.0, 17.0, 22.0)  # degC, 50 h each


@dataclass(frozen=True)
class Scenario:
    """Episodes that every policy meets alike."""

    id: str
    plant: Plant
    params: Any  # each leaf (episodes, ...)
    r: jax.Array  # (episodes, T)
    keys: jax.Array  # (episodes,), start and noise
    segments: bool = True  # r is made of held set-points
    stable_alone: bool = True  # the inner loop alone is stable
    change: tuple[int, Any] | None = None  # from this control step on, these parameters
    sensor: SensorParams = field(default_factory=sensors.params)  # each leaf a number for all, or (episodes,)
    paper: tuple[float, float] | None = None  # MAE in the paper: inner loop alone, its DRL


def _scenario(name: str, plant: Plant, params: Any, r: Any, episodes: int, **rest: Any) -> Scenario:
    """Parameters and reference repeated for each episode; episode i has noise seed i mod 32."""
    noise = jax.random.split(jax.random.key(0), NOISE_SEEDS)
    r = jnp.asarray(r, float)
    return Scenario(
        id=f"{plant.name}/{name}",
        plant=plant,
        params=_repeat(params, episodes),
        r=jnp.broadcast_to(r, (episodes, r.shape[-1])),
        keys=noise[jnp.arange(episodes) % NOISE_SEEDS],
        **rest,
    )


def _repeat(params: Any, episodes: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (episodes, *leaf.shape)), params)


def _pitch(
    name: str,
    episodes: int = 1,
    change: dict[str, Any] | None = None,
    rest: dict[str, Any] | None = None,
    **overrides: Any,
) -> Builder:
    def build(wanted: int | None) -> Scenario:
        n = wanted or episodes
        lines = {"max_delay": PITCH_MAX_DELAY} if "d1" in overrides else {}
        plant, params = make("pitch", **overrides)
        changed = None
        if change is not None:
            after = make("pitch", **overrides, **change)[1].replace(**lines)
            changed = (plant.episode_steps // 2, _repeat(after, n))
        r = jnp.full(plant.episode_steps, PITCH_SETPOINT)
        return _scenario(name, plant, params.replace(**lines), r, n, change=changed, **(rest or {}))

    return build


def _heaters(
    name: str, change: dict[str, Any] | None = None, rest: dict[str, Any] | None = None, **overrides: Any
) -> Builder:
    def build(wanted: int | None) -> Scenario:
        n = wanted or NOISE_SEEDS
        plant, params = make("heaters", **overrides)
        changed = None
        if change is not None:
            changed = (plant.episode_steps // 2, _repeat(make("heaters", **(overrides | change))[1], n))
        r = jnp.repeat(jnp.asarray(HEATERS_SETPOINTS), plant.episode_steps // len(HEATERS_SETPOINTS))
        return _scenario(name, plant, params, r, n, change=changed, **(rest or {}))

    return build


def _mixed_stock(wanted: int | None) -> Scenario:
    """paper-4 with Ca and Ua uniform within 30 % from house to house, another stock in each episode."""
    base = _heaters("mixed-stock")(wanted)
    shape = base.params.weights.shape
    key_Ca, key_Ua = jax.random.split(jax.random.key(1))
    house = base.params.house.replace(
        Ca=base.params.house.Ca[:, None] * jax.random.uniform(key_Ca, shape, float, 0.7, 1.3),
        Ua=base.params.house.Ua[:, None] * jax.random.uniform(key_Ua, shape, float, 0.7, 1.3),
    )
    return replace(base, params=base.params.replace(house=house))


def _family(name: str, kind: str, family_seed: int) -> Builder:
    """A family of references drawn from the seed; heaters: 1000 houses whose mean start is drawn too."""

    def build(wanted: int | None) -> Scenario:
        n = wanted or FAMILY_MEMBERS
        overrides: dict[str, Any] = {"n": 1000} if name == "heaters" else {}
        plant, params = make(name, **overrides)
        steps = plant.episode_steps if kind == "steps" else plant.family_steps
        keys = jax.random.split(jax.random.fold_in(jax.random.key(family_seed), list(FAMILIES).index(kind)), n)
        r = jax.vmap(lambda key: FAMILIES[kind](key, steps, *plant.evaluation_range))(keys)
        scenario = _scenario(kind, plant, params, r, n, segments=kind not in ("ramps", "sines"))
        if name == "heaters":
            start = jax.random.uniform(jax.random.fold_in(keys[0], 1), (n,), float, *plant.setpoint_range)
            scenario = replace(scenario, params=scenario.params.replace(x0_mean=start))
        return scenario

    return build


def catalogue(name: str, family_seed: int = FAMILY_SEED) -> dict[str, Builder]:
    """Every scenario of a plant: id -> function of the number of episodes (None: its own number).

    A plant without scenarios of its own has the families that it declares.
    """
    plant, _ = make(name)
    unstable = {"stable_alone": False}
    delays = {"paper": (10.13, 2.46)}  # the paper's one delayed case; no reading of it gives its 10.13 exactly
    noisy_pitch, noisy_heaters = ({"sensor": sensors.params(noise=noise)} for noise in (0.2, 0.1))
    own = {
        "pitch": {
            "paper": _pitch("paper", rest={"paper": (10.91, 3.90)}),
            "delay-0.57": _pitch("delay-0.57", d1=0.57, d2=0.57, rest=delays),
            "delay-5.7": _pitch("delay-5.7", d1=5.7, d2=0.57, rest=delays | unstable),
            "delay-swapped": _pitch("delay-swapped", d1=0.57, d2=5.7, rest=delays | unstable),
            "uncertainty": _pitch("uncertainty", W=W_PRINTED, rest=unstable),
            "load": _pitch("load", change={"disturbance": 2.0}),
            "noise": _pitch("noise", NOISE_SEEDS, rest=noisy_pitch),
        },
        "heaters": {
            "paper-4": _heaters("paper-4", rest={"paper": (15.62, 1.17)}),
            "paper-1000": _heaters("paper-1000", n=1000, x0_mean=17.8, rest={"paper": (15.07, 1.31)}),
            "riccati": _heaters("riccati", Pi=17.186),
            "cold": _heaters("cold", x_out=-15.0),
            "mixed-stock": _mixed_stock,
            "load": _heaters("load", n=1000, x0_mean=17.8, change={"x_out": -15.0}),
            "noise": _heaters("noise", n=1000, x0_mean=17.8, rest=noisy_heaters),
        },
    }.get(name, {})
    families = {kind: _family(name, kind, family_seed) for kind in plant.families}
    return {f"{name}/{key}": build for key, build in (own | families).items()}


def builder(identifier: str, family_seed: int = FAMILY_SEED) -> Builder:
    """The function that makes the scenario called `identifier`, such as `pitch/paper`.

    Raises:
        ValueError: there is no such plant or scenario; lists those that exist.
    """
    name = identifier.split("/")[0]
    scenarios = catalogue(name, family_seed)
    if identifier not in scenarios:
        raise ValueError(f"there is no scenario {identifier!r}; {name} has: {', '.join(scenarios)}")
    return scenarios[identifier]


def get(identifier: str, episodes: int | None = None, family_seed: int = FAMILY_SEED) -> Scenario:
    """The scenario called `identifier`, with so many episodes (None: its own number).

    Raises:
        ValueError: there is no such plant or scenario; lists those that exist.
    """
    return builder(identifier, family_seed)(episodes)


def perturbed(identifier: str, steps: int = 600, episodes: int = 64) -> Scenario:
    """A scenario from starts drawn as in training, its last reference held until there are so many steps."""
    scenario = get(identifier, episodes)
    return replace(
        scenario,
        plant=replace(scenario.plant, init=scenario.plant.training_start),
        r=jnp.pad(scenario.r, ((0, 0), (0, steps - scenario.r.shape[1])), mode="edge"),
        keys=jax.random.split(jax.random.key(3), episodes),
    )


def place(scenario: Scenario, ranges: Ranges, noise: float) -> Place:
    """Where a scenario lies among the plants of a training under domain randomisation.

    Args:
        scenario: whose plant, whatever its references.
        ranges: numbers of the plant that training drew; the others were the nominal ones.
        noise: largest standard deviation of the measurement noise in training.

    Returns:
        'outside' where any number is outside of what training drew, else 'edge' where one that is drawn has its least
        or greatest value, else 'inside'. How many houses there are and where they start counts for nothing.
    """
    bounds = {name: (leaf.copy(), leaf.copy()) for name, leaf in _numbers(make(scenario.plant.name)[1]).items()}
    for name, *ends in ranges:
        field, _, element = name.partition("[")
        for bound, end in zip(bounds[field], ends, strict=True):
            bound[int(element[:-1]) if element else ...] = end
    bounds["noise"] = np.zeros(()), np.asarray(noise)
    found = [("noise", np.asarray(scenario.sensor.noise)), *_numbers(scenario.params).items()]
    found += [] if scenario.change is None else list(_numbers(scenario.change[1]).items())
    edge = False
    for name, leaf in found:
        low, high = bounds[name]
        slack = ROUNDING * np.maximum(np.abs(low), np.abs(high))
        if np.any(leaf < low - slack) or np.any(leaf > high + slack):
            return "outside"
        if name != "noise":
            edge |= bool(np.any((low < high) & ((leaf < low + slack) | (leaf > high - slack))))
    return "edge" if edge else "inside"


def _numbers(params: Any) -> dict[str, np.ndarray]:
    """Leaves by their names, but for those of the start."""
    leaves = {path[-1].name: np.array(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(params)}
    return {name: leaf for name, leaf in leaves.items() if name not in OF_THE_START}


def paper_scenarios(name: str) -> list[str]:
    """Ids of the scenarios whose figure stands in the paper; where there are none, all of the plant's."""
    if name == "pitch":
        return ["pitch/paper", "pitch/delay-5.7", "pitch/delay-0.57", "pitch/delay-swapped"]
    if name == "heaters":
        return ["heaters/paper-4", "heaters/paper-1000"]
    return list(catalogue(name))


def stability_scenarios(name: str) -> list[str]:
    """Ids of the scenarios that stand for the plants whose local stability differs; of other plants the first."""
    own = {
        "pitch": ["paper", "delay-0.57", "delay-5.7", "delay-swapped", "uncertainty"],
        "heaters": ["paper-4", "riccati", "mixed-stock"],
    }.get(name)
    return [f"{name}/{key}" for key in own] if own else list(catalogue(name))[:1]
