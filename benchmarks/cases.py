"""The cases of the throughput benchmark; `throughput.py` runs each in a process of its own.

    python benchmarks/cases.py --list            # the cases, a line of JSON each
    python benchmarks/cases.py NAME SECONDS      # sets NAME up, then runs it for about SECONDS at each line of input

A case is a function that sets up and gives a `Job`. Answers are lines of JSON: first what is measured, then the figure
of each run.
"""

from __future__ import annotations

import json
import math
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxouter import plants
from jaxouter.agents import OffPolicy
from jaxouter.loop import environment
from jaxouter.loop.environment import Environment, EnvParams, EnvState
from jaxouter.training.config import PretrainingConfig, TrainConfig, preset, with_options
from jaxouter.training.devices import EIGEN, Fleet
from jaxouter.training.off_policy import OffPolicyDriver
from jaxouter.training.resources import arithmetic
from jaxouter.training.trainer import Trainer, TrainState, build

SGEMM, NORMALS = "sgemm_gflops", "normals_per_s"
ENVIRONMENTS = (1, 16, 256, 4_096, 16_384)
QUICK_ENVIRONMENTS = (16, 4_096)
SUBSTEPS = 10  # of heaters, an hour
HOUSES, PLANTS = 1_000, 256
FILLED = 4_096  # environment steps of the prefill; the replay is filled up with copies of them


@dataclass(frozen=True)
class Job:
    """Work that is set up and compiled."""

    call: Callable[[], Any]
    """Does it once and waits for it."""
    amount: float
    """Units of work a call."""
    unit: str
    """Of the rate; instead 's' for the time of a call, 'MiB' for the peak memory of the process after it."""
    of: str | None = None
    """Yardstick of the ratio."""
    extra: dict[str, float] = field(default_factory=dict)
    """Joins the row; `mflop`, of a unit of work, makes the ratio one of GFLOP/s."""


@dataclass(frozen=True)
class Case:
    """What is known of a case before it is set up."""

    setup: Callable[[], Job]
    quick: bool = False
    """Part of --quick."""
    fresh: bool = False
    """Every run has a process of its own."""
    cached: bool = False
    """Its processes share a compilation cache, filled by a run that does not count."""


def repeated(function: Callable[..., Any], state: Any, *args: Any) -> Callable[[], None]:
    """Calls `function(state, *args) -> state, out` again and again: jitted, the state donated, waiting for the end."""
    jitted = jax.jit(function, donate_argnums=0, compiler_options=EIGEN)

    def call() -> None:
        nonlocal state
        state, out = jitted(state, *args)
        jax.block_until_ready((state, out))

    return call


def sgemm() -> Job:
    n = 2_048
    a, b = np.random.default_rng(0).standard_normal((2, n, n), np.float32)
    out = np.empty_like(a)
    return Job(lambda: np.matmul(a, b, out=out), 2 * n**3 / 1e9, "GFLOP/s")


def normals() -> Job:
    shape = (1_000, 256)
    draw = jax.jit(lambda key: jax.random.normal(key, shape, jnp.float32))
    key = jax.random.key(0)
    return Job(lambda: jax.block_until_ready(draw(key)), math.prod(shape), "normals/s")


def numpy_hour(
    x: np.ndarray, x0: np.ndarray, k: int, r_tilde: np.ndarray, p: Any, rng: np.random.Generator, buffer: np.ndarray
) -> None:
    """One hour of identical houses (plants, n), in place: the heaters' Euler-Maruyama scheme as one writes it in NumPy.

    Args:
        x, x0: temperatures now and at the start of the episode, float32.
        k: hours since then.
        r_tilde: (plants, 1), float32.
        p: `HouseParams` of numbers.
        rng: of the noise.
        buffer: as x.

    Source: paper section IV.
    """
    h = 1.0 / SUBSTEPS
    per_x = 1.0 - h / p.Ca * (p.Ua + p.Pi / (p.Ca * p.r_u))
    per_r = 1.0 / (p.Ua / p.Ca + p.Pi / (p.Ca**2 * p.r_u) + p.phi)
    for i in range(SUBSTEPS):
        transient = p.gamma / (p.beta2 - p.lambda1) * math.exp(p.lambda1 * (k + i * h))
        per_x0 = h / p.Ca * (transient / (p.Ca * p.r_u) + p.Ua / p.Ca)
        per_plant = h / p.Ca * ((per_r - transient) / (p.Ca * p.r_u) * r_tilde + p.Ua * p.x_out * (1.0 - 1.0 / p.Ca))
        x *= per_x
        np.multiply(x0, per_x0, out=buffer)
        x += buffer
        x += per_plant
        rng.standard_normal(dtype=np.float32, out=buffer)
        buffer *= p.sigma * h**0.5
        x += buffer


