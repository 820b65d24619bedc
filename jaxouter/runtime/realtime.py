"""A real-time loop around a function `step(r_tilde) -> y`: clock, deadlines, faults, and the choice of policy."""

from __future__ import annotations

import gc
import math
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.loop.policy import LinearLaw
from jaxouter.runtime.controller import Transfer, Watch
from jaxouter.runtime.online import WHYS, Kept, Live, LiveState, Sample, Stage, Why
from jaxouter.training import gate

RESERVE = 0.1  # share of a period kept free of updates
FORGET = 0.9  # decay per update of the longest update time seen
NAP = 0.2  # s, longest sleep before `stop` is asked again
BLOCKS, BLOCK = 10, 20  # blocks on whose mean rewards policies are judged, and control steps of each
SURE = 2.0  # standard errors by which one must be better than what acts to take its place


class StepError(Exception):
    """The user's function failed, or did not return a number."""


@dataclass(frozen=True)
class Timing:
    """Settings of the loop."""

    dt: float
    """Period, s."""
    learn: bool = False
    record: int = 500
    """Control steps before the response and the static inverse are identified; the LQ law is after twice as many."""
    most_updates: int = 8
    """Most updates per period."""
    transfer_steps: int = 10
    """Control steps in which r~ moves from one policy's to the next one's."""


class Row(NamedTuple):
    """One control step: r and y as measured, the r~ applied, and what the compared policies would have given."""

    step: int
    time: float  # s, when it was due
    r: float
    y: float | None
    r_tilde: float
    why: Why
    y_passed: float | None  # predicted y if r had passed through all the time
    y_kept: float | None  # predicted y if the fallback had acted
    y_learned: float | None  # predicted y if the newest learned policy had acted


