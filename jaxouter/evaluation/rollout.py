"""Roll-outs of any policy on the episodes of a scenario."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxouter.evaluation.scenarios import Scenario
from jaxouter.loop import closed_loop, rewards, sensor
from jaxouter.loop.closed_loop import LoopState
from jaxouter.loop.policy import Policy
from jaxouter.loop.rewards import RewardParams
from jaxouter.loop.sensor import SensorParams
from jaxouter.plants import Plant, host
from jaxouter.plants.base import excess, parameters


class Traces(NamedTuple):
    """What happened; arrays (episodes, T) but for y0. y is the output after each control step."""

    y0: Any  # (episodes,)
    r: Any
    y: Any
    r_tilde: Any
    reward: Any
    each_outside: Any  # share of the single outputs outside the limits; nan where the plant has no members
    each_excess: Any  # by how much the worst of them is
    members: Any  # (episodes, T, n) where asked for, else None


class _Inputs(NamedTuple):
    """What one episode is made of, beside the policy."""

    params: Any
    change: tuple[jax.Array, Any] | None
    sensor: SensorParams
    reward: RewardParams
    load: jax.Array | None  # (T,), added to r~ at the plant


def _axes(inputs: _Inputs) -> Any:
    """Which leaves have an axis of episodes, for vmap."""
    each = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, inputs.sensor)
    axes: Any = (0, None if inputs.change is None else (None, 0), each, None, None if inputs.load is None else 0)
    return _Inputs(*axes)


def _begin(plant: Plant, inputs: _Inputs, key: chex.PRNGKey) -> LoopState:
    key_start, key_sensor = jax.random.split(key)
    measure = partial(sensor.measure, inputs.sensor, key_sensor)
    return closed_loop.begin(plant, inputs.params, plant.init(key_start, inputs.params), measure)


def _diverged(r_tilde: jax.Array, y: jax.Array) -> tuple[jax.Array, tuple[()]]:
    """A policy that failed has diverged at once, even where a dead time would hide it until the episode is over."""
    return jnp.where(jnp.isnan(r_tilde), jnp.nan, y), ()


def _advance(
    plant: Plant,
    record: bool,
    inputs: _Inputs,
    loop: LoopState,
    k: jax.Array,
    r: jax.Array,
    r_tilde: jax.Array,
    key: chex.PRNGKey,
) -> tuple[LoopState, dict[str, jax.Array]]:
    """One control step of the loop under r~, and what is recorded of it."""
    key_plant, key_sensor = jax.random.split(key)
    params, measure = parameters(inputs.params, inputs.change, k), partial(sensor.measure, inputs.sensor, key_sensor)
    load = 0.0 if inputs.load is None else inputs.load[k]
    after, reward, _ = closed_loop.advance(
        plant, params, inputs.reward, loop, r, r_tilde, key_plant, measure, _diverged, load
    )
    out = dict(y=after.y, r_tilde=after.r_tilde, reward=reward)
    if plant.members is not None:
        members = plant.members(params, after.plant)
        over = excess(plant, members, plant.members(params, loop.plant))
        out |= dict(each_outside=jnp.mean(jnp.where(over > 0, 1.0, 0.0)), each_excess=jnp.max(over))
        out |= dict(members=members) if record else {}
    return after, out


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _rollout(
    plant: Plant,
    policy: Policy,
    record: bool,
    per_episode: bool,
    policy_params: Any,
    inputs: _Inputs,
    r: Any,
    keys: Any,
) -> Any:
    def episode(
        policy_params: Any, inputs: _Inputs, r: jax.Array, key: chex.PRNGKey
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        key_begin, key_policy, key_run = jax.random.split(key, 3)
        begun = _begin(plant, inputs, key_begin)

        def step(carry: tuple[LoopState, Any], x: Any) -> tuple[tuple[LoopState, Any], dict[str, jax.Array]]:
            loop, memory = carry
            k, r_k, key, key_act = x
            memory, r_tilde = policy.act(policy_params, memory, r_k, loop.y_seen, key_act)
            loop, out = _advance(plant, record, inputs, loop, k, r_k, r_tilde, key)
            return (loop, memory), out

        steps = r.shape[0]
        xs = (jnp.arange(steps), r, jax.random.split(key_run, steps), jax.random.split(key_policy, steps))
        memory = policy.init(policy_params, r[0], begun.y_seen)
        return begun.y, jax.lax.scan(step, (begun, memory), xs)[1]

    return jax.vmap(episode, (0 if per_episode else None, _axes(inputs), 0, 0))(policy_params, inputs, r, keys)


def some(scenario: Scenario, first: int, end: int) -> Scenario:
    """Some of the episodes of a scenario."""
    change = None if scenario.change is None else (scenario.change[0], _some(scenario.change[1], first, end))
    sensor = jax.tree.map(lambda leaf: leaf[first:end] if jnp.ndim(leaf) else leaf, scenario.sensor)
    episodes = {name: _some(getattr(scenario, name), first, end) for name in ("params", "r", "keys")}
    load = None if scenario.load is None else scenario.load[first:end]
    return replace(scenario, change=change, sensor=sensor, load=load, **episodes)


def _some(tree: Any, first: int, end: int) -> Any:
    return jax.tree.map(itemgetter(slice(first, end)), tree)


def rollout(
    policy: Policy,
    policy_params: Any,
    scenario: Scenario,
    record_members: bool = False,
    per_episode: bool = False,
) -> Traces:
    """Run a policy on every episode of a scenario, without an early end.

    Args:
        policy: JAX policies run jitted and vmapped; those with `host` True are called step by step with NumPy scalars
            and without key. An episode in which r~ is nan has diverged: its y is nan.
        policy_params: its parameters.
        scenario: the episodes.
        record_members: keep the single outputs (the temperature of each house) too.
        per_episode: each leaf of `policy_params` has a leading axis of episodes; otherwise all episodes share them.

    Returns:
        Traces as NumPy arrays.
    """
    most, episodes = host.side_by_side(scenario.plant), len(scenario.r)
    if most is not None and episodes > most:
        parts = []
        for i in range(0, episodes, most):
            own = _some(policy_params, i, i + most) if per_episode else policy_params
            parts.append(rollout(policy, own, some(scenario, i, i + most), record_members, per_episode))
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    plant = scenario.plant
    change = None if scenario.change is None else (jnp.asarray(scenario.change[0]), scenario.change[1])
    inputs = _Inputs(scenario.params, change, scenario.sensor, rewards.params(plant), scenario.load)
    run = _host_rollout if policy.host else _rollout
    y0, out = run(plant, policy, record_members, per_episode, policy_params, inputs, scenario.r, scenario.keys)
    out = {name: np.asarray(value) for name, value in out.items()}
    nothing = np.full(out["y"].shape, np.nan)
    return Traces(
        y0=np.asarray(y0),
        r=np.asarray(scenario.r),
        y=out["y"],
        r_tilde=out["r_tilde"],
        reward=out["reward"],
        each_outside=out.get("each_outside", nothing),
        each_excess=out.get("each_excess", nothing),
        members=out.get("members"),
    )


def outputs(policy: Policy, policy_params: Any, scenario: Scenario) -> jax.Array:
    """Y (episodes, T) as in `rollout`, of a JAX policy, within a function that is compiled."""
    inputs = _Inputs(scenario.params, None, scenario.sensor, rewards.params(scenario.plant), scenario.load)
    return _rollout(scenario.plant, policy, False, False, policy_params, inputs, scenario.r, scenario.keys)[1]["y"]


@partial(jax.jit, static_argnums=0)
def _begin_all(plant: Plant, inputs: _Inputs, keys: Any) -> LoopState:
    return jax.vmap(partial(_begin, plant), (_axes(inputs), 0))(inputs, keys)


@partial(jax.jit, static_argnums=(0, 1))
def _advance_all(
    plant: Plant, record: bool, inputs: _Inputs, run: LoopState, k: Any, r: Any, r_tilde: Any, keys: Any
) -> Any:
    step = partial(_advance, plant, record)
    return jax.vmap(step, (_axes(inputs), 0, None, 0, 0, 0))(inputs, run, k, r[:, k], r_tilde, keys[:, k])


def _act(policy: Policy, params: Any, memory: Any, r: Any, y: Any) -> tuple[Any, float]:
    """One act on the host; r~ is nan once y is not finite, or where the policy's arithmetic fails."""
    if not np.isfinite(y):
        return memory, np.nan
    try:
        memory, r_tilde = policy.act(params, memory, r, y)
    except (ArithmeticError, np.linalg.LinAlgError):
        return memory, np.nan
    return memory, float(r_tilde)


