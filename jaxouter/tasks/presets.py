"""Presets that every plant has."""

from __future__ import annotations

from collections.abc import Mapping

from jaxouter.tasks.task import Options

PAPER: Options = {"agent": "ddpg", "agent.prefill": 200, "base": "absolute", "compared": 0}
RECORD: Options = {
    "steps": 0,
    "environments": 16,
    "epoch": 6_000,
    "base": "lq",
    "reward_scale": 0.1,
    "reward.huber": 0.003,
    "reward.rest": 0.05,
    "integral_steps": 20.0,
    "disturbances.noise": 0.015,
    "disturbances.load": 0.1,
    "pretraining.gradient_steps": 1_500,
    "agent": "ddpg",
    "agent.hidden": (128, 128),
    "agent.critic": "quadratic",
    "agent.hold": True,
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
DEFAULT: Options = {
    **RECORD,
    "reward.beta_h": 0.03,  # the paper has 0.1
    "disturbances.noise": 0.005,
    "pairs.rounds": 45,
}
SCRATCH: Options = {
    **RECORD,
    "base": "static",
    "redraws": (1.0, 20.0),
    "pretraining.gradient_steps": 0,
    "steps": 332_800,  # 26 episodes of each environment
    "environments": 64,
    "epoch": 12_800,
    "agent.n_step": 5,
    "agent.whiten": 0.2,
    "agent.updates": 3,
    "agent.prefill": 12_800,
    "agent.replay": 102_400,
    "agent.noise_sigma": (0.005, 0.03),
    "pairs.rounds": 36,
    "pairs.wander": False,
    "pairs.change": 0.1,
    "pairs.noise_sigma": (0.005, 0.03),
}
PRESETS: Mapping[str, Options] = {"default": DEFAULT, "scratch": SCRATCH, "record": RECORD, "paper": PAPER}
ON_POLICY: Options = {
    "pairs.rounds": 0,
    "epoch": 64_000,
    "steps": 5_132_800,
    "agent.hidden": (64, 64),
    "agent.unroll": 25,
    "agent.prefill": 12_800,
    "agent.sigma": 0.05,
    "agent.entropy": 0.03,  # else sigma shrinks, and with it what a step of the policy can be
}
LEARNERS: Mapping[str, Options] = {
    "td3": {
        "pairs.rounds": 0,
        "agent.actor_rate": 1e-3,  # of half as many updates as DDPG's
        "agent.polyak": 0.01,
        "agent.target_noise": 0.005,
        "agent.target_noise_clip": 0.0125,
    },
    "sac": {
        "pairs.rounds": 0,
        "agent.n_step": 8,
        "agent.temperature": 5e-3,
        "agent.temperature_rate": 1e-3,
        "agent.target_entropy": -1.2,
        "agent.sigma": 0.07,
    },
    "ppo": {**ON_POLICY, "agent.actor_rate": 1e-3, "agent.minibatches": 4},
    "trpo": {**ON_POLICY, "agent.kl": 0.02, "agent.damping": 100.0},  # as the Fisher matrix has 1 / sigma^2
}
"""What `scratch` has otherwise with other agents than its own: they learn without pairs."""
LIVE: Options = {  # an unknown plant in real time: an update must fit into milliseconds
    **RECORD,
    "agent.hidden": (64, 64),
    "agent.batch_size": 128,
    "agent.discount": 0.95,
}


def implied(preset: str, base: str, agent: str | None = None) -> str:
    """The preset that a choice of base law or agent implies: `default` is `scratch` without the LQ law or DDPG."""
    return "scratch" if preset == "default" and (base != "lq" or agent not in (None, DEFAULT["agent"])) else preset