class Loop:
    """The loop in time: call `step` once per period, and `learn` in the rest of it.

    If r~ is not chosen within the period (a missed deadline), or y is not finite or out of range, r passes through for
    that step; the policy acts again at the next one. The grid of periods is kept: whole periods that were missed are
    skipped.

    Every 200 steps what the agent has learned by then becomes the next candidate. It takes over if on the 200 steps
    after that its predicted reward is better than that of what acts, see `jaxouter.training.gate`. If what acts turns
    out worse than the fallback, this returns, for as many updates as at the start.
    """

    def __init__(
        self,
        live: Live,
        state: LiveState,
        plant: Callable[[float], Any],
        reference: Callable[[int], float],
        settings: Timing,
        begin: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Compiles everything that it will call.

        Args:
            live, state: policy and learner.
            plant: applies r~, and returns the y measured then; None: it is missing.
            reference: gives r of a control step.
            settings: of the loop.
            begin: time of the first row, s.
            clock: gives the time, s.

        Raises:
            ValueError: an update takes longer than a period.
        """
        self.live, self.settings = live, settings
        self.act_seconds = array("f")
        self.accepted = self.refused = 0  # candidates
        self.sent_back = 0  # times that what was accepted turned out worse than the fallback
        self.trouble: str | None = None  # why the response is not identified yet
        self._state = state if settings.learn else state._replace(noise=jnp.zeros_like(state.noise))
        self._plant, self._reference, self._clock = plant, reference, clock
        self._counts = dict(zip(WHYS, np.asarray(state.counts).tolist(), strict=True))
        self._float = np.dtype(jnp.result_type(float)).type
        self._stage: Stage = live.stage(state)
        self._r_tilde = self._clip(reference(self.steps))
        self._watch = Watch(self._r_tilde, self._r_tilde, live.env.plant.divergence_bounds, settings.dt, math.inf, 1)
        self._transfer = self._from_here()
        self._met = self._unbroken = False  # whether there was a y yet; whether the previous step was without fault
        self._written = int(state.replay.written)
        self._updates = int(state.updates)
        self._identify_at, self._law_at = settings.record, 2 * settings.record
        self._laws: Iterator[LinearLaw | None] | None = None  # the LQ law in the making
        self._unlearned = jax.device_get(live.fresh(state.key).agent)
        self._takeover_at = live.takeover
        self._known = bool(np.any(state.response.b))
        self._window: list[tuple[float, ...]] = []  # of the blocks: rewards of those judged, whether r changed
        self._compile()
        self._fastest = self._longest = self._update_takes() if settings.learn else 0.0
        self._begin, self._period = begin, 0
        self.start()

    def start(self) -> None:
        """Make the next step due now."""
        self._origin = self._clock() - self._period * self.settings.dt

    @property
    def steps(self) -> int:
        """Control steps so far."""
        return sum(self._counts.values())

    @property
    def counts(self) -> dict[Why, int]:
        """Control steps by what decided r~."""
        return dict(self._counts)

    @property
    def updates(self) -> int:
        """Updates so far."""
        return self._updates

    @property
    def stage(self) -> Stage:
        """What decides r~ if nothing is wrong."""
        return self._stage

    @property
    def fallback(self) -> Kept:
        """What acts while the learned policy does not."""
        return self.live.fallback(self._state)

    @property
    def state(self) -> LiveState:
        """The current state."""
        counts, updates = (jnp.asarray(x, jnp.int32) for x in (list(self._counts.values()), self._updates))
        return self._state._replace(counts=counts, updates=updates)

    @property
    def left(self) -> float:
        """Seconds until the next step is due; negative if overdue."""
        return self._origin + self._period * self.settings.dt - self._clock()

    def step(self) -> Row:
        """One control step, now.

        Raises:
            StepError: the plant failed.
        """
        dt, before = self.settings.dt, self._state.sample
        skipped = max(0, math.floor(-self.left / dt))
        self._period += skipped
        due, k = self._period, self.steps
        r = self._reference(k)
        y = self._measured()
        begun = self._clock()
        fault: Why | None = self._watch.judge(r, y, None)
        r_seen, y_seen = (self._float(value) for value in self._watch.within())
        if not self._met:
            before = self.live.first(r_seen, y_seen)
            self._met = fault is None
        actors = self._state.kept, self._state.incumbent
        memory, offered = self.live.act(actors, self._state.base, before, self._state.noise, r_seen, y_seen)
        kept, learned = np.asarray(offered).tolist()
        wanted = {"recording": r, self.fallback: kept, "learned": learned}
        self._period += 1
        if self.left < 0.0 or (skipped and self._unbroken):
            fault = "late"
        elif fault is None and not math.isfinite(wanted[self._stage]):
            fault = "not finite"
        self._apply(r if fault else wanted[self._stage], fault is None)
        self.act_seconds.append(self._clock() - begun)
        why = fault or self._stage
        self._counts[why] += 1
        y_others = self._note(before, memory, r_seen, y_seen, fault is None)
        return Row(k, round(self._begin + due * dt, 9), r, y, self._r_tilde, why, *y_others)

    def learn(self) -> None:
        """Identify or update, as long as there is time before the next step."""
        if not self.settings.learn:
            return
        if not self._known and self._written >= self._identify_at:
            self._identify()
        elif self._known and self.fallback == "static" and self._written >= self._law_at:
            self._find_law()
        enough = self._written >= self.live.data.batch_size and self._stage != "recording"
        for _ in range(self.settings.most_updates if enough else 0):
            begun = self._clock()
            if self._longest > self.left - RESERVE * self.settings.dt:
                self._longest = max(self._fastest, FORGET * self._longest)
                break
            number = np.uint32(self._updates)
            agent = self.live.update(self._state.agent, self._state.replay, self._state.base, self._state.key, number)
            self._state = self._state._replace(agent=jax.block_until_ready(agent))
            self._updates += 1
            self._longest = max(self._fastest, FORGET * self._longest, self._clock() - begun)

    def _measured(self) -> float | None:
        try:
            y = self._plant(self._r_tilde)
        except Exception as error:
            raise StepError(f"it failed: {type(error).__name__}: {error}") from error
        try:
            return None if y is None else float(y)
        except (TypeError, ValueError):
            raise StepError(f"it returned {y!r}; it must return a number, or None if there is none") from None

    def _apply(self, wanted: float, controls: bool) -> None:
        """A fault, and its end, switch at once; between policies the difference fades out."""
        if controls:
            self._r_tilde = self._transfer.apply(wanted, True)
        else:
            self._r_tilde = self._transfer.r_tilde = self._clip(wanted)

    def _clip(self, r_tilde: float) -> float:
        low, high = self.live.observer.r_tilde_bounds
        return min(max(r_tilde, low), high)

    def _from_here(self) -> Transfer:
        bounds, steps = self.live.observer.r_tilde_bounds, self.settings.transfer_steps
        return Transfer(self._r_tilde, bounds, math.inf, steps, controls=False)

    def _enter(self, stage: Stage) -> None:
        self._stage, self._transfer = stage, self._from_here()
        self._state = self._state._replace(leads=jax.device_put(np.bool_(stage == "learned")))

    def _note(self, before: Sample, memory: Any, r: Any, y: Any, fine: bool) -> Sequence[float | None]:
        """Record the step in state and replay; returns the predicted y of the compared policies."""
        state, follows = self._state._replace(sample=before), fine and self._unbroken
        age: Any = np.int32(before.age + 1 if follows else 0)
        held: Any = np.int32(before.held + 1 if r == before.r else 0)
        now = Sample(memory, r, y, self._float(self._r_tilde), age, held)
        self._unbroken = fine
        if not (self.settings.learn or self._known):
            self._state = state._replace(sample=now)
            return [None] * 3
        rest, actor = state._replace(agent=None, replay=None), self.live.agent.actor(state.agent)
        others, noise, rows, y_others, gained = self.live.relive(rest, actor, now, np.uint32(self.steps))
        if self.settings.learn:
            state = state._replace(noise=noise)
        if self.settings.learn and follows:
            state = state._replace(replay=self.live.write(state.replay, rows))
            self._written += 1
        self._state = state._replace(sample=now, others=others)
        if not self._known:
            return [None] * 3
        passed, kept, _, candidate = np.asarray(y_others).tolist()
        if follows and self._stage != "recording":
            self._window.append((*np.asarray(gained).tolist()[1:], float(held == 0)))
        if len(self._window) == BLOCKS * BLOCK:
            self._judge(np.asarray(self._window))
        return [passed, kept, candidate]

    def _judge(self, window: np.ndarray) -> None:
        """Replace what acts by the candidate or the fallback if that is better, and choose the next candidate."""
        blocks = window.reshape(BLOCKS, BLOCK, -1).mean(1)
        of_kept, of_candidate = np.asarray(judged(*blocks.T)).tolist()
        if self._stage == "learned" and of_kept > SURE:
            self.sent_back += 1
            self._takeover_at = self._updates + self.live.takeover
            self._enter(self.fallback)
        elif self.settings.learn and self._updates >= self._takeover_at:
            accepted = of_candidate > SURE
            self.accepted, self.refused = self.accepted + accepted, self.refused + (not accepted)
            if accepted:
                self._state = self._state._replace(incumbent=self._state.candidate)
                self._enter("learned")
        self._next_candidate()

    def _next_candidate(self) -> None:
        self._window.clear()
        self._state = self._state._replace(candidate=self.live.snapshot(self._state.agent))

    def _identify(self) -> None:
        """Identify the response, and the static inverse if r has passed through so far."""
        try:
            base, response = self.live.identify(self._state.replay)
        except ValueError as error:
            self.trouble, self._identify_at = str(error), self._written + self.settings.record
            return
        others = self.live.gathered(self._state.sample)
        self._state, self._known = self._state._replace(response=response, others=others), True
        self.trouble = None
        if self._stage == "recording":
            replay = self.live.relabelled(self._state.replay, base)
            self._state = self._state._replace(replay=replay, base=base, begun=jax.device_put(np.True_))
            self._enter(self.fallback)

    def _find_law(self) -> None:
        """Go on making the LQ law; once there is one it acts, and learning begins anew on top of it."""
        try:
            self._laws = self._laws or self.live.laws(self._state.replay, self._state.response)
            law = next(self._laws)
        except ValueError as error:
            self.trouble, self._laws, self._law_at = str(error), None, self._written + self.settings.record
            return
        if law is not None:
            replay, agent = self.live.relabelled(self._state.replay, law), jax.device_put(self._unlearned)
            self._state = self._state._replace(replay=replay, base=law, agent=agent)
            self._takeover_at, self.trouble = self._updates + self.live.takeover, None
            self._enter(self.fallback)
            self._next_candidate()

    def _compile(self) -> None:
        """Compile on copies, as the learner's buffers are donated."""
        live, state = self.live, self._state
        r = y = self._float(live.observer.y_middle)
        sample = live.first(r, y)
        actor = live.agent.actor(state.agent)
        live.act((state.kept, state.incumbent), state.base, sample, state.noise, r, y)
        rest = state._replace(agent=None, replay=None)
        rows = live.relive(rest, actor, sample, np.uint32(0))[2]
        live.gathered(sample)
        live.snapshot(state.agent)
        judged(*np.zeros((4, BLOCKS)))
        if self.settings.learn:
            replay = live.write(jax.tree.map(jnp.copy, state.replay), rows)
            if live.kept == "static":
                live.relabelled(replay, state.base)

    def _update_takes(self) -> float:
        """The fastest of some updates, s."""
        agent, took = jax.tree.map(jnp.copy, self._state.agent), []
        for _ in range(10):
            begun = self._clock()
            agent = self.live.update(agent, self._state.replay, self._state.base, self._state.key, np.uint32(0))
            jax.block_until_ready(agent)
            took.append(self._clock() - begun)
        if min(took) > (1.0 - RESERVE) * self.settings.dt:
            raise ValueError(
                f"the period is {self.settings.dt:g} s; an update takes {min(took):.2g} s here, and must fit into "
                f"{1.0 - RESERVE:.0%} of a period for --learn"
            )
        return min(took)


@jax.jit
def judged(kept: jax.Array, incumbent: jax.Array, candidate: jax.Array, changed: jax.Array) -> jax.Array:
    """By how many standard errors fallback and candidate are better than what acts; (2,).

    0 for a candidate that is worse in some kind of reference; the fallback, which is known, takes back by the mean.

    Args:
        kept, incumbent, candidate: mean rewards of blocks (B,).
        changed: share of the steps of each in which r changed.
    """
    found = gate.judge(jnp.stack([kept, candidate]) - incumbent[None], gate.kind(changed))
    tiny = jnp.finfo(found.error.dtype).tiny
    return jnp.where(found.better | np.array([True, False]), found.gain / jnp.maximum(found.error, tiny), 0.0)


def run(
    loop: Loop,
    steps: int | None = None,
    stop: Callable[[], bool] = lambda: False,
    report: Callable[[Row], None] = lambda row: None,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Run for some control steps, or until told to stop.

    Args:
        loop: the loop.
        steps: how many; None: no end.
        stop: asked before each step and while waiting.
        report: called with each row after r~ is applied.
        sleep: sleeps for so many seconds.

    Raises:
        StepError: the plant failed.
    """
    end = math.inf if steps is None else loop.steps + steps
    with _no_garbage():
        loop.start()
        while loop.steps < end:
            while not stop() and (left := loop.left) > 0.0:
                sleep(min(left, NAP))
            if stop():
                return
            report(loop.step())
            loop.learn()


@contextmanager
def _no_garbage() -> Iterator[None]:
    """Exempt existing objects from garbage collection, which would take longer than a period."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
