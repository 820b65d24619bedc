"""Configuration of a training run, and the presets."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import tyro

from jaxouter import plants
from jaxouter.agents.ddpg import DDPGConfig
from jaxouter.loop.identify import LEVELS


@dataclass(frozen=True)
class PretrainingConfig:
    """A start by analytic policy gradient on a model identified from recorded episodes, before the learner begins."""

    gradient_steps: int = 0
    """Gradient steps of the actor on the identified model; 0: no such start."""
    episodes: int = 64
    """Episodes of the plant that are recorded under random r~, besides --steps."""
    lags: int = 15
    """Past samples of r~ and y in the model."""
    batch_size: int = 64
    """Episodes of the model a gradient step."""

    def check(self) -> None:
        """Raises ValueError, naming field, value and what is allowed."""
        if self.gradient_steps < 0:
            raise ValueError(f"pretraining.gradient_steps is {self.gradient_steps}; it must not be negative")
        for name in ("episodes", "lags", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"pretraining.{name} is {getattr(self, name)}; it must be at least 1")


@dataclass(frozen=True)
class TrainConfig:
    """One training run. Every field is an option of `python -m jaxouter.train`."""

    plant: Annotated[str, tyro.conf.Positional]
    """Plant to learn on."""
    preset: str
    """The preset that gave the defaults."""
    seed: int = 0
    """Seed of the first run."""
    seeds: int = 1
    """Runs with consecutive seeds, trained side by side."""
    devices: int = 1
    """Devices, over all processes. Each takes seeds of its own; where there are more devices than seeds, each learner
    spans several, which share its environments, replay and batch, and then draw otherwise than one."""
    steps: int = 200_000
    """Environment steps in all, over all environments, prefill included; equal to it, the pretrained actor stays."""
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
    """Past samples of y and r~ in the observation; None: what the plant declares."""
    integral_steps: float | None = None
    """Time constant of the leaky integral, in control steps; None: a quarter of an episode."""
    redraw: float = 0.0
    """Probability at each control step that the set-point is redrawn within an episode."""
    residual: bool = False
    """Learn a correction of the static prefilter, identified first, instead of r~ itself."""
    reward_scale: float = 1.0
    """Multiplies the reward before it is learned from."""
    noise_theta: float = 0.15
    """Rate of return of the Ornstein-Uhlenbeck exploration noise; 1 is white noise."""
    noise_sigma: tuple[float, float] = (0.2, 0.2)
    """Its volatility in the first and the last environment, geometric in between; 1 is half the range of r~."""
    noise_end: float = 1.0
    """Factor on the volatility at the end of training, reached linearly."""
    pretraining: PretrainingConfig = field(default_factory=PretrainingConfig)
    """The start."""
    ddpg: DDPGConfig = field(default_factory=DDPGConfig)
    """The learner."""

    def check(self) -> TrainConfig:
        """Itself.

        Raises:
            ValueError: names the field, its value and what is allowed.
        """
        plants.resolve(self.plant)
        self.pretraining.check()
        self.ddpg.check()
        for name in ("seeds", "devices", "steps", "environments", "updates", "epoch", "reward_scale"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
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
        most = self.steps - (0 if self.pretraining.gradient_steps else 1)  # what is pretrained may stay as it is
        if not self.ddpg.batch_size <= self.prefill <= most:
            raise ValueError(
                f"prefill is {self.prefill}; it must lie between the batch size, {self.ddpg.batch_size}, "
                f"and the {self.steps} steps"
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
        return -(-(self.steps - self.prefill) // self.epoch)

    @property
    def identification_episodes(self) -> int:
        """Episodes recorded before the training, of each seed."""
        recorded = self.pretraining.episodes if self.pretraining.gradient_steps else 0
        return recorded + (LEVELS if self.residual else 0)

    @property
    def total_updates(self) -> int:
        """Gradient updates of one seed."""
        return (self.steps - self.prefill) // self.environments * self.updates


PAPER = TrainConfig(plant="pitch", preset="paper", prefill=200)
DEFAULT = TrainConfig(
    plant="pitch",
    preset="default",
    steps=128_000,
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
PRETRAINED = replace(
    DEFAULT,
    preset="pretrained",
    steps=8_000,
    prefill=8_000,
    pretraining=PretrainingConfig(gradient_steps=1_000),
)
PRESETS: dict[str, dict[str, TrainConfig]] = {
    "pitch": {"default": DEFAULT, "paper": PAPER, "pretrained": PRETRAINED},
    "heaters": {
        "default": replace(
            DEFAULT,
            plant="heaters",
            steps=68_000,
            integral_steps=None,
            reward_scale=1.0,
            ddpg=replace(DEFAULT.ddpg, discount=0.95),
        ),
        "paper": replace(PAPER, plant="heaters", steps=400_000),
        "pretrained": replace(
            PRETRAINED,
            plant="heaters",
            integral_steps=None,
            reward_scale=1.0,
            pretraining=replace(PRETRAINED.pretraining, lags=5),
            ddpg=replace(DEFAULT.ddpg, discount=0.95),
        ),
    },
}


def preset(plant: str, name: str = "default") -> TrainConfig:
    """The preset called `name` of a plant; a plant without presets of its own takes those of pitch.

    Raises:
        ValueError: unknown plant or preset; lists those that exist.
    """
    plants.resolve(plant)
    presets = PRESETS.get(plant, PRESETS["pitch"])
    if name not in presets:
        raise ValueError(f"there is no preset {name!r} for {plant}; the presets are: {', '.join(presets)}")
    return replace(presets[name], plant=plant)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """Plain dict, for JSON."""
    return dataclasses.asdict(config)


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """The configuration from what `to_dict` gave, also after a round trip through JSON.

    Raises:
        ValueError: a field is missing or unknown, or a value is not allowed.
    """

    def build(cls: type, values: dict[str, Any]) -> Any:
        names = {f.name for f in dataclasses.fields(cls)}
        if set(values) != names:
            raise ValueError(f"the configuration has fields {sorted(set(values) ^ names)} missing or unknown")
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})

    # Runs of versions that knew one device only, and no pretraining, go on as they were.
    nested = {
        "pretraining": build(PretrainingConfig, values.get("pretraining", dataclasses.asdict(PretrainingConfig()))),
        "ddpg": build(DDPGConfig, {"actor_from": 0, **values.get("ddpg", {})}),
    }
    return build(TrainConfig, {"devices": 1, **values, **nested})
