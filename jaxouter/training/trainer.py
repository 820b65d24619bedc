"""The trainer: a configuration as pure functions that start a training and continue it, epoch by epoch.

The state is one pytree, `TrainState`; `prefill` and `epoch` are jitted pure functions of it, and it is donated. Plain
Python in between shows progress, evaluates and saves (`jaxouter.training.epochs`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import chex
import jax

from jaxouter.agents import Agent, OffPolicy
from jaxouter.agents.agent import OffPolicyAgent
from jaxouter.agents.replay import Replay
from jaxouter.identification import steady_state
from jaxouter.loop import environment
from jaxouter.loop.environment import Environment, EnvParams
from jaxouter.loop.references import SetPoint
from jaxouter.plants import make as make_plant
from jaxouter.plants.base import RUN_ONCE
from jaxouter.training.config import TrainConfig
from jaxouter.training.environments import AXIS, Environments, TrainState
from jaxouter.training.off_policy import FIELDS, OffPolicyDriver
from jaxouter.training.on_policy import OnPolicyDriver
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from jaxouter.training.pretraining import PretrainingState, Say, pretrain

PRETRAINING = 1  # folded into a key
DIAGNOSIS = 2  # likewise


@dataclass(frozen=True)
class Trainer:
    """The pure functions of one training run, or of one shard of its learner. Static and hashable."""

    config: TrainConfig
    environments: Environments
    driver: OffPolicyDriver | OnPolicyDriver

    @property
    def env(self) -> Environment:
        """One environment."""
        return self.environments.env

    @property
    def policy(self) -> LearnedPolicy:
        """The policy, without exploration."""
        return self.environments.policy

    @property
    def agent(self) -> Agent:
        """The learner."""
        return self.environments.agent

    def policy_params(self, state: TrainState) -> LearnedParams:
        """The current parameters of the policy."""
        return self.environments.policy_params(state)

    def updates(self, state: TrainState) -> int:
        """Updates so far."""
        return self.agent.data.total_updates(int(state.steps), self.environments.total)

    def start(
        self,
        seed: int,
        params: EnvParams,
        report: Callable[[PretrainingState, Callable[[], TrainState]], None] = lambda at, state: None,
        begin: PretrainingState | None = None,
        devices: int = 1,
        say: Say = lambda what, done, of: None,
    ) -> TrainState:
        """State before the prefill.

        Identifies the static prefilter if it is the policy's base law, and pretrains the actor if configured.

        Args:
            seed, params: of the training; of the environments.
            report: called with the state of the pretraining, and a function that gives the training state with its
                actor.
            begin: state from which to resume the pretraining of this seed; None: from its start.
            devices: of this process, for the pretraining.
            say: see `Say`.

        Raises:
            ValueError: the identification failed.
        """
        key_base, key = jax.random.split(jax.random.key(seed))
        say("compiling", 0, 0)
        state = self._fresh(key, params)
        plant = self.env.plant
        if self.config.residual:
            say("recording", 0, 0)
            state = state._replace(base=steady_state.static(plant, params.plant, key_base)[1])
        if self.config.pretraining.gradient_steps:
            key_start = jax.random.fold_in(key_base, PRETRAINING)
            cfg, learned = self.config.pretraining, self.policy_params(state)

            def with_actor(actor: Any) -> TrainState:
                return state._replace(agent=self.agent.with_actor(state.agent, actor))

            def reported(at: PretrainingState, actor: Callable[[], Any]) -> None:
                report(at, lambda: with_actor(actor()))

            actor = pretrain(
                cfg,
                plant,
                params.plant,
                self.policy,
                learned,
                key_start,
                reported,
                begin,
                devices,
                say,
                self.config.reward,
            )
            state = with_actor(actor)
        return state

    @partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
    def _fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        return self.fresh(key, params)

    def fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        """Random networks, reset environments, no data; a zero action is the middle of the range of r~."""
        return self.driver.fresh(key, params)

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def prefill(self, state: TrainState, params: EnvParams) -> TrainState:
        """Runs before the first epoch; see the driver."""
        return self.driver.prefill(state, params)

    @partial(jax.jit, static_argnums=(0, 3), donate_argnums=1)
    def epoch(self, state: TrainState, params: EnvParams, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        """Explore and learn for `steps` environment steps; see the driver."""
        return self.driver.epoch(state, params, steps)

    @partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
    def diagnose(self, state: TrainState, params: EnvParams) -> dict[str, jax.Array]:
        """Diagnostics of the learning; see the driver. The state is not changed."""
        return self.driver.diagnose(state, params, jax.random.fold_in(state.key, DIAGNOSIS))


def build(config: TrainConfig, shards: int = 1) -> tuple[Trainer, EnvParams]:
    """The trainer of a configuration (or of one of `shards` shards), and the parameters of its environments.

    Raises:
        ValueError: the configuration is inconsistent.
    """
    plant, _ = make_plant(config.check().plant)
    env, params = environment.make(
        config.plant,
        history=config.history,
        integral_steps=config.integral_steps,
        goal=SetPoint(*plant.setpoint_range, config.redraw),
        drawn=config.randomise,
        reward=config.reward,
    )
    start = config.pretraining
    lags, most = start.lags or env.observer.history, (start.episode_steps or plant.episode_steps) // 2
    if start.gradient_steps and lags > most:
        raise ValueError(f"pretraining.lags is {lags}; it must be at most half a recorded episode, {most}")
    # The functions are the same for all seeds, so they are compiled once.
    config = replace(config, seed=0, seeds=1, devices=1)
    agent = config.agent.build(env.observer.size, config.total_updates, AXIS if shards > 1 else None)
    environments = Environments(
        env,
        LearnedPolicy(env.observer, config.agent.hidden),
        agent,
        count=config.environments // shards,
        steps=config.steps,
        reward_scale=config.reward_scale / plant.error_scale,
        shards=shards,
    )
    return Trainer(config, environments, driver(config, environments)), params


def driver(config: TrainConfig, environments: Environments) -> OffPolicyDriver | OnPolicyDriver:
    """The driver for the agent's kind of data."""
    agent, data = environments.agent, environments.agent.data
    if not isinstance(data, OffPolicy):
        return OnPolicyDriver(environments, agent, data)
    history = environments.env.observer.history
    # The replay is no larger than the training is long, and small if nothing is learned from it.
    least = 2 * (history + data.n_step)
    per_environment = max(least, min(data.replay, config.steps) // config.environments)
    replay = Replay(FIELDS, environments.count, per_environment, history, data.n_step)
    of_shard = replace(data, batch_size=data.batch_size // environments.shards)
    return OffPolicyDriver(environments, cast(OffPolicyAgent, agent), of_shard, replay)
