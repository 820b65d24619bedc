"""The training pipeline: prefill, then epochs in which environments roll out in parallel and the learner updates.

Everything that training changes is one pytree, `TrainState`; `prefill` and `epoch` are pure functions of it, jitted and
donated. Plain Python between them draws progress, evaluates and saves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxouter.agents import noise
from jaxouter.agents.ddpg import DDPG, Batch, LearnerState, n_step_return
from jaxouter.agents.replay import Replay, ReplayState
from jaxouter.loop import environment, identify
from jaxouter.loop.environment import Environment, EnvParams, EnvState
from jaxouter.loop.observation import Signals
from jaxouter.loop.policy import AffineParams
from jaxouter.loop.references import SetPoint
from jaxouter.plants import make as make_plant
from jaxouter.training.config import TrainConfig
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from jaxouter.training.pretraining import Rehearsal, Say, pretrain

FIELDS = (*Signals._fields, "action", "reward", "terminated", "truncated")
DIVERGED = FIELDS.index("terminated")
AXIS = "environments"  # over the shards of a learner
PRETRAINING = 1  # folded into a key
DIAGNOSIS = 2  # likewise
EPISODES = 16  # of a diagnosis
HOLD = 0.1  # probability that the random action of the prefill is redrawn at a step


class TrainState(NamedTuple):
    """All training state of one seed."""

    learner: LearnerState
    replay: ReplayState
    env: EnvState  # (E, ...)
    obs: jax.Array  # (E, n)
    noise: jax.Array  # (E,), exploration noise
    prior: AffineParams  # of the policy
    key: chex.PRNGKey
    steps: jax.Array  # int32, environment steps so far


@dataclass(frozen=True)
class Trainer:
    """The pure functions of one training run, or of one of the shards into which its environments are split.

    Static and hashable. Shards run as members of the mapped axis `AXIS`; learner, key and counters are the same in all.
    """

    config: TrainConfig  # environments and batch size are those of one shard
    env: Environment
    policy: LearnedPolicy
    replay: Replay  # of one shard
    shards: int = 1

    @property
    def learner(self) -> DDPG:
        """The learner inside the policy."""
        return self.policy.learner

    @property
    def reward_scale(self) -> float:
        """From the plant's reward to the learner's, whatever the unit of y."""
        return self.config.reward_scale / self.env.plant.error_scale

    def start(
        self,
        seed: int,
        params: EnvParams,
        report: Callable[[Rehearsal, Callable[[], TrainState]], None] = lambda at, state: None,
        begin: Rehearsal | None = None,
        devices: int = 1,
        say: Say = lambda what, done, of: None,
    ) -> TrainState:
        """State before the prefill.

        The static prefilter is identified where the policy is its residual, and the actor pretrained where that is
        configured, on so many devices of this process, from where a rehearsal of the same seed was stopped or from its
        beginning; `report` is called with the rehearsal so far, and with what gives the state with its actor; `say`
        with what is going on.

        Raises:
            ValueError: the identification failed.
        """
        key_prior, key = jax.random.split(jax.random.key(seed))
        say("compiling", 0, 0)
        state = self._fresh(key, params)
        if self.config.residual:
            say("recording", 0, 0)
            state = state._replace(prior=identify.static(self.env.plant, params.plant, key_prior)[1])
        if self.config.pretraining.gradient_steps:
            key_start = jax.random.fold_in(key_prior, PRETRAINING)
            cfg, plant, learned = self.config.pretraining, self.env.plant, self.policy_params(state)

            def heard(at: Rehearsal, actor: Callable[[], Any]) -> None:
                report(at, lambda: state._replace(learner=state.learner._replace(actor=actor())))

            actor = pretrain(cfg, plant, params.plant, self.policy, learned, key_start, heard, begin, devices, say)
            target = jax.tree.map(jnp.copy, actor)  # the state is donated, and no buffer twice
            state = state._replace(learner=state.learner._replace(actor=actor, target_actor=target))
        return state

    @partial(jax.jit, static_argnums=0, compiler_options=identify.RUN_ONCE)
    def _fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        return self.fresh(key, params)

    def fresh(self, key: chex.PRNGKey, params: EnvParams) -> TrainState:
        """Random networks, reset environments, an empty replay; a zero action is the middle of the range of r~."""
        key, key_learner, key_env = jax.random.split(key, 3)
        environments = self.config.environments
        low, high = self.env.plant.r_tilde_bounds
        obs, env = jax.vmap(self.env.reset, (0, None))(jax.random.split(key_env, environments), params)
        return TrainState(
            learner=self.learner.init(key_learner),
            replay=self.replay.init(),
            env=env,
            obs=obs,
            noise=jnp.zeros(environments),
            prior=AffineParams(jnp.zeros(()), jnp.asarray((low + high) / 2, float)),
            key=key,
            steps=jnp.zeros((), jnp.int32),
        )

    def policy_params(self, state: TrainState) -> LearnedParams:
        """What the policy has learned so far."""
        return LearnedParams(state.learner.actor, state.prior)

    def keys(self, state: TrainState, steps: int, n: int) -> list[chex.PRNGKey]:
        """N keys for each of the next `steps` steps of all environments, (steps,) each, of this shard alone.

        They depend on the number of the step, not on where an epoch began. Numbers are drawn from them for all steps
        at once, before the loop: within it each draw would cost as much as a small matrix product.
        """
        numbers = state.steps + self.config.environments * self.shards * jnp.arange(steps, dtype=state.steps.dtype)
        key = state.key if self.shards == 1 else jax.random.fold_in(state.key, jax.lax.axis_index(AXIS))
        return list(jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), n), out_axes=1)(numbers))

    def vector_step(
        self, state: TrainState, params: EnvParams, action: jax.Array, keys: chex.PRNGKey
    ) -> tuple[TrainState, jax.Array, jax.Array, jax.Array]:
        """Every environment takes one step with its action (E,) and key (E,).

        Returns:
            The state, rows (E, width) for the replay, rewards (E,) as the plant gives them, and whether each episode
            ended (E,).
        """
        before = state.env
        r_tilde = jax.vmap(self.policy.r_tilde, (None, 0, 0))(state.prior, before.r, action)
        obs, env, reward, terminated, truncated, info = jax.vmap(self.env.step, (0, 0, 0, None))(
            keys, before, r_tilde, params
        )
        signals = Signals(
            r=before.r,
            y=before.y_seen,
            integral=before.memory.integral,
            r_tilde=r_tilde,
            age=before.k.astype(reward.dtype),
            r_next=info["r"],
            y_next=info["y"],
        )
        flags = [flag.astype(reward.dtype) for flag in (terminated, truncated)]
        row = jnp.stack([*signals, action, reward * self.reward_scale, *flags], -1)
        state = state._replace(
            env=env,
            obs=obs,
            steps=state.steps + self.config.environments * self.shards,
        )
        return state, row, reward, terminated | truncated

    def batch(self, replay: ReplayState, bits: jax.Array) -> Batch:
        """A batch of transitions, built from windows of signals, drawn by random bits (B, 2), uint32."""
        cfg = self.config.ddpg
        windows, _ = self.replay.sample(replay, bits)

        def transition(rows: jax.Array) -> Batch:
            field = dict(zip(FIELDS, rows.T, strict=True))
            signals = Signals(*(field[name] for name in Signals._fields))
            first = self.replay.lead
            reward, discount, used = n_step_return(
                field["reward"][first:], field["terminated"][first:] > 0, field["truncated"][first:] > 0, cfg.discount
            )
            obs, next_obs = self.env.observer.before_and_after(signals, first, first + used)
            return Batch(obs, field["action"][first][None], reward, discount, next_obs)

        return jax.vmap(transition)(windows)

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def prefill(self, state: TrainState, params: EnvParams) -> TrainState:
        """Random actions, each held for ten steps on average, until the replay holds `config.prefill` steps."""
        environments = self.config.environments
        steps = self.config.prefill // (environments * self.shards)
        keys_redraw, keys_action, keys_env = self.keys(state, steps, 3)
        redraw = jax.vmap(lambda key: jax.random.uniform(key, (environments,), float) < HOLD)(keys_redraw)
        fresh = jax.vmap(lambda key: jax.random.uniform(key, (environments,), float, -1.0, 1.0))(keys_action)
        held = jax.lax.cummax(jnp.where(redraw, jnp.arange(steps)[:, None], 0))  # the step of the last redraw
        actions = jnp.take_along_axis(fresh, held, 0)

        def step(state: TrainState, xs: tuple[jax.Array, chex.PRNGKey]) -> tuple[TrainState, None]:
            state, rows, *_ = self.vector_step(state, params, *xs)
            return state._replace(replay=self.replay.write(state.replay, rows)), None

        return jax.lax.scan(step, state, (actions, self._keys_env(keys_env)))[0]

    def _keys_env(self, keys: chex.PRNGKey) -> chex.PRNGKey:
        """Keys (steps,) -> (steps, E)."""
        return jax.vmap(lambda key: jax.random.split(key, self.config.environments))(keys)

    @partial(jax.jit, static_argnums=(0, 3), donate_argnums=1)
    def epoch(self, state: TrainState, params: EnvParams, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        """`steps` environment steps (over all environments of all shards) of exploration and learning.

        The updates of a step draw from the rows of all steps up to the last but one before it. The replay must hold
        more than one step.

        Returns:
            The state, and means over the epoch: the learner's metrics, `reward` (a step, with exploration), `diverged`
            (share of the steps that ended an episode so) and `no_action` (share of actions that were not finite and
            became zero).
        """
        cfg = self.config
        low, high = cfg.noise_sigma
        environments = cfg.environments * self.shards
        sigma = jnp.geomspace(low, high, environments) if environments > 1 else jnp.full(1, high)
        if self.shards > 1:
            first = jax.lax.axis_index(AXIS) * cfg.environments
            sigma = jax.lax.dynamic_slice_in_dim(sigma, first, cfg.environments)

        keys_noise, keys_env, keys_batch, keys_update = self.keys(state, steps // environments, 4)
        shape = (cfg.updates, cfg.ddpg.batch_size, 2)
        bits = jax.vmap(lambda key: jax.random.bits(key, shape, jnp.uint32))(keys_batch)
        gathered = jax.vmap(self.batch, (None, 0))
        xs = (
            jax.vmap(lambda key: jax.random.normal(key, state.noise.shape, state.noise.dtype))(keys_noise),
            self._keys_env(keys_env),
            jnp.roll(bits, -1, 0),  # of the next step
            jax.vmap(lambda key: jax.random.split(key, cfg.updates))(keys_update),
        )

        # The rows of a step are written, and its successor's batches gathered, as the next one begins: so environments,
        # updates and batches need nothing of each other within a step, and are made at the same time.
        def step(carry: tuple[TrainState, jax.Array, Batch], xs: Any) -> tuple[Any, dict[str, jax.Array]]:
            state, rows, batches = carry
            normal, keys_env, bits, keys_update = xs
            learner, replay = state.learner, self.replay.write(state.replay, rows)
            progress = state.steps.astype(float) / cfg.steps
            volatility = sigma * (1.0 + (cfg.noise_end - 1.0) * progress)
            explore = noise.ornstein_uhlenbeck(state.noise, normal, cfg.noise_theta, volatility)
            action = jnp.clip(self.learner.act(learner.actor, state.obs)[:, 0] + explore, -1.0, 1.0)
            finite = jnp.isfinite(action)
            action = jnp.where(finite, action, 0.0)
            state, rows, reward, done = self.vector_step(state, params, action, keys_env)

            def update(learner: LearnerState, xs: tuple[Batch, chex.PRNGKey]) -> tuple[LearnerState, Any]:
                return self.learner.update(learner, *xs)

            learner, metrics = jax.lax.scan(update, learner, (batches, keys_update))
            state = state._replace(learner=learner, replay=replay, noise=jnp.where(done, 0.0, explore))
            metrics = {**jax.tree.map(jnp.mean, metrics), "reward": jnp.mean(reward)}
            metrics |= {"diverged": jnp.mean(rows[:, DIVERGED]), "no_action": jnp.mean(jnp.where(finite, 0.0, 1.0))}
            return (state, rows, gathered(replay, bits)), metrics

        replay, rows = self.replay.take_back(state.replay)
        carry = state._replace(replay=replay), rows, gathered(replay, bits[0])
        (state, rows, _), metrics = jax.lax.scan(step, carry, xs)
        state = state._replace(replay=self.replay.write(state.replay, rows))
        metrics = jax.tree.map(jnp.mean, metrics)
        return state, metrics if self.shards == 1 else jax.lax.pmean(metrics, AXIS)

    @partial(jax.jit, static_argnums=0, compiler_options=identify.RUN_ONCE)
    def diagnose(self, state: TrainState, params: EnvParams) -> dict[str, jax.Array]:
        """What tells whether the learning is sound; of the state of all shards, which stays as it is.

        Returns:
            critic_gradient, actor_gradient: norms on one batch; replay_age: mean age of what is drawn, in environment
            steps; q_start, return_start: what the critic expects of fresh training episodes, and what came, discounted
            and in its scale, without exploration and bootstrapped where time is up.
        """
        key_batch, key_update, key_run = jax.random.split(jax.random.fold_in(state.key, DIAGNOSIS), 3)
        bits = jax.random.bits(key_batch, (self.config.ddpg.batch_size, 2), jnp.uint32)
        every = self.config.ddpg.policy_delay  # before an update that moves the actor
        learner = state.learner._replace(updates=jnp.full_like(state.learner.updates, every - 1))
        _, of_batch = self.learner.update(learner, self.batch(state.replay, bits), key_update, norms=True)
        expected, came = jax.vmap(self._episode, (0, None, None))(jax.random.split(key_run, EPISODES), state, params)
        rows = jnp.minimum(state.replay.written, self.replay.steps).astype(expected.dtype)
        return {name: of_batch[name] for name in ("critic_gradient", "actor_gradient")} | {
            "replay_age": self.config.environments * (rows - 1.0) / 2.0,
            "q_start": jnp.mean(expected),
            "return_start": jnp.mean(came),
        }

    def _episode(self, key: chex.PRNGKey, state: TrainState, params: EnvParams) -> tuple[jax.Array, jax.Array]:
        """Value that the first critic gives to an episode's start, and the discounted return."""
        learner, gamma = state.learner, self.config.ddpg.discount

        def value(obs: jax.Array) -> jax.Array:
            action = self.learner.act(learner.actor, obs)
            return self.learner.values(learner.critics[:1], obs[None], action[None])[0, 0]

        def step(carry: Any, key: chex.PRNGKey) -> tuple[Any, jax.Array]:
            obs, env, weight = carry
            r_tilde = self.policy.r_tilde(state.prior, env.r, self.learner.act(learner.actor, obs)[0])
            obs, env, reward, terminated, _, _ = self.env.step_env(key, env, r_tilde, params)
            return (obs, env, weight * gamma * jnp.where(terminated, 0.0, 1.0)), weight * reward

        key_reset, key_run = jax.random.split(key)
        obs, env = self.env.reset(key_reset, params)
        keys = jax.random.split(key_run, self.env.plant.episode_steps)
        (last, _, weight), rewards = jax.lax.scan(step, (obs, env, jnp.ones_like(env.y)), keys)
        return value(obs), self.reward_scale * jnp.sum(rewards) + weight * value(last)


