"""Configuration of a training run, and the presets."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar, cast

import msgspec
import tyro

from jaxouter import agents, plants, tasks
from jaxouter.agents import AgentConfig
from jaxouter.agents.pairs import SHARES, PairsConfig
from jaxouter.identification.bank import Member, ranges
from jaxouter.identification.steady_state import LEVELS
from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.rewards import RewardConfig
from jaxouter.plants import declaration
from jaxouter.plants.simulators import PlantOptions

INTERNAL = ("plant", "preset", "explored_steps", "plant_options")  # fields that are no options by name
Base = Literal["lq", "static", "none", "absolute", "bank"]
MOST_LAWS = 12  # in a bank
HUGE = 2**31  # numbers of a configuration must be smaller


@dataclass(frozen=True)
class PretrainingConfig:
    """Recorded episodes, and pretraining of the actor on a model identified from them, before the agent learns."""

    gradient_steps: int = 0
    """Gradient steps of the actor on the identified model; 0: no pretraining."""
    episodes: int = 64
    """Episodes of the plant recorded under random r~, in addition to --steps; the base law lq is made from them too."""
    plants: int = 1
    """Plants they are recorded on, each drawn from --randomise; more than one needs --randomise."""
    episode_steps: int | None = None
    """Length of a recorded episode in control steps, and of an episode on the model; None: the plant's episode."""
    lags: int | None = None
    """Past samples of r~ and y in the model; None: as in the observation, or more if the dead time needs them."""
    closed_loop: int = 0
    """Episodes recorded in closed loop, under the LQ law of those under random r~, if the plant is unstable alone."""
    batch_size: int = 64
    """Episodes on the model per gradient step."""
    log_above: float = 0.0
    """c > 0: an episode's cost per step counts as c log(1 + cost / c); 0: it counts in full.
    This way episodes on plants that are hard to control don't outweigh all others."""

    def check(self) -> None:
        """Raises ValueError if a setting is wrong; names the field, its value and what is allowed."""
        if self.gradient_steps < 0:
            raise ValueError(f"pretraining.gradient_steps is {self.gradient_steps}; it must not be negative")
        if self.log_above < 0:
            raise ValueError(f"pretraining.log_above is {self.log_above}; it must not be negative")
        if self.closed_loop < 0:
            raise ValueError(f"pretraining.closed_loop is {self.closed_loop}; it must not be negative")
        for name in ("episodes", "plants", "episode_steps", "lags", "batch_size"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"pretraining.{name} is {getattr(self, name)}; it must be at least 1")


