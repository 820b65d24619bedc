"""Presets that every plant has. `paper` is the paper's training; `default` gives the best results known."""

from __future__ import annotations

from collections.abc import Mapping

from jaxouter.tasks.task import Options

PAPER: Options = {"agent": "ddpg", "agent.prefill": 200, "base": "absolute"}
DEFAULT: Options = {
    "steps": 0,
    "environments": 16,
    "epoch": 6_000,
    "base": "lq",
    "reward_scale": 0.1,
    "reward.huber": 0.003,
    "reward.rest": 0.05,
    "integral_steps": 20.0,
    "pretraining.gradient_steps": 1_500,
    "pretraining.noise": 0.015,
    "pretraining.load": 0.1,
    "agent": "ddpg",
    "agent.hidden": (128, 128),
    "agent.layer_norm": True,
    "agent.actor_rate": 3e-4,
    "agent.critic_rate": 1e-3,
    "agent.rate_decay": "cosine",
    "agent.critic_l2": 0.0,
    "agent.batch_size": 256,
    "agent.discount": 0.99,
    "agent.polyak": 0.005,
    "agent.saturation_penalty": 1e-3,
    "agent.updates": 4,
    "agent.prefill": 8_000,
    "agent.replay": 200_000,
    "agent.noise_sigma": (0.0125, 0.1),
}
PRESETS: Mapping[str, Options] = {"default": DEFAULT, "paper": PAPER}
LIVE: Options = {  # an unknown plant in real time: an update must fit into milliseconds
    **DEFAULT,
    "agent.hidden": (64, 64),
    "agent.batch_size": 128,
    "agent.discount": 0.95,
}