def numpy_heaters() -> Job:
    rng = np.random.default_rng(0)
    p = jax.tree.map(float, plants.make("heaters")[1].house)
    x0 = rng.uniform(15.0, 25.0, (PLANTS, HOUSES)).astype(np.float32)
    r_tilde = rng.uniform(0.0, 40.0, (PLANTS, 1)).astype(np.float32)
    x, buffer = x0.copy(), np.empty_like(x0)
    hours = 10

    def call() -> None:
        for k in range(hours):
            numpy_hour(x, x0, k, r_tilde, p, rng, buffer)

    return Job(call, hours * x.size * SUBSTEPS, "house-substeps/s", NORMALS)


def steps_of(environments: int) -> int:
    """Control steps a call: enough that calling costs nothing."""
    return 2_000 if environments < 256 else 100


def pitch_plant(environments: int, one_delay: bool = False) -> Job:
    """Plants side by side that began together, each with a pilot delay of its own unless all share one."""
    plant, params = plants.make("pitch")
    key_tau, key_r_tilde, key = jax.random.split(jax.random.key(0), 3)
    steps = steps_of(environments)
    if not one_delay:
        params = replace(params, tau=jax.random.uniform(key_tau, (environments,), minval=0.106, maxval=0.5))
    rest = plant.init(key, params)
    side_by_side = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape, environments), leaf.dtype), rest)
    r_tilde = jax.random.uniform(key_r_tilde, (steps, environments), float, *plant.r_tilde_bounds)

    def run(state: Any, params: Any, r_tilde: jax.Array) -> tuple[Any, jax.Array]:
        def step(state: Any, r_tilde: jax.Array) -> tuple[Any, jax.Array]:
            state = plant.step(params, state, r_tilde, key)
            return state, plant.output(params, state)

        return jax.lax.scan(step, state._replace(k=rest.k), r_tilde)

    call = repeated(run, side_by_side._replace(k=jnp.zeros_like(rest.k)), params, r_tilde)
    return Job(call, steps * environments, "steps/s", NORMALS)


def heaters_plant(environments: int, unit: str = "steps/s", steps: int | None = None, **overrides: Any) -> Job:
    """Plants side by side; `unit` is steps/s, house-hours/s or house-substeps/s."""
    plant, params = plants.make("heaters", **overrides)
    key_init, key_r_tilde, key = jax.random.split(jax.random.key(0), 3)
    steps = steps or steps_of(environments)
    state = jax.vmap(plant.init, (0, None))(jax.random.split(key_init, environments), params)
    r_tilde = jax.random.uniform(key_r_tilde, (steps, environments), float, *plant.r_tilde_bounds)

    def run(carry: Any, params: Any, r_tilde: jax.Array) -> tuple[Any, jax.Array]:
        state, key = carry

        def step(carry: Any, r_tilde: jax.Array) -> tuple[Any, jax.Array]:
            state, key = carry
            key, key_step = jax.random.split(key)
            keys = jax.random.split(key_step, environments)
            state = jax.vmap(plant.step, (None, 0, 0, 0))(params, state, r_tilde, keys)
            return (state, key), jax.vmap(plant.output, (None, 0))(params, state)

        return jax.lax.scan(step, (state._replace(k=jnp.zeros_like(state.k)), key), r_tilde)

    call = repeated(run, (jax.tree.map(jnp.copy, state), key), params, r_tilde)  # no buffer donated twice
    amount = steps * environments * (1 if unit == "steps/s" else overrides["n"])
    return Job(call, amount * (SUBSTEPS if unit == "house-substeps/s" else 1), unit, NORMALS)


def vector_step(env: Environment) -> Callable[..., Any]:
    """`env.step` of many environments."""
    return jax.vmap(env.step, (0, 0, 0, None))