@dataclass(frozen=True)
class TrainConfig:
    """One training run. Every field is an option of `python -m jaxouter.train`."""

    plant: Annotated[str, tyro.conf.Positional]
    """Plant to learn on: pitch, heaters, FILE.py:NAME (your own), gym:ID, fmu:FILE or log:FILE."""
    preset: str
    """Preset that supplies the defaults: default (the LQ law of a record, improved by reinforcement learning), scratch
    (reinforcement learning alone, as with --base static), record (pretraining alone), paper; for pitch and heaters also
    robust."""
    agent: AgentConfig
    """Settings of the learning algorithm; --agent NAME chooses another."""
    seed: int = 0
    """Seed of the first run."""
    seeds: int = 1
    """Number of runs, with consecutive seeds, trained in parallel."""
    devices: int = 1
    """Devices over all processes, which share the seeds and the episodes of pretraining.
    With more devices than seeds, several share each learner: its results then differ from those of one device."""
    steps: int = 200_000
    """Environment steps of the agent, over all environments, prefill included; 0: pretraining only."""
    environments: int = 1
    """Parallel environments."""
    epoch: int = 2_000
    """Environment steps per epoch, the unit of progress, evaluation and checkpoints."""
    history: int | None = None
    """Past samples of y and r~ in the observation; None: as the plant declares, or else chosen by its dead time."""
    integral_steps: float | None = None
    """Time constant of the leaky integral, in control steps; None: a quarter of an episode."""
    redraws: tuple[float, float] = (0.0, 0.0)
    """Least and greatest number of redraws of the set-point in an episode, on average; drawn for each episode,
    log-uniform. 0 0: never."""
    randomise: plants.Ranges = ()
    """Parameters of the plant drawn for each episode: name, least, greatest value, repeated for each."""
    base: Base = "lq"
    """Base law, which the actor corrects: lq (linear-quadratic law of a record), static (inverse of the DC gain), none
    (r~ = r), absolute (the middle of the range of r~), or bank (an LQ law for each of several plants, chosen by what
    their models predict; for pretraining alone)."""
    bank: Annotated[tuple[Member, ...], tyro.conf.Suppress] = ()
    """Plants of the base law bank, set by a preset or in Python; see `jaxouter.identification.bank.Member`."""
    correction: float = 1.0
    """Largest correction of the base law; 1 is half the range of r~."""
    reward_scale: float = 1.0
    """Factor on the reward (in the plant's error scales) that the agent learns from."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """Weights of the reward that is trained on."""
    disturbances: Disturbances = field(default_factory=Disturbances)
    """Noise and loads, each in half of the training episodes."""
    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Rounds of learning from pairs, after the agent's own steps; only a better actor is kept."""
    compared: int = 512
    """Fresh training episodes of the gate. After an epoch or a round of pairs the new actor is kept if it is better on
    them than the best so far, and at the end the policy if it is better than the base law alone. 0: without a gate."""
    explored_steps: Annotated[int, tyro.conf.Suppress] = 0
    """Control steps spent to identify the dead time, for settings that were not given."""
    plant_options: Annotated[PlantOptions, tyro.conf.arg(name="")] = field(default_factory=PlantOptions)
    """What a plant gym:ID, fmu:FILE or log:FILE does not declare itself."""
    pretraining: PretrainingConfig = field(default_factory=PretrainingConfig)
    """Pretraining of the actor on a model identified from recorded episodes."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, declaration.plain(value))

    def check(self) -> TrainConfig:
        """Check the configuration; returns it.

        Raises:
            ValueError: names the field, its value and what is allowed.
        """
        plants.resolve(self.plant)
        for name, value in _numbers(to_dict(self)):
            if not -HUGE < value < HUGE:  # NaN is refused too
                raise ValueError(f"{name} is {value}; it must be a number between -{HUGE:,} and {HUGE:,}")
        self.pretraining.check()
        self.reward.check()
        self.disturbances.check()
        self.pairs.check()
        self.agent.check()
        if (self.pretraining.plants > 1) and not self.randomise:
            raise ValueError(f"pretraining.plants is {self.pretraining.plants}; without randomise it must be 1")
        if self.pretraining.closed_loop and (self.randomise or self.base not in ("lq", "bank")):
            raise ValueError(
                f"pretraining.closed_loop is {self.pretraining.closed_loop}; it must be 0 without --base lq or bank, "
                "and with --randomise"
            )
        self._check_bank()
        if self.pretraining.episodes % self.pretraining.plants:
            raise ValueError(
                f"pretraining.episodes is {self.pretraining.episodes}; it must be a multiple of the "
                f"{self.pretraining.plants} plants"
            )
        for name in ("seeds", "devices", "environments", "epoch", "reward_scale", "correction"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
        if self.steps < 0 or not (self.steps or self.pretraining.gradient_steps or self.pairs.rounds):
            raise ValueError(f"steps is {self.steps}; it must be positive, or 0 with pretraining or rounds of pairs")
        if self.compared < 0 or (self.pairs.rounds and not self.compared):
            raise ValueError(f"compared is {self.compared}; it must be positive, or 0 without rounds of pairs")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; it must not be negative")
        if self.steps % self.environments:
            raise ValueError(f"steps is {self.steps}; it must be a multiple of the {self.environments} environments")
        if max(self.seeds, self.devices) % min(self.seeds, self.devices):
            raise ValueError(
                f"devices is {self.devices} and seeds is {self.seeds}; one must be a multiple of the other"
            )
        if self.environments % self.shards:
            raise ValueError(
                f"environments is {self.environments}; it must be a multiple of the {self.shards} devices that each of "
                f"the {self.seeds} seeds gets of {self.devices}"
            )
        self.agent.data.check(self.steps, self.epoch, self.environments, self.shards)
        low, high = self.redraws
        if not (low == high == 0 or 0 < low <= high):
            raise ValueError(f"redraws is {self.redraws}; it must be 0 0, or two positive numbers in ascending order")
        return self

    def _check_bank(self) -> None:
        """Check that a bank is all that is learned on."""
        if bool(self.bank) != (self.base == "bank"):
            raise ValueError(
                f"base is {self.base} and bank has {len(self.bank)} plants; a bank needs --base bank, and plants "
                "that a preset or Python sets"
            )
        if not self.bank:
            return
        if not 2 <= len(self.bank) <= MOST_LAWS:
            raise ValueError(f"bank has {len(self.bank)} plants; it must have 2 to {MOST_LAWS}")
        if self.randomise:
            raise ValueError("randomise must be empty with --base bank, which has plants of its own")
        for name, value in (("steps", self.steps), ("pairs.rounds", self.pairs.rounds), ("compared", self.compared)):
            if value:
                raise ValueError(f"{name} is {value}; it must be 0 with --base bank, which is for pretraining alone")

    @property
    def ranges(self) -> plants.Ranges:
        """Parameters of the plants of the training: name, least and greatest value.

        Raises:
            ValueError: a plant of the bank sets a parameter that there is not; lists those.
        """
        return ranges(plants.make(self.plant)[1], self.bank) if self.bank else self.randomise

    @property
    def side_by_side(self) -> int:
        """Seeds that train at the same time."""
        return min(self.seeds, self.devices)

    @property
    def shards(self) -> int:
        """Devices per learner."""
        return self.devices // self.side_by_side

    @property
    def agent_epochs(self) -> int:
        """Epochs of the agent, after the prefill; the last one may be shorter."""
        return max(0, -(-(self.steps - self.agent.data.before) // self.epoch))

    @property
    def epochs(self) -> int:
        """Epochs in all: those of the agent, then each round of pairs, then the check."""
        return self.agent_epochs + self.pairs.rounds + (self.compared > 0)

    def agent_steps(self, epoch: int) -> int:
        """Environment steps of one of the agent's epochs."""
        return min(self.epoch, self.steps - self.agent.data.before - epoch * self.epoch)

    def steps_of(self, epoch: int, episode_steps: int) -> tuple[int, int]:
        """Control steps of the plant and updates of an epoch, given the length of the plant's episodes."""
        each = self.compared * episode_steps
        if epoch < self.agent_epochs:
            steps = self.agent_steps(epoch)
            return steps + 2 * each, self.agent_updates * steps // (self.steps - self.agent.data.before)
        if epoch < self.agent_epochs + self.pairs.rounds:
            return self.pairs.steps(episode_steps) + (1 + len(SHARES)) * each, self.pairs.updates_per_round
        return 2 * each, 0

    @property
    def gated(self) -> bool:
        """Whether the pretrained actor is compared with the base law before rounds of pairs continue from it."""
        return self.pretraining.gradient_steps > 0 and self.pairs.rounds > 0

    def done_by(self, epoch: int, episode_steps: int) -> tuple[int, int]:
        """The same of all epochs until then, the prefill and the comparison before them included."""
        of_each = [self.steps_of(each, episode_steps) for each in range(epoch)]
        prefill = self.agent.data.before if epoch and self.agent_epochs else 0
        prefill += 2 * self.compared * episode_steps if self.gated else 0
        return prefill + sum(steps for steps, _ in of_each), sum(updates for _, updates in of_each)

    @property
    def identification_steps(self) -> int:
        """Control steps recorded before the training of each seed; none for a plant made from recorded data."""
        plant, start = plants.make(self.plant)[0], self.pretraining
        if plant.identified:
            return 0
        episodes = start.episodes + start.closed_loop
        recorded = episodes * (start.episode_steps or plant.episode_steps) if self.records else 0
        recorded *= len(self.bank) or 1
        levels = LEVELS * plant.episode_steps if self.base in ("static", "lq") else 0
        return self.explored_steps + recorded + levels

    @property
    def records(self) -> bool:
        """Whether episodes are recorded, for the base law or for pretraining."""
        return self.base in ("lq", "bank") or self.pretraining.gradient_steps > 0

    @property
    def environment_steps(self) -> int:
        """Control steps of the plant per seed, identification included."""
        return self.done_by(self.epochs, plants.make(self.plant)[0].episode_steps)[0] + self.identification_steps

    @property
    def agent_updates(self) -> int:
        """Updates of the agent per seed."""
        return self.agent.data.total_updates(self.steps, self.environments)

    @property
    def total_updates(self) -> int:
        """Gradient updates per seed, after the pretraining."""
        return self.agent_updates + self.pairs.rounds * self.pairs.updates_per_round


