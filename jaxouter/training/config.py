"""Configuration of a training run, and the presets."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import msgspec
import tyro

from jaxouter import plants
from jaxouter.agents.ddpg import DDPGConfig
from jaxouter.loop.identify import LEVELS
from jaxouter.plants import declaration
from jaxouter.plants.simulators import PlantOptions

HUGE = 2**31  # no number of a configuration is as large


@dataclass(frozen=True)
class PretrainingConfig:
    """A start by analytic policy gradient on a model identified from recorded episodes, before the learner begins."""

    gradient_steps: int = 0
    """Gradient steps of the actor on the identified model; 0: no such start."""
    episodes: int = 64
    """Episodes of the plant that are recorded under random r~, besides --steps."""
    plants: int = 1
    """Plants of which they are, each drawn from --randomise; more than one needs it."""
    episode_steps: int | None = None
    """Control steps of a recorded episode, and so of one on the model; None: an episode of the plant."""
    lags: int | None = None
    """Past samples of r~ and y in the model; None: as many as the observation holds, or as the dead time takes."""
    batch_size: int = 64
    """Episodes of the model a gradient step."""
    noise: float = 0.0
    """Largest standard deviation of the measurement noise that half of these have; 1 is half the set-point range."""
    load: float = 0.0
    """Largest unseen step of r~, at a random time, that half of these have; 1 is half the range of r~."""
    log_above: float = 0.0
    """Cost a step c above which episodes count less, as c log(1 + cost / c): so those of plants that are hard to hold
    don't outweigh all others; 0: each counts in full."""

    def check(self) -> None:
        """Raises ValueError, naming field, value and what is allowed."""
        if self.gradient_steps < 0:
            raise ValueError(f"pretraining.gradient_steps is {self.gradient_steps}; it must not be negative")
        for name in ("noise", "load", "log_above"):
            if getattr(self, name) < 0:
                raise ValueError(f"pretraining.{name} is {getattr(self, name)}; it must not be negative")
        for name in ("episodes", "plants", "episode_steps", "lags", "batch_size"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"pretraining.{name} is {getattr(self, name)}; it must be at least 1")