def _host_rollout(
    plant: Plant,
    policy: Policy,
    record: bool,
    per_episode: bool,
    policy_params: Any,
    inputs: _Inputs,
    r: Any,
    keys: Any,
) -> Any:
    """The same episodes with a policy in plain Python; start, plant and sensor have the keys of `_rollout`."""
    episodes, steps = r.shape
    key_begin, _, key_run = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(keys)
    run_keys = jax.vmap(lambda key: jax.random.split(key, steps))(key_run)
    params = [policy_params] * episodes
    if per_episode:
        params = [jax.tree.map(itemgetter(i), policy_params) for i in range(episodes)]
    run = _begin_all(plant, inputs, key_begin)
    y0, y_seen, r_host, outs = np.asarray(run.y), np.asarray(run.y_seen), np.asarray(r), []
    memories = [policy.init(*first) for first in zip(params, r_host[:, 0], y_seen, strict=True)]
    for k in range(steps):
        acts = [_act(policy, *seen) for seen in zip(params, memories, r_host[:, k], y_seen, strict=True)]
        memories = [memory for memory, _ in acts]
        r_tilde = np.array([value for _, value in acts], y0.dtype)
        run, out = _advance_all(plant, record, inputs, run, k, r, r_tilde, run_keys)
        y_seen, out = jax.device_get((run.y_seen, out))
        outs.append(out)
    return y0, {name: np.stack([out[name] for out in outs], 1) for name in outs[0]}