def roll_out(env: Environment, params: EnvParams, environments: int, act: Callable[..., jax.Array], given: Any) -> Job:
    """Whole environment steps with r~ = act(given, key, obs, state)."""
    steps = steps_of(environments)
    key_reset, key = jax.random.split(jax.random.key(0))
    obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(key_reset, environments), params)

    def run(carry: Any, params: EnvParams, given: Any) -> tuple[Any, Any]:
        def step(carry: Any, _: Any) -> tuple[Any, Any]:
            obs, state, key = carry
            key, key_act, key_env = jax.random.split(key, 3)
            r_tilde = act(given, key_act, obs, state)
            keys = jax.random.split(key_env, environments)
            obs, state, reward, terminated, truncated, _ = vector_step(env)(keys, state, r_tilde, params)
            return (obs, state, key), (jnp.mean(reward), jnp.any(terminated | truncated))

        return jax.lax.scan(step, carry, None, steps)

    call = repeated(run, jax.tree.map(jnp.copy, (obs, state, key)), params, given)
    return Job(call, steps * environments, "steps/s", NORMALS)


def random_roll_out(plant: str, environments: int) -> Job:
    env, params = environment.make(plant)
    low, high = env.plant.r_tilde_bounds

    def act(given: None, key: jax.Array, obs: jax.Array, state: EnvState) -> jax.Array:
        return jax.random.uniform(key, state.r.shape, state.r.dtype, low, high)

    return roll_out(env, params, environments, act, None)


def policy_roll_out(plant: str, environments: int) -> Job:
    trainer, params = build(preset(plant))
    learned = trainer.policy_params(trainer.fresh(jax.random.key(0), params))

    def act(learned: Any, key: jax.Array, obs: jax.Array, state: EnvState) -> jax.Array:
        action = jax.vmap(trainer.policy.action, (None, 0))(learned.actor, obs)
        of_each = jax.vmap(trainer.policy.r_tilde, (None, 0, 0, 0, 0))
        return of_each(learned.base, state.memory, state.r, state.y_seen, action)

    return roll_out(trainer.env, params, environments, act, learned)


def off_policy(trainer: Trainer) -> OffPolicyDriver:
    """The driver of a learner from a replay."""
    assert isinstance(trainer.driver, OffPolicyDriver)
    return trainer.driver


def training(
    plant: str, name: str, rows: int | None = None, devices: int = 1
) -> tuple[Trainer, EnvParams, TrainConfig]:
    """The learner of a preset, not pretrained, with a replay of so many rows (None: its own), one seed a device."""
    base = preset(plant, name)
    rows = rows or cast(OffPolicy, base.agent.data).replay
    options = {"agent.replay": rows, "agent.prefill": FILLED, "steps": 2 * rows, "epoch": FILLED}
    config = with_options(base, options | {"seeds": devices, "devices": devices})
    config = replace(config, pretraining=PretrainingConfig())
    return *build(config), config


def filled(trainer: Trainer, params: EnvParams) -> TrainState:
    """State with a full replay, so that a batch comes from all of it: what the prefill wrote, over and over."""
    state = trainer.prefill(trainer.start(0, params), params)
    rows, first = state.data.rows, off_policy(trainer).replay.mirror
    written = FILLED // off_policy(trainer).replay.environments
    rows = rows[:, first + jnp.arange(rows.shape[1]) % written]
    return state._replace(data=state.data._replace(rows=rows, written=jnp.asarray(off_policy(trainer).replay.steps)))


def update_mflop(config: TrainConfig) -> int:
    """FLOP of an update in millions, as the compiler counts them."""
    return round(arithmetic(config)[1] / 1e6)


def training_job(call: Callable[[], None], trainer: Trainer, config: TrainConfig, updates: int, fused: bool) -> Job:
    extra: dict[str, float] = {"mflop": update_mflop(config)}
    if fused:
        rows = off_policy(trainer).replay.steps * off_policy(trainer).replay.environments
        extra |= {"updates_per_step": off_policy(trainer).data.updates / config.environments, "replay": rows}
    return Job(call, updates, "updates/s", SGEMM, extra)


def update(plant: str, name: str) -> Job:
    """Updates alone, all with one batch."""
    trainer, params, config = training(plant, name)
    state, updates = filled(trainer, params), 100
    driver = off_policy(trainer)
    batch = driver.batch(state, params, jax.random.bits(state.key, (driver.data.batch_size, driver.data.bits)))

    def run(learner: Any, batch: Any) -> tuple[Any, Any]:
        keys = jax.random.split(jax.random.key(0), updates)
        return jax.lax.scan(lambda learner, key: trainer.agent.update(learner, batch, key), learner, keys)

    return training_job(repeated(run, state.agent, batch), trainer, config, updates, fused=False)


