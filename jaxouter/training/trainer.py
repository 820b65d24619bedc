"""The trainer: a configuration as pure functions that start a training and continue it, epoch by epoch.

The state is one pytree, `TrainState`; `prefill` and `epoch` are jitted pure functions of it, and it is donated. Plain
Python in between shows progress, evaluates and saves (`jaxouter.training.epochs`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxouter.agents import Agent, OffPolicy
from jaxouter.agents.agent import OffPolicyAgent
from jaxouter.agents.pairs import PairsLearner
from jaxouter.agents.replay import Replay
from jaxouter.identification import bank, counterfactual, lq, steady_state, unstable
from jaxouter.identification.bank import Basis
from jaxouter.identification.records import Record, within
from jaxouter.loop import environment
from jaxouter.loop.environment import Environment, EnvParams
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.loop.policy import LinearLaw, none, padded
from jaxouter.loop.references import Family, SetPoint
from jaxouter.plants import Plant
from jaxouter.plants import make as make_plant
from jaxouter.plants.base import RUN_ONCE
from jaxouter.training.config import TrainConfig
from jaxouter.training.environments import AXIS, Environments, Kept, TrainState
from jaxouter.training.improvement import Improvement
from jaxouter.training.off_policy import FIELDS, OffPolicyDriver, Windows
from jaxouter.training.on_policy import OnPolicyDriver
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from jaxouter.training.pretraining import PretrainingState, Say, model_of, pretrain, recorded

PRETRAINING = 1  # folded into a key
DIAGNOSIS = 2  # likewise
BASE = 3  # likewise
PAIRS = 4  # likewise
CHECK = 5  # likewise
NEWEST = 0.3  # share of an epoch's actor in the average of actors


@dataclass(frozen=True)
class Trainer:
    """The pure functions of one training run, or of one shard of its learner. Static and hashable."""

    config: TrainConfig
    environments: Environments
    driver: OffPolicyDriver | OnPolicyDriver
    improvement: Improvement

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
        """The parameters of the policy: of the best actor so far, where actors are compared."""
        actor = state.kept.best if isinstance(state.kept, Kept) else self.agent.actor(state.agent)
        return LearnedParams(actor, state.base)

    @property
    def _keeps(self) -> bool:
        """Whether the agent's own epochs compare actors."""
        return bool(self.config.agent_epochs and self.config.compared)

    def with_actor(self, state: TrainState, actor: Any) -> TrainState:
        """The state with another actor, of the policy and of the agent."""
        best, average = (jax.tree.map(jnp.copy, actor) for _ in Kept._fields)  # copies, as the state is donated
        kept = Kept(best, average) if self._keeps else ()
        return state._replace(agent=self.agent.with_actor(state.agent, actor), kept=kept)

    def start(
        self,
        seed: int,
        params: EnvParams,
        report: Callable[[PretrainingState, Callable[[], TrainState]], None] = lambda at, state: None,
        begin: PretrainingState | None = None,
        devices: int = 1,
        say: Say = lambda what, done, of: None,
    ) -> TrainState:
        """State before the prefill: records the plant, makes the base law, and pretrains the actor, as configured.

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
        plant, start = self.env.plant, self.config.pretraining
        key_record, *keys = jax.random.split(jax.random.fold_in(key_base, PRETRAINING), 3)
        of_plant = self.config.base == "lq" or not plant.identified
        data, found = [], None  # base law and models, where one identification gives both
        if self.config.base == "bank":
            found = self._bank(params, key_record, say)
        elif self.config.records and of_plant:
            data = recorded(start, plant, params.plant, key_record, say)
            found = self._unstable(params, data[0], key_base, say) if start.closed_loop else None
        base = self._base(state.base, params, data, key_base, say) if found is None else found.base
        state = state._replace(base=base)
        if not start.gradient_steps:
            return state

        def reported(at: PretrainingState, actor: Callable[[], Any]) -> None:
            report(at, lambda: self.with_actor(state, actor()))

        if found is None:
            model, of_model = model_of(start, plant, params.plant, data, self.env.observer.history)
        else:
            model, of_model = counterfactual.plant(plant, found.params.a.shape[1]), found.params
        episodes = TrainingEpisodes(model, self.config.disturbances, self.config.reward)
        learned, more = self.policy_params(state), (reported, begin, devices, say)
        return self.with_actor(state, pretrain(start, episodes, of_model, self.policy, learned, keys, *more))

    def _base(
        self, middle: LinearLaw, params: EnvParams, data: Sequence[Record], key: chex.PRNGKey, say: Say
    ) -> LinearLaw:
        """The configured base law: `middle`, or one that is made here."""
        plant, kind, lags = self.env.plant, self.config.base, self.env.observer.lags
        if kind == "absolute":
            return middle
        if kind == "none":
            return none(plant)[1]
        say("recording", 0, 0)
        law = steady_state.static(plant, params.plant, key)[1]
        if kind == "static":
            return law
        data = [within(each, plant.divergence_bounds) for each in data]
        key_choose = jax.random.fold_in(key, BASE)
        found = lq.choose(plant, data, law, key_choose, self.env.observer.history, self.config.disturbances)
        lq.warn_short(plant, found.most)
        return padded(found.law if found.mae < found.static_mae else law, lags)

    def _bank(self, params: EnvParams, key: chex.PRNGKey, say: Say) -> Basis:
        """Bank of base laws, and the models of its plants."""
        start, members = self.config.pretraining, self.config.bank
        return bank.identify(
            self._longer,
            params.plant,
            members,
            key,
            self.env.observer.lags,
            start.episodes,
            start.closed_loop,
            lambda done: say("recording", done, len(members)),
        )

    def _unstable(self, params: EnvParams, data: Record, key: chex.PRNGKey, say: Say) -> Basis:
        """Base law and model of a plant that is unstable alone."""
        say("recording", 0, 0)
        plant, start, observer = self.env.plant, self.config.pretraining, self.env.observer
        static = steady_state.static(plant, params.plant, key)[1]
        of_law = jax.random.fold_in(key, BASE), observer.history, self.config.disturbances, static
        found = unstable.identify(self._longer, params.plant, data, *of_law, start.closed_loop)
        return Basis(padded(found.chosen.law, observer.lags), found.params)

    @property
    def _longer(self) -> Plant:
        """The plant with episodes as long as those recorded."""
        plant, start = self.env.plant, self.config.pretraining
        return replace(plant, episode_steps=start.episode_steps or plant.episode_steps)

    @partial(jax.jit, static_argnums=0, compiler_options=RUN_ONCE)
    def _fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        return self.fresh(key, params)

    def fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        """Random networks, reset environments, no data; a zero action is the middle of the range of r~."""
        state = self.driver.fresh(key, params)
        actor = self.agent.actor(state.agent)
        if self._keeps:
            state = self.with_actor(state, actor)
        if not self.config.pairs.rounds:
            return state
        return state._replace(pairs=self.improvement.init(jax.random.fold_in(state.key, PAIRS), actor))

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def prefill(self, state: TrainState, params: EnvParams) -> TrainState:
        """Runs before the first epoch; see the driver."""
        return self.driver.prefill(state, params)

    @partial(jax.jit, static_argnums=(0, 3), donate_argnums=1)
    def epoch(self, state: TrainState, params: EnvParams, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        """Explore and learn for `steps` environment steps; see the driver."""
        state, metrics = self.driver.epoch(state, params, steps)
        if not isinstance(state.kept, Kept):
            return state, metrics
        average = optax.incremental_update(self.agent.actor(state.agent), state.kept.average, NEWEST)
        return state._replace(kept=state.kept._replace(average=average)), metrics

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def improve(self, state: TrainState, params: EnvParams) -> tuple[TrainState, dict[str, jax.Array]]:
        """A round of pairs; see `Improvement`."""
        key = jax.random.fold_in(jax.random.fold_in(state.key, PAIRS), state.pairs.rounds)
        before = self.policy_params(state).actor
        pairs, actor, metrics = self.improvement.round(state.pairs, before, state.base, params, key)
        return self.with_actor(state._replace(pairs=pairs), actor), metrics

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def check(
        self, state: TrainState, params: EnvParams, final: chex.Numeric = True
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """Keep the better of two actors, by fresh episodes.

        In the end (`final`) the best actor so far is kept if it is better than the base law alone by more than the
        error, else the law. After an epoch of the agent the average of recent actors, which errs less than each, is
        kept if it is better than the best so far. The agent then learns on from its own actor, as it has to pass worse
        ones. Both are one function, so that it is compiled once.

        Returns:
            The state, and metrics as of `Improvement.better`.
        """
        final = jnp.asarray(final)
        rounds = state.pairs.rounds if self.config.pairs.rounds else 0  # other episodes before them
        key, best = jax.random.fold_in(jax.random.fold_in(state.key, CHECK), rounds), self.policy_params(state).actor
        nothing = jax.tree.map(jnp.zeros_like, best)  # the base law alone
        if not isinstance(state.kept, Kept):
            actor, metrics = self.improvement.better(nothing, best, state.base, params, key, 1.0)
            return self.with_actor(state, actor), metrics
        either = partial(jax.tree.map, partial(jnp.where, final))
        before, actor = either((nothing, best), (best, state.kept.average))
        key = jax.random.fold_in(jax.random.fold_in(key, state.steps), final)
        actor, metrics = self.improvement.better(before, actor, state.base, params, key, jnp.where(final, 1.0, 0.0))
        agent, average = either((self.agent.with_actor(state.agent, actor), actor), (state.agent, state.kept.average))
        return state._replace(agent=agent, kept=Kept(actor, average)), metrics

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
    least, greatest = config.redraws
    env, params = environment.make(
        config.plant,
        history=config.history,
        integral_steps=config.integral_steps,
        goal=SetPoint(*plant.setpoint_range, (least / plant.episode_steps, greatest / plant.episode_steps)),
        drawn=config.randomise,
        reward=config.reward,
        disturbances=config.disturbances,
    )
    start = config.pretraining
    lags, most = start.lags or env.observer.history, (start.episode_steps or plant.episode_steps) // 2
    if start.gradient_steps and lags > most:
        raise ValueError(f"pretraining.lags is {lags}; it must be at most half a recorded episode, {most}")
    if config.base == "lq":
        longer = replace(plant, episode_steps=start.episode_steps or plant.episode_steps)
        of_base = max(lq.lags_for(longer, env.observer.history))
        env = replace(env, observer=replace(env.observer, lags=of_base))
    if config.bank:
        bank.ranges(params.plant, config.bank)  # raises ValueError if a name is wrong
        env = replace(env, observer=replace(env.observer, lags=lags))
    observer = replace(env.observer, laws=len(config.bank))
    # The functions are the same for all seeds, so they are compiled once.
    config = replace(config, seed=0, seeds=1, devices=1)
    agent = config.agent.build(observer.size, config.agent_updates, AXIS if shards > 1 else None)
    environments = Environments(
        env,
        LearnedPolicy(observer, config.agent.hidden, config.correction * float(np.ptp(plant.r_tilde_bounds)) / 2),
        agent,
        count=config.environments // shards,
        steps=config.steps,
        reward_scale=config.reward_scale / plant.error_scale,
        shards=shards,
    )
    learner = PairsLearner(config.pairs, config.agent.hidden, env.observer.size)
    wandering = replace(env, goal=Family("redrawn", plant.episode_steps, *plant.setpoint_range))
    on = wandering if config.pairs.wander else env
    improvement = Improvement(on, environments.policy, agent, learner, environments.reward_scale, config.compared)
    return Trainer(config, environments, driver(config, environments), improvement), params


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
    windows = Windows(replay, of_shard, environments.policy, environments.env.plant, environments.reward_scale)
    return OffPolicyDriver(environments, cast(OffPolicyAgent, agent), windows)