def build(config: TrainConfig, shards: int = 1) -> tuple[Trainer, EnvParams]:
    """The trainer of a configuration (of one of so many shards of it), and the parameters of its environments.

    Raises:
        ValueError: the configuration does not fit together.
    """
    plant, _ = make_plant(config.check().plant)
    total_updates = config.total_updates
    env, params = environment.make(
        config.plant,
        history=config.history,
        integral_steps=config.integral_steps,
        goal=SetPoint(*plant.setpoint_range, config.redraw),
        drawn=config.randomise,
    )
    start = config.pretraining
    lags, most = start.lags or env.observer.history, (start.episode_steps or plant.episode_steps) // 2
    if start.gradient_steps and lags > most:
        raise ValueError(f"pretraining.lags is {lags}; it must be at most half a recorded episode, {most}")
    # The replay never holds more than there is, and little where nothing is learned from it.
    least = 2 * (env.observer.history + config.ddpg.n_step)
    per_environment = max(least, min(config.replay, config.steps) // config.environments)
    config = replace(
        config,
        environments=config.environments // shards,
        ddpg=replace(config.ddpg, batch_size=config.ddpg.batch_size // shards),
        seed=0,  # the functions are the same for all seeds, and compiled once
        seeds=1,
        devices=1,
    )
    axis = AXIS if shards > 1 else None
    learner = DDPG(config.ddpg, env.observer.size, total_updates=total_updates, axis=axis)
    replay = Replay(FIELDS, config.environments, per_environment, env.observer.history, config.ddpg.n_step)
    return Trainer(config, env, LearnedPolicy(env.observer, learner), replay, shards), params