def products(plant: str, name: str) -> Job:
    """The matrix products of an update and nothing else: what is left of its rate is for everything else.

    Five passes forward, the gradients of the weights of two networks, and of the inputs of their second layers.
    """
    trainer, _, config = training(plant, name)
    batch, widths, updates = off_policy(trainer).data.batch_size, (trainer.env.observer.size, *config.agent.hidden), 100
    normal = partial(jax.random.normal, jax.random.key(0))
    passes = [[normal((a, b)) * (i + 1.0) for a, b in pairwise(widths)] for i in range(5)]  # no two are the same
    rows = [normal((batch, width)) for width in widths]

    def run(small: jax.Array, passes: Any, rows: Any) -> tuple[jax.Array, None]:
        def step(small: jax.Array, _: Any) -> tuple[jax.Array, None]:
            x = [row + small for row in rows]
            found = [x[i] @ weights[i] for weights in passes for i in range(len(weights))]
            for sign in (1.0, -1.0):
                found += [x[i].T @ (sign * rows[i + 1]) for i in range(len(widths) - 1)]
                found += [(sign * rows[i + 1]) @ passes[0 if sign > 0 else 1][i].T for i in range(1, len(widths) - 1)]
            return 1e-30 * sum((jnp.sum(product[:1, :1]) for product in found), jnp.zeros(())), None

        return jax.lax.scan(step, small, None, updates)

    call = repeated(run, jnp.zeros(()), passes, rows)
    return training_job(call, trainer, config, updates, fused=False)


def fused(plant: str, name: str, rows: int | None = None, devices: int = 1) -> Job:
    """Environment, replay and updates in one loop, as `jaxouter.train` runs them; one seed a device."""
    if devices > 1:
        jax.config.update("jax_num_cpu_devices", devices)
    trainer, params, config = training(plant, name, rows, devices)
    fleet, steps = Fleet.of(config), 100 * config.environments
    state = filled(trainer, params)
    states = fleet.put([state._replace(key=key) for key in jax.random.split(state.key, devices)])

    def call() -> None:
        nonlocal states
        states, _ = jax.block_until_ready(fleet.epoch(states, params, steps))

    return training_job(call, trainer, config, devices * 100 * off_policy(trainer).data.updates, fused=True)


def seeds_at_once(seeds: int) -> Job:
    """The paper's preset, so many seeds under vmap on one device."""
    trainer, params, config = training("pitch", "paper")
    one = filled(trainer, params)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * seeds), one)._replace(key=jax.random.split(one.key, seeds))

    def run(states: TrainState, params: EnvParams) -> tuple[TrainState, Any]:
        return jax.vmap(lambda state: trainer.epoch(state, params, 50))(states)

    return training_job(repeated(run, states, params), trainer, config, seeds * 50, fused=True)


def first_epoch(config: TrainConfig) -> Callable[[], Any]:
    """Everything up to the first epoch, or the first gradient steps of pretraining.

    They, prefill and epoch are so few that nearly all of it is compilation.
    """
    start = replace(config.pretraining, gradient_steps=min(config.pretraining.gradient_steps, 5))
    prefill = max(cast(OffPolicy, config.agent.data).batch_size, 10 * config.environments)
    config = with_options(replace(config, pretraining=start), {"agent.prefill": prefill})

    def call() -> None:
        fleet = Fleet.of(config)
        trainer, params = build(config)
        states = fleet.put([trainer.start(0, params)])
        if config.agent_epochs:
            states = fleet.prefill(states, params)
            jax.block_until_ready(fleet.epoch(states, params, 10 * config.environments))

    return call


def compilation(name: str) -> Job:
    """`first_epoch` of a preset on pitch, from nothing."""
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        from jaxouter.evaluation import cache  # what the command sets beside the folder; it takes a while to import

        cache.use_compilation_cache()
    return Job(first_epoch(preset("pitch", name)), 1, "s")


def memory_of_training(name: str, rows: int | None = None) -> Job:
    """Prefill and first epoch of a learner, with a replay of so many rows (None: the preset's own)."""
    return Job(first_epoch(training("pitch", name, rows)[2]), 1, "MiB")


