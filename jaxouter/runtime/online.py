"""Policy and learner of a real-time loop: pure, jitted functions of one state.

Without a trained policy, r passes through while a record is made. Then the static inverse identified from the record
acts, then the LQ law of a longer record, and later the policy learned on top of that. A trained policy acts unchanged
at first, and later what it has learned since. `jaxouter.runtime.realtime` is the loop in time.

Once the response of y to a change of r~ is known, each step is replayed under other r~
(`jaxouter.identification.counterfactual`), at no cost to the plant. Four of these replays predict what passing r
through, the fallback, the policy that acts and a candidate for its place would have achieved; the rest explore.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.agents import AgentConfig, OffPolicy, noise
from jaxouter.agents.agent import LiveAgent
from jaxouter.agents.replay import Replay, ReplayState
from jaxouter.identification import linear_models, lq
from jaxouter.identification.records import Record
from jaxouter.loop import rewards
from jaxouter.loop.environment import Environment
from jaxouter.loop.observation import Memory, Observer, Signals
from jaxouter.loop.policy import LinearLaw, affine, unclipped
from jaxouter.loop.references import SetPoint
from jaxouter.loop.rewards import RewardConfig
from jaxouter.plants import arx
from jaxouter.plants.arx import Model
from jaxouter.plants.simulators import PlantOptions
from jaxouter.runtime.controller import Reason
from jaxouter.tasks.presets import LIVE
from jaxouter.training.config import TrainConfig, configured, preset
from jaxouter.training.environments import TrainState
from jaxouter.training.off_policy import FIELDS, Windows
from jaxouter.training.policy import LearnedPolicy

Kept = Literal["static", "lq", "trained"]
Stage = Literal["recording", "learned"] | Kept
Why = Stage | Reason
WHYS: tuple[Why, ...] = (
    "recording", "static", "lq", "trained", "learned", "late", "missing", "not finite", "out of range"
)  # fmt: skip
NAME = "live"
FOLLOWS = Model(np.zeros(1), np.ones(1), np.zeros(()), np.zeros(()))  # y = r~ at once
HISTORY = 8  # past samples in the observation of an unknown plant
LAGS = 15  # past samples in its LQ law
NOISE, PRICES = 0.02, (0.1, 0.3, 1.0, 3.0, 10.0)  # of the LQ law, see `identification.lq`; the first that comes to rest
COMPARED = 4  # counterfactuals without exploration: r passed through, the fallback, the incumbent, the candidate
EXPLORING = 12  # counterfactuals that explore
SIGMA, THETA = (0.0125, 0.1), 0.15  # Ornstein-Uhlenbeck noise; sigma of the loop itself and of the last counterfactual
REDRAW = 0.02  # probability per step that an exploring counterfactual gets a new set-point
KEPT = 20_000  # control steps in the replay
RECENT = 2_000  # newest of them, from which the response is identified
AGREE = 0.2  # largest difference between the gains of both halves of the record, as share of the whole record's gain


class Sample(NamedTuple):
    """One control step: r and y as measured, and the r~ chosen. Scalars, except for the memory."""

    memory: Memory  # with e_k already integrated
    r: jax.Array
    y: jax.Array
    r_tilde: jax.Array
    age: jax.Array  # int32, control steps since the last interruption
    held: jax.Array  # int32, control steps since r last changed


class Response(NamedTuple):
    """Response of y to a change of r~: dy_(k+1) = sum_i a_i dy_(k-i) + b_i dr~_(k-i); zero until identified."""

    a: jax.Array  # (H,)
    b: jax.Array  # (H,)


class Others(NamedTuple):
    """Counterfactuals: the same steps under other r~; each leaf (O, ...)."""

    sample: Sample
    dy: jax.Array  # (O, H), differences to the measured y, newest first
    dr_tilde: jax.Array  # (O, H)
    noise: jax.Array  # (O,), exploration noise


class LiveState(NamedTuple):
    """State of a live loop."""

    agent: Any
    replay: ReplayState
    base: LinearLaw  # r~ of a zero action
    kept: Any  # fallback actor, from the start; if it is zero, the fallback is the static inverse
    incumbent: Any  # learned actor that acts if `leads`
    candidate: Any  # actor that is judged: the agent's, some steps ago
    begun: jax.Array  # bool, whether a base law is known (else r~ = r)
    leads: jax.Array  # bool, whether a learned policy acts
    response: Response
    sample: Sample  # of the last step
    others: Others
    noise: jax.Array  # exploration noise; 1 is half the range of r~
    key: chex.PRNGKey
    updates: jax.Array  # int32, of the agent
    counts: jax.Array  # (len(WHYS),), int32, control steps by what decided r~


@dataclass(frozen=True)
class Live:
    """Policy and learner. Static and hashable."""

    env: Environment  # declares the plant; never stepped
    policy: LearnedPolicy
    agent: LiveAgent
    data: OffPolicy
    reward_scale: float
    replay: Replay
    takeover: int
    """Updates before the learned policy may act."""
    kept: Kept
    """The fallback, which acts before that; static until there is an LQ law."""
    reward: RewardConfig = rewards.PAPER
    """Weights of the reward."""

    @classmethod
    def of(cls, config: TrainConfig, env: Environment, takeover: int, kept: Kept) -> Live:
        """From the configuration and environment of a run, or from `declared`.

        Args:
            config, env: agent and observation. An on-policy agent is replaced by the default off-policy one, which
                takes over its actor.
            takeover: updates before the learned policy may act; the actor is frozen for the first half of them.
            kept: the fallback, which acts before that.
        """
        chosen = config.agent
        if not isinstance(chosen.data, OffPolicy):
            chosen = cast(AgentConfig, replace(cast(Any, preset(config.plant).agent), hidden=chosen.hidden))
        agent = cast(LiveAgent, chosen.build(env.observer.size)).endless(takeover // 2)
        low, high = env.plant.r_tilde_bounds
        policy = LearnedPolicy(env.observer, chosen.hidden, config.correction * (high - low) / 2)
        replay = Replay(FIELDS, 1 + COMPARED + EXPLORING, KEPT, env.observer.history)
        scale = config.reward_scale / env.plant.error_scale
        return cls(env, policy, agent, cast(OffPolicy, agent.data), scale, replay, takeover, kept, config.reward)

    @property
    def observer(self) -> Observer:
        """The observer."""
        return self.env.observer

    @partial(jax.jit, static_argnums=0)
    def fresh(self, key: chex.PRNGKey) -> LiveState:
        """Initial state without a trained run: r~ = r."""
        key, key_agent = jax.random.split(key)
        zero, middle = jnp.zeros(()), jnp.asarray(self.observer.y_middle, float)
        sample, agent = self.first(middle, middle), self.agent.init(key_agent)
        nothing = jax.tree.map(jnp.zeros_like, self.agent.actor(agent))
        return LiveState(
            agent=agent,
            replay=self.replay.init(),
            base=affine(1.0, 0.0, self.observer.lags),
            kept=nothing,
            incumbent=nothing,
            candidate=nothing,
            begun=jnp.zeros((), bool),
            leads=jnp.zeros((), bool),
            response=Response(jnp.zeros(self.observer.history), jnp.zeros(self.observer.history)),
            sample=sample,
            others=self.gathered(sample),
            noise=zero,
            key=key,
            updates=jnp.zeros((), jnp.int32),
            counts=jnp.zeros(len(WHYS), jnp.int32),
        )

    def trained(self, key: chex.PRNGKey, state: TrainState, actor: Any) -> LiveState:
        """Initial state from a trained run, with fresh optimisers and targets."""
        fresh = self.fresh(key)
        if jax.tree.structure(state.agent) == jax.tree.structure(fresh.agent):
            agent = self.agent.restarted(state.agent)
        else:  # another kind of learner: take its actor alone
            agent = self.agent.with_actor(fresh.agent, actor)
        kept = self.snapshot(agent)
        trained = fresh._replace(agent=agent, kept=kept, incumbent=kept, candidate=kept)
        return trained._replace(base=state.base, begun=jnp.ones((), bool))

    def snapshot(self, agent: Any) -> Any:
        """A copy of the agent's actor, which outlives the agent's donation."""
        return jax.tree.map(jnp.copy, self.agent.actor(agent))

    def fallback(self, state: LiveState) -> Kept:
        """What acts while the learned policy does not."""
        return "lq" if self.kept == "static" and np.any(np.asarray(state.base.y_past)) else self.kept

    def stage(self, state: LiveState) -> Stage:
        """What decides r~ if nothing is wrong."""
        return "learned" if state.leads else self.fallback(state) if state.begun else "recording"

    @partial(jax.jit, static_argnums=0)
    def first(self, r: jax.Array, y: jax.Array) -> Sample:
        """The step before the first sample: the loop at rest at y."""
        r_tilde = jnp.clip(y, *self.observer.r_tilde_bounds)
        return Sample(self.observer.init(r, y), r, y, r_tilde, jnp.full((), -1, jnp.int32), jnp.zeros((), jnp.int32))

    @partial(jax.jit, static_argnums=0)
    def gathered(self, sample: Sample) -> Others:
        """Counterfactuals that start from the loop's current step."""
        n, history = COMPARED + EXPLORING, self.observer.history
        samples = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), sample)
        samples = samples._replace(age=jnp.full_like(samples.age, -1))
        return Others(samples, jnp.zeros((n, history)), jnp.zeros((n, history)), jnp.zeros(n))

    @partial(jax.jit, static_argnums=0)
    def act(
        self, actors: tuple[Any, ...], base: LinearLaw, before: Sample, explore: Any, r: jax.Array, y: jax.Array
    ) -> tuple[Memory, jax.Array]:
        """At t_k: the memory, and r~ (A,) of the actors, each with `explore` added."""
        memory = self.observer.record(before.memory, before.y, before.r_tilde)
        memory, obs = self.observer.observe(memory, r, y)
        actions = jnp.stack([self.policy.action(actor, obs) for actor in actors])
        actions = jnp.clip(actions + explore, -1.0, 1.0)
        return memory, jax.vmap(self.policy.r_tilde, (None, None, None, None, 0))(base, memory, r, y, actions)

    @partial(jax.jit, static_argnums=0)
    def relive(
        self, state: LiveState, actor: Any, now: Sample, step: jax.Array
    ) -> tuple[Others, jax.Array, jax.Array, jax.Array, jax.Array]:
        """Advance the counterfactuals to t_k.

        Args:
            state: before t_k; its agent and replay are not used.
            actor: of the counterfactuals that explore.
            now: the loop's step t_k.
            step: k, uint32.

        Returns:
            The counterfactuals; the loop's next exploration noise; rows (E, width) for the replay, of the step up to
            t_k; and y (4,) of the compared ones and their rewards (4,). Until the response is known, each row is the
            loop's.
        """
        key_noise, key_when, key_r = jax.random.split(jax.random.fold_in(state.key, step), 3)
        (low, high), n = self.env.plant.setpoint_range, COMPARED + EXPLORING
        others, before = state.others, state.others.sample
        compared = jnp.arange(n) < COMPARED
        other_r = jax.random.uniform(key_r, (n,), float, low, high)
        redrawn = jax.random.uniform(key_when, (n,), float) < REDRAW
        r = jnp.where(compared, now.r, jnp.where(redrawn, other_r, before.r))
        y = now.y + others.dy[:, 0]

        sigma = jnp.geomspace(*SIGMA, 1 + EXPLORING)
        before_noise = jnp.append(state.noise, others.noise[COMPARED:])
        normal = jax.random.normal(key_noise, before_noise.shape, before_noise.dtype)
        explore = noise.ornstein_uhlenbeck(before_noise, normal, THETA, sigma)
        other_noise = jnp.concatenate([jnp.zeros(COMPARED), explore[1:]])

        incumbent = jax.tree.map(partial(jnp.where, state.leads), state.incumbent, state.kept)
        actors, of_lane = (state.kept, incumbent, state.candidate, actor), jnp.asarray([0, 0, 1, 2] + [3] * EXPLORING)
        memory, r_tilde = jax.vmap(self.act, (None, None, 0, 0, 0, 0))(actors, state.base, before, other_noise, r, y)
        r_tilde = r_tilde[jnp.arange(n), of_lane].at[0].set(jnp.clip(now.r, *self.observer.r_tilde_bounds))
        dr_tilde = jnp.column_stack([r_tilde - now.r_tilde, others.dr_tilde[:, :-1]])
        dy = jnp.column_stack([others.dy @ state.response.a + dr_tilde @ state.response.b, others.dy[:, :-1]])
        row = self.row(state.base, state.sample, now.r, now.y)
        known = jnp.any(state.response.b != 0.0)
        rows = jnp.where(known, jax.vmap(self.row, (None, 0, 0, 0))(state.base, before, r, y), row[None])
        age = jnp.where(now.age == 0, 0, before.age + 1)
        held = jnp.where(r == before.r, before.held + 1, 0)
        others = Others(Sample(memory, r, y, r_tilde, age, held), dy, dr_tilde, other_noise)
        gained = rows[:COMPARED, FIELDS.index("reward")]
        return others, explore[0], jnp.concatenate([row[None], rows]), y[:COMPARED], gained

    def row(self, base: LinearLaw, before: Sample, r: jax.Array, y: jax.Array) -> jax.Array:
        """The replay's row for the step from sample `before` to r and y; (width,).

        Its action may lie beyond [-1, 1] if r passed through.
        """
        signals = Signals(
            r=before.r,
            y=before.y,
            integral=before.memory.integral,
            r_tilde=before.r_tilde,
            age=before.age.astype(y.dtype),
            r_next=r,
            y_next=y,
        )
        plant, earlier = self.env.plant, before.memory.r_tilde_past[0]
        price = rewards.params(plant, self.reward)
        held = before.held.astype(y.dtype)
        reward = rewards.reward(price, before.r, y, before.y, before.r_tilde, earlier, plant.reward_terms, held)
        action = (before.r_tilde - unclipped(base, before.memory, before.r, before.y)) / self.policy.scale
        never = jnp.zeros_like(y)
        return jnp.stack([*signals, action, self.reward_scale * reward, never, never, held, before.y, y])

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def write(self, replay: ReplayState, rows: jax.Array) -> ReplayState:
        """The replay with one more row for the loop and each counterfactual."""
        return self.replay.write(replay, rows)

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def relabelled(self, replay: ReplayState, base: LinearLaw) -> ReplayState:
        """The replay with its actions recomputed for another base law."""
        mirror, dtype = self.replay.mirror, base.r.dtype
        rings = replay.rows[:, mirror:]
        r, y, r_tilde, age = (rings[..., FIELDS.index(name)].astype(dtype) for name in ("r", "y", "r_tilde", "age"))
        starts = (jnp.arange(rings.shape[1], dtype=jnp.int32)[None] - age.astype(jnp.int32)) % rings.shape[1]
        y0 = jnp.take_along_axis(y, starts, 1)
        before = jnp.clip(y0, *self.observer.r_tilde_bounds)
        law = base.offset + base.r * r + base.y * y
        for i in range(1, self.observer.lags + 1):
            past, applied = (jnp.where(age >= i, jnp.roll(x, i, 1), x0) for x, x0 in ((y, y0), (r_tilde, before)))
            law = law + base.y_past[i - 1] * (past - y) + base.r_tilde_past[i - 1] * applied
        action = ((r_tilde - law) / self.policy.scale).astype(rings.dtype)
        rings = rings.at[..., FIELDS.index("action")].set(action)
        return replay._replace(rows=jnp.concatenate([rings[:, rings.shape[1] - mirror :], rings], 1))

    @partial(jax.jit, static_argnums=0, donate_argnums=1)
    def update(self, agent: Any, replay: ReplayState, base: LinearLaw, key: chex.PRNGKey, number: jax.Array) -> Any:
        """Update `number` (uint32) of the agent, from the replay."""
        key_batch, key_update = jax.random.split(jax.random.fold_in(key, number))
        bits = jax.random.bits(key_batch, (self.data.batch_size, self.data.bits), jnp.uint32)
        plant = self.env.plant
        windows = Windows(self.replay, self.data, self.policy, plant, self.reward_scale)
        transitions = windows.batch(replay, base, rewards.params(plant, self.reward), bits)
        return self.agent.update(agent, transitions, key_update)[0]

    def identify(self, replay: ReplayState) -> tuple[LinearLaw, Response]:
        """Identify the static inverse, r~ = (r - offset) / gain, and the response, by a linear model of recent steps.

        Raises:
            ValueError: the record is not informative enough; says why.
        """
        data = self._record(replay)
        half, least = len(data.y) // 2, 4 * data.y.shape[1]
        if half < least:
            raise ValueError(f"{len(data.y)} steps without interruption are too few; it takes {2 * least}")
        if np.ptp(data.r_tilde) == 0.0:
            raise ValueError("r~ has not moved")
        whole, *halves = (_model(Record(*(x[part] for x in data))) for part in (slice(None), *_halves(half)))
        gains = [linear_models.gain(model) for model in (whole, *halves)]
        if linear_models.radius(whole) >= 1.0 or not np.ptp(gains) <= AGREE * abs(gains[0]):
            of_all, first, last = (f"{each:.3g}" for each in gains)
            raise ValueError(
                f"the DC gain is uncertain: {of_all} from the whole record, {first} and {last} from its halves"
            )
        dtype = jnp.result_type(float)
        offset, nothing = -linear_models.offset(whole) / gains[0], np.zeros(self.observer.lags)
        found = (offset, 1.0 / gains[0], 0.0, nothing, nothing, whole.a, whole.b)
        *law, a, b = (jax.device_put(np.asarray(x, dtype)) for x in found)  # this way nothing is compiled
        return LinearLaw(*law), Response(a, b)

    def laws(self, replay: ReplayState, response: Response) -> Iterator[LinearLaw | None]:
        """The LQ law of recent steps, in pieces of work that fit into a period: None after each but the last.

        Raises:
            ValueError: no law comes to rest.
        """
        plant, n = self.env.plant, self.observer.lags
        of_y, of_r_tilde = (float(np.ptp(each)) / 2 for each in (plant.setpoint_range, plant.r_tilde_bounds))
        windows = self._record(replay, n)
        (model,) = lq.fits(Record(windows.r_tilde, windows.y), n, [NOISE * of_y], levels=False)
        yield None
        a, b = (np.asarray(each, np.float64) for each in response)
        for price in PRICES:
            found = lq.law(*model, price * (of_y / of_r_tilde) ** 2)
            if lq.comes_to_rest(found, a, b, plant.episode_steps):
                dtype = jnp.result_type(float)
                yield LinearLaw(*(jax.device_put(np.asarray(x, dtype)) for x in found))
                return
            yield None
        raise ValueError("no linear law made from the record comes to rest")

    def _record(self, replay: ReplayState, n: int | None = None) -> Record:
        """Windows of n (None: H) uninterrupted steps of the loop, each with the y after it."""
        layout, written = self.replay, int(replay.written)
        recent = np.arange(max(0, written - min(RECENT, layout.steps - layout.mirror)), written)
        rows = np.asarray(replay.rows)[0, recent % layout.steps + layout.mirror].astype(np.float64)
        field, n = dict(zip(FIELDS, rows.T, strict=True)), n or self.observer.history
        ends = np.flatnonzero(field["age"][n - 1 :] >= n - 1) + n - 1
        windows = ends[:, None] + np.arange(1 - n, 1)
        return Record(field["r_tilde"][windows], np.column_stack([field["y"][windows], field["y_next"][ends]]))


def _halves(half: int) -> tuple[slice, slice]:
    return slice(half), slice(half, None)


def _model(data: Record) -> Model:
    found = linear_models.fit_arx(data, data.r_tilde.shape[1], 0)
    return Model(found.a, found.b, found.c, found.sigma)


def declared(dt: float, episode_steps: int, options: PlantOptions) -> tuple[TrainConfig, Environment]:
    """Learner and environment for an unknown plant, from its ranges alone.

    Raises:
        ValueError: a range is wrong.
    """
    fields = options.declared(control_step=dt, episode_steps=episode_steps, y_unit="1")
    fields |= dict(name=NAME, time_unit="s", history=HISTORY, move_threshold=0.0)  # every move of r~ is charged
    plant, _ = arx.make(FOLLOWS, [FOLLOWS], **fields)
    observer = Observer.of(plant, lags=LAGS)
    return configured(NAME, "live", LIVE), Environment(plant, observer, SetPoint(*plant.setpoint_range))
