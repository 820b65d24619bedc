"""Agents: the learner interface, the learners, networks, exploration noise and replay. They know nothing of plants."""

from __future__ import annotations

from jaxouter.agents.agent import Agent, AgentConfig, OffPolicy, OnPolicy
from jaxouter.agents.ddpg import DDPGConfig, TD3Config
from jaxouter.agents.ppo import PPOConfig
from jaxouter.agents.sac import SACConfig
from jaxouter.agents.trpo import TRPOConfig

__all__ = ["AGENTS", "Agent", "AgentConfig", "OffPolicy", "OnPolicy", "name_of", "resolve"]

AGENTS: dict[str, type[AgentConfig]] = {
    "ddpg": DDPGConfig,
    "td3": TD3Config,
    "sac": SACConfig,
    "ppo": PPOConfig,
    "trpo": TRPOConfig,
}
"""The settings class of each learner, by name."""


def resolve(name: str) -> type[AgentConfig]:
    """The settings of the agent called `name`.

    Raises:
        ValueError: there is no such agent; lists those that exist.
    """
    if name not in AGENTS:
        raise ValueError(f"there is no agent {name!r}; the agents are: {', '.join(AGENTS)}, and FILE.py:CLASS")
    return AGENTS[name]


def name_of(config: AgentConfig) -> str:
    """The name under which the settings are registered.

    Raises:
        ValueError: they are not registered.
    """
    for name, kind in AGENTS.items():
        if kind is type(config):
            return name
    raise ValueError(f"{type(config).__name__} is not in jaxouter.agents.AGENTS; add it there, under a name")