def cases() -> Iterator[tuple[str, Case]]:
    """Name and case, in the order in which they run: neighbours share their rounds."""
    yield "fused/paper", Case(partial(fused, "pitch", "paper", 1_000_000), quick=True)
    yield "fused/paper/2-devices", Case(partial(fused, "pitch", "paper", 1_000_000, devices=2))
    yield "fused/default", Case(partial(fused, "pitch", "default"), quick=True)
    yield "fused/heaters-paper", Case(partial(fused, "heaters", "paper", 1_000_000))
    yield "fused/heaters-default", Case(partial(fused, "heaters", "default"))
    yield "update/paper", Case(partial(update, "pitch", "paper"), quick=True)
    yield "update/default", Case(partial(update, "pitch", "default"))
    yield "products/paper", Case(partial(products, "pitch", "paper"))
    yield "products/default", Case(partial(products, "pitch", "default"))
    for rows in (10_000, 100_000, 1_000_000):
        yield f"replay/{rows}", Case(partial(fused, "pitch", "paper", rows))
    for seeds in (1, 2, 4):
        yield f"seeds/{seeds}", Case(partial(seeds_at_once, seeds))
    for plant in ("pitch", "heaters"):
        alone = pitch_plant if plant == "pitch" else heaters_plant
        kinds = dict(plant=alone, rollout=partial(random_roll_out, plant), policy=partial(policy_roll_out, plant))
        for kind, setup in kinds.items():
            for n in ENVIRONMENTS:
                yield f"{kind}/{plant}/{n}", Case(partial(setup, n), quick=n in QUICK_ENVIRONMENTS and kind != "policy")
        if plant == "pitch":
            yield "plant/pitch-one-delay/4096", Case(partial(pitch_plant, 4_096, one_delay=True), quick=True)
    many = partial(heaters_plant, PLANTS, steps=100, n=HOUSES)
    shape = f"{HOUSES}x{PLANTS}"
    yield f"plant/heaters/{shape}", Case(partial(many, "house-substeps/s"), quick=True)
    yield f"plant/heaters-hourly/{shape}", Case(partial(many, "house-hours/s", law="hourly"), quick=True)
    yield f"plant/heaters-lumped/{shape}", Case(partial(many, "house-hours/s", law="lumped"))
    yield f"numpy/heaters/{shape}", Case(numpy_heaters, quick=True)
    one_plant = partial(heaters_plant, 1, "house-substeps/s", steps=1, n=10_000_000)
    yield "plant/heaters/10000000", Case(one_plant)
    yield "memory/heaters/10000000", Case(lambda: replace(one_plant(), unit="MiB", of=None), fresh=True)
    yield "memory/fused/paper", Case(partial(memory_of_training, "paper", 1_000_000), fresh=True)
    yield "memory/fused/default", Case(partial(memory_of_training, "default"), fresh=True)
    for name in ("paper", "default"):
        yield f"compile/{name}/cold", Case(partial(compilation, name), fresh=True)
        quick = name == "default"
        yield f"compile/{name}/cached", Case(partial(compilation, name), fresh=True, cached=True, quick=quick)


YARDSTICKS = {SGEMM: Case(sgemm, quick=True), NORMALS: Case(normals, quick=True)}


def peak_memory() -> float:
    """Of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, KiB elsewhere


def timed(function: Callable[[], Any], repeats: int = 1) -> float:
    """Seconds that so many calls take."""
    begin = time.perf_counter()
    for _ in range(repeats):
        function()
    return time.perf_counter() - begin


def serve(case: Case, seconds: float) -> None:
    """Set up, answer what is measured, then answer each line of input with a run of about so many seconds."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is no answer
    job = case.setup()
    repeats = 1
    if not case.fresh:
        job.call()
        repeats = max(1, math.ceil(seconds / timed(job.call)))
    print(json.dumps({"unit": job.unit, "of": job.of, "extra": job.extra}), file=answers)
    for _ in sys.stdin:
        passed = timed(job.call, repeats) / repeats
        value = {"s": passed, "MiB": peak_memory()}.get(job.unit, job.amount / passed)
        print(json.dumps({"value": value}), file=answers)


def main(arguments: list[str]) -> None:
    everything = YARDSTICKS | dict(cases())
    if arguments == ["--list"]:
        for name, case in everything.items():
            flags = dict(yardstick=name in YARDSTICKS, quick=case.quick, fresh=case.fresh, cached=case.cached)
            print(json.dumps({"name": name, **flags}))
    elif len(arguments) == 2 and arguments[0] in everything:
        serve(everything[arguments[0]], float(arguments[1]))
    else:
        raise SystemExit(f"error: {' '.join(arguments)!r} is neither --list nor NAME SECONDS with the name of a case")


if __name__ == "__main__":
    main(sys.argv[1:])