def preset(plant: str, name: str = "default", agent: str | None = None) -> TrainConfig:
    """The preset called `name` of a plant.

    Args:
        plant, name: registered names.
        agent: None: the preset's; another one has its own defaults, but for settings that both have.

    Raises:
        ValueError: unknown plant, preset or agent; lists the known ones.
    """
    return configured(plant, name, tasks.options(plant, name, agent), agent)


def configured(plant: str, name: str, options: tasks.Options, agent: str | None = None) -> TrainConfig:
    """The configuration from options, which include the agent's name.

    Another `agent` takes over the settings that it has too.
    """
    options = dict(options)
    own = options.pop("agent")
    kind = agents.resolve(agent or own)
    settings = {key: value for key, value in options.items() if key.startswith("agent.")}
    rest = {key: value for key, value in options.items() if key not in settings}
    if agent not in (None, own):
        settings = {key: value for key, value in settings.items() if hasattr(kind, key.removeprefix("agent."))}
    try:
        base = TrainConfig(plant, name, _changed(kind(), settings, "agent."))
        return from_dict(to_dict(_changed(base, rest, "")))  # which looks at types too
    except ValueError as error:
        raise ValueError(f"preset {name!r} of {plant}: {error}") from None


def with_options(config: TrainConfig, options: tasks.Options) -> TrainConfig:
    """The configuration with some options changed, by name, such as `agent.discount`.

    Raises:
        ValueError: there is no such option; lists the options.
    """
    return _changed(config, options, "")