@dataclass(frozen=True)
class TrainConfig:
    """One training run. Every field is an option of `python -m jaxouter.train`."""

    plant: Annotated[str, tyro.conf.Positional]
    """Plant to learn on: pitch, heaters, FILE.py:NAME (your own), gym:ID, fmu:FILE or log:FILE."""
    preset: str
    """The preset that gave the defaults."""
    seed: int = 0
    """Seed of the first run."""
    seeds: int = 1
    """Runs with consecutive seeds, trained side by side."""
    devices: int = 1
    """Devices, over all processes. Each takes seeds of its own; where there are more devices than seeds, each learner
    spans several, which share its environments, replay and batch, and then draw otherwise than one. Those of a process
    share the episodes of pretraining, seed after seed, with the draws of one."""
    steps: int = 200_000
    """Environment steps of the learner, over all environments, prefill included; 0: the pretrained actor stays."""
    environments: int = 1
    """Environments that roll out in parallel."""
    updates: int = 1
    """Gradient updates after each step of all environments; updates / environments is the update-to-data ratio."""
    prefill: int = 1_000
    """Environment steps with random actions, each held a while, before the first update."""
    replay: int = 1_000_000
    """Environment steps that the replay holds."""
    epoch: int = 2_000
    """Environment steps an epoch, the unit of progress, evaluation and checkpoints."""
    history: int | None = None
    """Past samples of y and r~ in the observation; None: what the plant declares, or else chosen by its dead time."""
    integral_steps: float | None = None
    """Time constant of the leaky integral, in control steps; None: a quarter of an episode."""
    redraw: float = 0.0
    """Probability at each control step that the set-point is redrawn within an episode."""
    randomise: plants.Ranges = ()
    """Numbers of the plant that are drawn anew for each episode: name, least, greatest (and again)."""
    residual: bool = False
    """Learn a correction of the static prefilter, identified first, instead of r~ itself."""
    reward_scale: float = 1.0
    """Multiplies the reward, in the plant's error scales, before it is learned from."""
    noise_theta: float = 0.15
    """Rate of return of the Ornstein-Uhlenbeck exploration noise; 1 is white noise."""
    noise_sigma: tuple[float, float] = (0.2, 0.2)
    """Its volatility in the first and the last environment, geometric in between; 1 is half the range of r~."""
    noise_end: float = 1.0
    """Factor on the volatility at the end of training, reached linearly."""
    explored_steps: Annotated[int, tyro.conf.Suppress] = 0
    """Control steps of the plant by which the dead time was identified before, to choose what is not given."""
    plant_options: Annotated[PlantOptions, tyro.conf.arg(name="")] = field(default_factory=PlantOptions)
    """What a plant gym:ID, fmu:FILE or log:FILE does not say itself."""
    pretraining: PretrainingConfig = field(default_factory=PretrainingConfig)
    """The start."""
    ddpg: DDPGConfig = field(default_factory=DDPGConfig)
    """The learner."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, declaration.plain(value))

    def check(self) -> TrainConfig:
        """Itself.

        Raises:
            ValueError: names the field, its value and what is allowed.
        """
        plants.resolve(self.plant)
        for name, value in _numbers(to_dict(self)):
            if not -HUGE < value < HUGE:  # NaN is refused too
                raise ValueError(f"{name} is {value}; it must be a number between -{HUGE:,} and {HUGE:,}")
        self.pretraining.check()
        self.ddpg.check()
        if (self.pretraining.plants > 1) and not self.randomise:
            raise ValueError(f"pretraining.plants is {self.pretraining.plants}; without randomise it must be 1")
        if self.pretraining.episodes % self.pretraining.plants:
            raise ValueError(
                f"pretraining.episodes is {self.pretraining.episodes}; it must be a multiple of the "
                f"{self.pretraining.plants} plants"
            )
        for name in ("seeds", "devices", "environments", "updates", "epoch", "reward_scale"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
        if self.steps < 0 or not (self.steps or self.pretraining.gradient_steps):
            raise ValueError(f"steps is {self.steps}; it must be positive, or 0 with pretraining")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; it must not be negative")
        for name in ("steps", "epoch", "prefill"):
            if getattr(self, name) % self.environments:
                raise ValueError(
                    f"{name} is {getattr(self, name)}; it must be a multiple of the {self.environments} environments"
                )
        if max(self.seeds, self.devices) % min(self.seeds, self.devices):
            raise ValueError(
                f"devices is {self.devices} and seeds is {self.seeds}; one must be a multiple of the other"
            )
        for name, value in (("environments", self.environments), ("ddpg.batch_size", self.ddpg.batch_size)):
            if value % self.shards:
                raise ValueError(
                    f"{name} is {value}; it must be a multiple of the {self.shards} devices that each of the "
                    f"{self.seeds} seeds gets of {self.devices}"
                )
        if self.prefill < self.ddpg.batch_size or 0 < self.steps <= self.prefill:
            most = f" and less than the {self.steps} steps" if self.steps else ""
            raise ValueError(
                f"prefill is {self.prefill}; it must be at least the batch size, {self.ddpg.batch_size}{most}"
            )
        if self.prefill <= self.ddpg.n_step * self.environments:
            raise ValueError(
                f"prefill is {self.prefill}; it must hold more than ddpg.n_step = {self.ddpg.n_step} steps of each"
            )
        if self.replay < self.ddpg.batch_size:
            raise ValueError(f"replay is {self.replay}; it must hold at least a batch of {self.ddpg.batch_size}")
        if not 0 <= self.redraw <= 1 or not 0 < self.noise_theta <= 1:
            raise ValueError(
                f"redraw is {self.redraw} and noise_theta is {self.noise_theta}; they must lie in [0, 1] and (0, 1]"
            )
        if min(self.noise_sigma) <= 0 or self.noise_end < 0:
            raise ValueError(
                f"noise_sigma is {self.noise_sigma} and noise_end is {self.noise_end}; "
                "they must be positive and not negative"
            )
        return self

    @property
    def side_by_side(self) -> int:
        """Seeds that train at the same time."""
        return min(self.seeds, self.devices)

    @property
    def shards(self) -> int:
        """Devices that one learner spans."""
        return self.devices // self.side_by_side

    @property
    def epochs(self) -> int:
        """Epochs after the prefill; the last one may be shorter."""
        return max(0, -(-(self.steps - self.prefill) // self.epoch))

    @property
    def identification_steps(self) -> int:
        """Control steps recorded before the training, of each seed; none of a plant that is made from a record."""
        plant, start = plants.make(self.plant)[0], self.pretraining
        if plant.identified:
            return 0
        recorded = start.episodes * (start.episode_steps or plant.episode_steps) if start.gradient_steps else 0
        return self.explored_steps + recorded + (LEVELS * plant.episode_steps if self.residual else 0)

    @property
    def environment_steps(self) -> int:
        """Control steps of the plant that one seed sees, identification included."""
        return self.steps + self.identification_steps

    @property
    def total_updates(self) -> int:
        """Gradient updates of one seed."""
        return max(0, self.steps - self.prefill) // self.environments * self.updates


PAPER = TrainConfig(plant="pitch", preset="paper", prefill=200)
DEFAULT = TrainConfig(
    plant="pitch",
    preset="default",
    steps=0,
    environments=16,
    updates=4,
    prefill=8_000,
    replay=200_000,
    epoch=6_000,
    residual=True,
    reward_scale=0.1,
    noise_theta=0.15,
    noise_sigma=(0.0125, 0.1),
    integral_steps=20.0,
    pretraining=PretrainingConfig(gradient_steps=1_500, noise=0.015, load=0.1),
    ddpg=DDPGConfig(
        hidden=(128, 128),
        layer_norm=True,
        actor_rate=3e-4,
        critic_rate=1e-3,
        rate_decay="cosine",
        critic_l2=0.0,
        batch_size=256,
        discount=0.99,
        polyak=0.005,
        saturation_penalty=1e-3,
    ),
)
HEATERS = replace(
    DEFAULT,
    plant="heaters",
    integral_steps=None,
    reward_scale=1.0,
    pretraining=replace(DEFAULT.pretraining, gradient_steps=2_000, noise=0.02, load=0.2),
    ddpg=replace(DEFAULT.ddpg, discount=0.95),
)
ROBUST_PITCH = replace(
    DEFAULT,
    preset="robust",
    history=80,  # longer than the longest delay
    randomise=(
        ("tau", 0.3, 0.7),
        ("d1", 0.0, 0.8),
        ("d2", 0.0, 6.0),
        ("gain", 0.8, 1.2),
        ("W[0]", 0.0, 0.2),
        ("W[1]", -0.01, 0.01),
        ("W[2]", -0.01, 0.01),
    ),
    pretraining=replace(
        DEFAULT.pretraining, gradient_steps=12_000, episodes=512, plants=128, episode_steps=400, log_above=1.0
    ),
)
ROBUST_HEATERS = replace(
    HEATERS,
    preset="robust",
    history=20,
    randomise=(
        ("Pi", 0.3, 18.0),
        ("x_out", -20.0, 5.0),
        ("Ca", 7.0, 13.0),
        ("Ua", 0.14, 0.26),
        ("sigma", 0.0, 0.3),  # of four houses: the noise of their mean is that of any number of them
    ),
    pretraining=replace(HEATERS.pretraining, gradient_steps=5_000, episodes=1_024, plants=128),
)
OWN = {"default": DEFAULT, "paper": PAPER}
PRESETS: dict[str, dict[str, TrainConfig]] = {
    "pitch": {"default": DEFAULT, "robust": ROBUST_PITCH, "paper": PAPER},
    "heaters": {
        "default": HEATERS,
        "robust": ROBUST_HEATERS,
        "paper": replace(PAPER, plant="heaters", steps=400_000),
    },
}


def preset(plant: str, name: str = "default") -> TrainConfig:
    """The preset called `name` of a plant; a plant of one's own takes `OWN`.

    Raises:
        ValueError: unknown plant or preset; lists those that exist.
    """
    plants.resolve(plant)
    presets = PRESETS.get(plant, OWN)
    if name not in presets:
        raise ValueError(f"there is no preset {name!r} for {plant}; the presets are: {', '.join(presets)}")
    return replace(presets[name], plant=plant)


def _numbers(values: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """All numbers in nested values, with their names."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _numbers(value, f"{name}.{key}" if name else key)
    elif isinstance(values, tuple | list):
        for value in values:
            yield from _numbers(value, name)
    elif isinstance(values, int | float):
        yield name, values


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """Plain dict, for JSON."""
    return dataclasses.asdict(config)


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """The configuration from what `to_dict` gave, also after a round trip through JSON.

    Raises:
        ValueError: a field is missing, unknown or of another type.
    """
    # Runs of versions that knew one device only, no pretraining, randomisation or options go on as they were.
    whole = {
        "devices": 1,
        "randomise": (),
        "explored_steps": 0,
        "plant_options": {},
        "pretraining": {},
        "ddpg": {},
        **values,
    }
    added_since = {
        "plant_options": dataclasses.asdict(PlantOptions()),
        "pretraining": dataclasses.asdict(PretrainingConfig()),
        "ddpg": {"actor_from": 0},
    }
    for name, added in added_since.items():
        if not isinstance(whole[name], dict):
            raise ValueError(f"{name} is {whole[name]!r}; it must be an object with its fields")
        whole[name] = added | whole[name]
    kinds = (TrainConfig, whole), (PlantOptions, whole["plant_options"]), (PretrainingConfig, whole["pretraining"])
    for cls, of_cls in (*kinds, (DDPGConfig, whole["ddpg"])):
        names = {f.name for f in dataclasses.fields(cls)}
        if set(of_cls) != names:
            raise ValueError(f"the configuration has fields {sorted(map(str, set(of_cls) ^ names))} missing or unknown")
    return msgspec.convert(whole, TrainConfig)
