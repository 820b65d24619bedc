"""A training run that takes seconds."""

from dataclasses import replace

from jaxouter.training.config import PretrainingConfig, TrainConfig, preset

TINY = ["--pretraining.gradient-steps", "2", "--pretraining.episodes", "2", "--ddpg.hidden", "8", "8"]  # of the command


def small(plant: str = "heaters", name: str = "default", **changes) -> TrainConfig:
    """8 environments, tiny networks, 3 epochs of which the last is shorter; episodes end within it."""
    base = preset(plant, name)
    learner = replace(base.ddpg, hidden=(16, 16), batch_size=32, n_step=changes.pop("n_step", 1))
    fields = dict(steps=3_040, prefill=640, epoch=960, environments=8, updates=1, replay=1_600, history=3)
    fields |= dict(residual=False, pretraining=PretrainingConfig())
    return replace(base, ddpg=learner, **{**fields, **changes})
