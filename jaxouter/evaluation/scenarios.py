"""The evaluation scenarios: those that tasks declare, and families of references. None is ever trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxouter import tasks
from jaxouter.loop import sensor as sensors
from jaxouter.loop.references import FAMILIES
from jaxouter.loop.sensor import SensorParams
from jaxouter.plants import Plant, Ranges, base, make, parameters, with_parameters

FAMILY_SEED = 2024
FAMILY_MEMBERS = 64
REST_POINTS = 19  # set-points at which it is seen whether the loop comes to rest
REST_STEPS = 1_200  # for which each is held
REST = {"rest": 0.0, "rest-noise": 0.006}  # standard deviation of their sensor, as share of the range of set-points
NOISE_SEEDS = 32
Builder = Callable[[int | None], "Scenario"]
Place = Literal["inside", "edge", "outside"]
ROUNDING = 1e-5  # of a number of the plant, by which it may lie outside its range


class Known(NamedTuple):
    """What those who know the plant of a scenario know."""

    plant: str
    """Its name, with parameters that differ from the nominal ones."""
    noise: float = 0.0
    """Standard deviation of the sensor's noise, in the unit of y; 0: that of training."""
    smooth: bool = False
    """Whether the plant has no noise of its own."""


@dataclass(frozen=True)
class Scenario:
    """The same episodes for every policy."""

    id: str
    plant: Plant
    params: Any  # each leaf (episodes, ...)
    r: jax.Array  # (episodes, T)
    keys: jax.Array  # (episodes,), start and noise
    segments: bool = True  # r is made of held set-points
    stable_alone: bool = True  # the inner loop alone is stable
    change: tuple[int, Any] | None = None  # from this control step on, these parameters
    sensor: SensorParams = field(default_factory=sensors.params)  # each leaf a number for all, or (episodes,)
    load: jax.Array | None = None  # (episodes, T), added to r~ at the plant; nobody sees it
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