Config = TypeVar("Config")


def _changed(config: Config, options: tasks.Options, prefix: str) -> Config:
    """A dataclass with its options, and those of nested dataclasses, changed; their names begin with `prefix`."""
    known = {f.name: getattr(config, f.name) for f in dataclasses.fields(cast(Any, config))}
    changes: dict[str, Any] = {}
    for option, value in options.items():
        name, _, inner = option.removeprefix(prefix).partition(".")
        whole = not inner and (not dataclasses.is_dataclass(known.get(name)) or isinstance(value, type(known[name])))
        if not (whole or inner) and name in known:
            first = dataclasses.fields(known[name])[0].name
            raise ValueError(f"{option} is {value!r}; it has settings of its own, such as {option}.{first}")
        if name not in known or (inner and not dataclasses.is_dataclass(known[name])):
            there = ", ".join(prefix + each for each in known if each not in INTERNAL)
            raise ValueError(f"there is no option {option!r}; there are: {there}")
        within = changes.get(name, known[name])
        changes[name] = _changed(within, {option: value}, f"{prefix}{name}.") if inner else value
    return dataclasses.replace(cast(Any, config), **changes)


def _numbers(values: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """All numbers in nested values, by name."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _numbers(value, f"{name}.{key}" if name else key)
    elif isinstance(values, tuple | list):
        for value in values:
            yield from _numbers(value, name)
    elif isinstance(values, int | float):
        yield name, values


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """Plain dict, for JSON, with the agent's name among its settings."""
    values = dataclasses.asdict(config)
    return values | {"agent": {"name": agents.name_of(config.agent), **values["agent"]}}


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """The inverse of `to_dict`, also after a round trip through JSON.

    Raises:
        ValueError: a field is missing, unknown or of the wrong type, or the agent is unknown.
    """
    parts = {"plant_options": PlantOptions, "pretraining": PretrainingConfig}
    parts |= {"reward": RewardConfig, "disturbances": Disturbances, "pairs": PairsConfig}
    for name in ("agent", *parts):
        if not isinstance(values.get(name), dict):
            raise ValueError(f"{name} is {values.get(name)!r}; it must be an object with its fields")
    of_agent = dict(values["agent"])
    name = of_agent.pop("name", None)
    if not isinstance(name, str):
        raise ValueError(f"agent.name is {name!r}; it must be the name of an agent")
    kind = agents.resolve(name)
    whole = {**values, "agent": of_agent}
    nested = [(cls, whole[name]) for name, cls in parts.items()]
    for cls, of_cls in ((TrainConfig, whole), *nested, (kind, of_agent)):
        names = {f.name for f in dataclasses.fields(cast(Any, cls))}
        if set(of_cls) != names:
            raise ValueError(
                f"fields of the configuration are missing or unknown: {sorted(map(str, set(of_cls) ^ names))}"
            )
    try:
        return msgspec.convert(whole, TrainConfig, dec_hook=lambda _, found: msgspec.convert(found, kind))
    except msgspec.ValidationError as error:
        found = re.fullmatch(r"Expected `(.+?)`, got `(.+?)`(?: - at `\$\.(.+?)`)?", str(error))
        if found is None:
            raise
        raise ValueError(f"{found[3] or 'the configuration'} is of type {found[2]}; it must be {found[1]}") from None
