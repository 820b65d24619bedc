"""A training run that takes seconds, and options of the command for a smaller one."""

from dataclasses import fields, replace

from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.rewards import RewardConfig
from jaxouter.training.config import PretrainingConfig, TrainConfig, preset

TINY = [
    "--pretraining.gradient-steps",
    "2",
    "--pretraining.episodes",
    "2",
    "--agent.hidden",
    "8",
    "8",
    "--base",
    "static",
    "--preset",
    "record",
]  # of the command


PAIRS = ["--pairs.rounds", "1", "--pairs.states", "64", "--pairs.environments", "4", "--pairs.horizon", "5"]
PAIRS += ["--pairs.updates", "4", "--pairs.batch-size", "16", "--compared", "16"]


def with_agent(config: TrainConfig, **changes) -> TrainConfig:
    """The configuration with other settings of its agent."""
    return replace(config, agent=replace(config.agent, **changes))


def small(plant: str = "heaters", name: str = "record", **changes) -> TrainConfig:
    """8 environments, tiny networks, 3 epochs of which the last is shorter; episodes end within it."""
    base = preset(plant, name)
    of_agent = dict(hidden=(16, 16), batch_size=32, n_step=1, prefill=640, updates=1, replay=1_600)
    of_agent |= {f.name: changes.pop(f.name) for f in fields(base.agent) if f.name in changes}
    own = dict(steps=3_040, epoch=960, environments=8, history=3, base="absolute", pretraining=PretrainingConfig())
    own |= dict(correction=1.0, reward=RewardConfig(), disturbances=Disturbances(), compared=0)
    return with_agent(replace(base, **{**own, **changes}), **of_agent)