def _declared(plant: str, name: str, spec: tasks.Scenario) -> Builder:
    """The scenario of that name that the plant's task declares."""

    def build(wanted: int | None) -> Scenario:
        n = wanted or spec.episodes
        made, params = make(plant, **spec.set)
        changed = None
        if spec.change:
            after = make(plant, **{**spec.set, **spec.change})[1]
            changed = (made.episode_steps // 2, spec.adapt(_repeat(after, n)))
        r = jnp.repeat(jnp.asarray(spec.reference, float), made.episode_steps // len(spec.reference))
        r = jnp.pad(r, (0, made.episode_steps - r.size), mode="edge")
        scenario = _scenario(name, made, params, r, n, change=changed, paper=None if parameters(plant) else spec.paper)
        return replace(
            scenario,
            params=spec.adapt(scenario.params),
            stable_alone=spec.stable_alone,
            sensor=sensors.params(noise=spec.noise),
        )

    return build


def _family(name: str, kind: str, family_seed: int) -> Builder:
    """A family of references drawn from the seed, on the plant as its task has it for families."""

    def build(wanted: int | None) -> Scenario:
        n, families = wanted or FAMILY_MEMBERS, tasks.of(name).families
        plant, params = make(name, **families.set)
        steps = plant.episode_steps if kind == "steps" else plant.family_steps
        keys = jax.random.split(jax.random.fold_in(jax.random.key(family_seed), list(FAMILIES).index(kind)), n)
        r = jax.vmap(lambda key: FAMILIES[kind](key, steps, *plant.evaluation_range))(keys)
        scenario = _scenario(kind, plant, params, r, n, segments=kind not in ("ramps", "sines"))
        return replace(scenario, params=families.adapt(scenario.params, jax.random.fold_in(keys[0], 1), n))

    return build


def _rest(name: str, kind: str, noise: float) -> Builder:
    """Set-points over the range of evaluation, long held, on the plant without its own disturbance."""

    def build(wanted: int | None) -> Scenario:
        n, (plant, params) = wanted or REST_POINTS, make(name)
        r = jnp.linspace(*plant.evaluation_range, n)[:, None]
        made = _scenario(kind, plant, plant.noise_free(params), jnp.broadcast_to(r, (n, REST_STEPS)), n)
        return replace(made, sensor=sensors.params(noise=noise * float(np.ptp(plant.setpoint_range))))

    return build


def catalogue(name: str, family_seed: int = FAMILY_SEED) -> dict[str, Builder]:
    """Every scenario of a plant: id -> function of the number of episodes (None: its own number).

    They are those that its task declares, the families that the plant does, and long held set-points.
    """
    plant, _ = make(name)
    own = {key: _declared(name, key, spec) for key, spec in tasks.of(name).scenarios.items()}
    families = {kind: _family(name, kind, family_seed) for kind in plant.families}
    rest = {key: _rest(name, key, noise) for key, noise in REST.items()}
    return {f"{name}/{key}": build for key, build in (own | families | rest).items()}


def plant_of(identifier: str) -> str:
    """The plant's name in a scenario's id, which may hold parameters, and so a slash of its own."""
    return identifier.rpartition("/")[0] or identifier


def known(identifier: str) -> Known:
    """What those who know the plant of a scenario know: the parameters that its task sets, and the sensor's noise.

    What makes no other plant (how many houses there are, and where they start) is left out. Where the inner loop alone
    is unstable, they know the nominal plant: a record of that one diverges.
    """
    plant, _, name = identifier.rpartition("/")
    task = tasks.of(plant)
    spec = task.scenarios.get(name)
    noise = spec.noise if spec else REST.get(name, 0.0) * float(np.ptp(make(plant)[0].setpoint_range))
    noise = float(f"{noise:.1g}")  # one serves all that are about alike
    smooth = noise > 0.0 and (spec is None or spec.smooth) and _has_noise(plant)
    if spec is None or not spec.stable_alone:
        return Known(plant, noise, smooth)
    nominal = _numbers(make(plant)[1], task.start)

    def differs(setting: str) -> bool:
        other = _numbers(make(plant, **{setting: spec.set[setting]})[1], task.start)
        return any(not np.array_equal(leaf, nominal[key]) for key, leaf in other.items())

    return Known(with_parameters(plant, {name: spec.set[name] for name in filter(differs, spec.set)}), noise, smooth)


def _has_noise(plant: str) -> bool:
    """Whether a plant has noise of its own."""
    made, params = make(plant)
    return not all(map(np.array_equal, jax.tree.leaves(params), jax.tree.leaves(made.noise_free(params))))


def builder(identifier: str, family_seed: int = FAMILY_SEED) -> Builder:
    """The function that makes the scenario called `identifier`, such as `pitch/paper`.

    Raises:
        ValueError: there is no such plant or scenario; lists those that exist.
    """
    name = plant_of(identifier)
    scenarios = catalogue(name, family_seed)
    if identifier not in scenarios:
        raise ValueError(f"there is no scenario {identifier!r}; {name} has: {', '.join(scenarios)}")
    return scenarios[identifier]


def identifiers(plant: str, names: Sequence[str] = ()) -> list[str]:
    """Ids of scenarios of a plant.

    Args:
        plant: its name.
        names: ids, with or without the plant; parameters that the plant's name sets may be left out. Empty: all.

    Raises:
        ValueError: there is no such scenario, or it is another plant's.
    """
    found = of_plant(plant, names) or list(catalogue(plant))
    for name in found:
        builder(name)
    return found


def of_plant(plant: str, names: Sequence[str]) -> list[str]:
    """Ids with the plant's name, which may lack in `names`, or lack the parameters that it sets.

    Raises:
        ValueError: an id is another plant's.
    """
    parts = [name.rpartition("/") for name in names]
    for of, _, name in parts:
        if of not in ("", plant, base(plant)):
            make(of)
            raise ValueError(f"the plant is {plant}; {of}/{name} is another plant's")
    return list(dict.fromkeys(f"{plant}/{name}" for _, _, name in parts))


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


def place(scenario: Scenario, trained: str, ranges: Ranges, noise: float) -> Place:
    """Where a scenario lies among the plants of a training under domain randomisation.

    Args:
        scenario: whose plant, whatever its references.
        trained: name of the plant of the training.
        ranges: numbers of the plant that training drew; the others were the nominal ones.
        noise: largest standard deviation of the measurement noise in training.

    Returns:
        'outside' where any number is outside of what training drew, else 'edge' where one that is drawn has its least
        or greatest value, else 'inside'. How many houses there are and where they start counts for nothing.
    """
    start = tasks.of(scenario.plant.name).start
    nominal = _numbers(make(trained)[1], start)
    bounds = {name: (leaf.copy(), leaf.copy()) for name, leaf in nominal.items()}
    for name, *ends in ranges:
        field, _, element = name.partition("[")
        for bound, end in zip(bounds[field], ends, strict=True):
            bound[int(element[:-1]) if element else ...] = end
    bounds["noise"] = np.zeros(()), np.asarray(noise)
    found = [("noise", np.asarray(scenario.sensor.noise)), *_numbers(scenario.params, start).items()]
    found += [] if scenario.change is None else list(_numbers(scenario.change[1], start).items())
    edge = False
    for name, leaf in found:
        low, high = bounds[name]
        slack = ROUNDING * np.maximum(np.abs(low), np.abs(high))
        if np.any(leaf < low - slack) or np.any(leaf > high + slack):
            return "outside"
        if name != "noise":
            edge |= bool(np.any((low < high) & ((leaf < low + slack) | (leaf > high - slack))))
    return "edge" if edge else "inside"


def _numbers(params: Any, start: Sequence[str]) -> dict[str, np.ndarray]:
    """Leaves by their names, but for those of the start."""
    leaves = {path[-1].name: np.array(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(params)}
    return {name: leaf for name, leaf in leaves.items() if name not in start}


def reported(name: str) -> list[str]:
    """Ids of the scenarios on which a training of the plant is evaluated: of the paper's plants those in the paper."""
    own = [f"{name}/{key}" for key in tasks.of(name).reported]
    return own or [identifier for identifier in catalogue(name) if identifier.rpartition("/")[2] not in REST]


def for_stability(name: str) -> list[str]:
    """Ids of the scenarios that stand for the plants whose local stability differs; of other plants the first."""
    return [f"{name}/{key}" for key in tasks.of(name).stability] or list(catalogue(name))[:1]
