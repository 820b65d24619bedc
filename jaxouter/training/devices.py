"""Several devices or processes: the mesh, the layout of the state on it, and communication between processes.

Seeds are split over the first axis of the mesh. The environments of each learner, with their share of the replay and of
each batch, are split over the second. One device is a mesh of one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, TypeVar

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxouter.loop.environment import EnvParams
from jaxouter.plants.base import RUN_ONCE
from jaxouter.training.config import TrainConfig
from jaxouter.training.environments import AXIS, TrainState
from jaxouter.training.trainer import Trainer, build

SEEDS = "seeds"
MEMBERS = "members"
# On CPUs use Eigen for matrix products instead of YNNPACK, the default of jax 0.10: 5 % faster, and 10 % if devices
# share cores.
EIGEN = {"xla_cpu_experimental_ynn_fusion_type": ""}
Tree = TypeVar("Tree")

SEED: Any = P(SEEDS)
ENVIRONMENT: Any = P(SEEDS, AXIS)


@dataclass(frozen=True)
class Processes:
    """How this process finds the others. None: there are none, or JAX finds them (SLURM, Kubernetes)."""

    coordinator: str | None = None
    num_processes: int | None = None
    process_id: int | None = None

    def check(self, devices: int) -> Processes:
        """Check the options; returns them.

        Raises:
            ValueError: names the option, its value and what is allowed.
        """
        coordinator, count, number = self.coordinator, self.num_processes, self.process_id
        if coordinator is None and count is None and number is None:
            return self
        if coordinator is None or count is None or number is None:
            raise ValueError("--coordinator, --num-processes and --process-id go together; give all three or none")
        if count < 1 or devices % count:
            raise ValueError(f"--num-processes is {count}; it must divide --devices, which is {devices}")
        if not 0 <= number < count:
            raise ValueError(f"--process-id is {number}; it must lie in 0 to {count - 1}")
        host, _, port = coordinator.rpartition(":")
        if not host or not port.isdecimal():
            raise ValueError(f"--coordinator is {coordinator!r}; it must be HOST:PORT of process 0")
        return self


def connect(devices: int, processes: Processes) -> None:
    """Make CPU devices (used if there is nothing but the CPU) and join the other processes; call before any use of JAX.

    With more than one device, JAX finds the other processes by itself in a SLURM step of several tasks and in an
    indexed Kubernetes job.

    Args:
        devices: in all processes together.
        processes: checked.

    Raises:
        ValueError: the processes did not connect.
    """
    tasks = int(os.environ.get("SLURM_STEP_NUM_TASKS", "1"))
    found = devices > 1 and (tasks > 1 or "JOB_COMPLETION_INDEX" in os.environ)
    count = processes.num_processes or (tasks if found else 1)
    if devices // count > 1 and "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        _make_cpu_devices(devices // count)
    if processes.coordinator is None and not found:
        return
    try:
        jax.distributed.initialize(processes.coordinator, processes.num_processes, processes.process_id)
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"the processes did not connect: {error}") from None


def part() -> None:
    """Disconnect: from here on no process waits for the others."""
    if jax.distributed.is_initialized():
        jax.distributed.shutdown()


def _make_cpu_devices(count: int) -> None:
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        return  # JAX is in use already; `mesh` checks the number of devices


def mesh(config: TrainConfig) -> Mesh:
    """Devices (seeds, environments) of a run, the same number from each process.

    Raises:
        ValueError: there are too few devices, or they can't be split evenly.
    """
    processes = jax.process_count()
    if config.devices % processes:
        raise ValueError(f"devices is {config.devices}; it must be a multiple of the {processes} processes")
    each = config.devices // processes
    by_process = [[d for d in jax.devices() if d.process_index == process] for process in range(processes)]
    if min(map(len, by_process)) < each:
        there = ", ".join(map(str, jax.devices()))
        wanted = f"devices is {config.devices}" + (f", {each} of each process" if processes > 1 else "")
        raise ValueError(f"{wanted}; it must be at most what there is: {there}")
    devices = np.array([devices[:each] for devices in by_process])
    return Mesh(devices.reshape(config.side_by_side, config.shards), (SEEDS, AXIS))


def is_first() -> bool:
    """Whether this process is the one that writes, evaluates and prints."""
    return jax.process_index() == 0


def any_process(flag: bool) -> bool:
    """Whether the flag is set in any process; must be called in all of them."""
    return flag if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def text_from_first(make: Callable[[], str]) -> str:
    """The result of `make`, called in the first process only, in all processes.

    Raises:
        ValueError, OSError: `make` raised it; raised in all processes.
    """
    if jax.process_count() == 1:
        return make()
    text, failed = "", 0
    if is_first():
        try:
            text = make()
        except (ValueError, OSError) as error:
            text, failed = str(error), 1 if isinstance(error, ValueError) else 2
    content = np.frombuffer(text.encode(), np.uint8)
    size, failed = multihost_utils.broadcast_one_to_all((np.int32(content.size), np.int32(failed)))
    text = bytes(multihost_utils.broadcast_one_to_all(np.resize(content, int(size)))).decode()
    if failed:
        raise ValueError(text) if failed == 1 else OSError(text)
    return text


def in_first(act: Callable[[], None]) -> None:
    """Call `act` in the first process only; its errors are raised in all, see `text_from_first`."""

    def text() -> str:
        act()
        return ""

    text_from_first(text)


def state_from_first(make: Callable[[], TrainState], like: TrainState) -> TrainState:
    """Like `text_from_first`, for a state with the shapes of `like`."""
    if jax.process_count() == 1:
        return make()
    made: list[TrainState] = []
    text_from_first(lambda: made.append(make()) or "")
    here = _plain(made[0]) if made else jax.eval_shape(_plain, like)
    arrays = jax.tree.map(lambda x: np.asarray(x) if made else np.zeros(x.shape, x.dtype), here)
    return _keyed(multihost_utils.broadcast_one_to_all(arrays), like)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, tree)


def _keyed(tree: Any, like: Any) -> Any:
    return jax.tree.map(lambda x, leaf: jax.random.wrap_key_data(jnp.asarray(x)) if _is_key(leaf) else x, tree, like)


def get(tree: Tree) -> Tree:
    """Arrays that are split over devices, as whole arrays on the host of every process."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    everywhere = NamedSharding(jax.tree.leaves(tree)[0].sharding.mesh, P())
    gathered = jax.jit(_plain, out_shardings=everywhere)(tree)
    return _keyed(jax.tree.map(lambda leaf: np.asarray(leaf.addressable_data(0)), gathered), tree)


@dataclass(frozen=True)
class Fleet:
    """The trainer's functions on a mesh, one seed per member of its first axis. Static and hashable."""

    trainer: Trainer  # of one shard
    mesh: Mesh

    @classmethod
    def of(cls, config: TrainConfig) -> Fleet:
        """The fleet of a configuration.

        Raises:
            ValueError: the configuration is inconsistent, or does not fit the available devices.
        """
        return cls(build(config, config.shards)[0], mesh(config))

    def put(self, states: Sequence[TrainState]) -> TrainState:
        """Stack whole states, one per seed, and lay them out on the mesh."""

        def place(spec: P, part: Any) -> Any:
            return jax.tree.map(lambda *leaves: self._place(spec, leaves), *part)

        return jax.tree.map(lambda spec, *parts: place(spec, parts), self.layout, *states)

    @property
    def layout(self) -> Any:
        """The mesh axes of each part of the stacked states."""
        return TrainState(
            agent=SEED,
            data=self.trainer.driver.layout(SEED, ENVIRONMENT),
            env=ENVIRONMENT,
            obs=ENVIRONMENT,
            noise=ENVIRONMENT,
            base=SEED,
            key=SEED,
            steps=SEED,
            pairs=SEED,
            kept=SEED,
        )

    def _place(self, spec: P, leaves: Sequence[Any]) -> jax.Array:
        stacked = jnp.stack(leaves) if _is_key(leaves[0]) else np.stack(leaves)
        sharding = NamedSharding(self.mesh, spec)
        return jax.make_array_from_callback(stacked.shape, sharding, lambda index: stacked[index])

    def take(self, states: TrainState) -> list[TrainState]:
        """The inverse of `put`: whole states on the host."""
        whole = get(states)
        return [jax.tree.map(lambda leaf, i=i: leaf[i], whole) for i in range(self.mesh.shape[SEEDS])]

    @property
    def prefill(self) -> jax.stages.Wrapped:
        """`Trainer.prefill` for every seed, `prefill(states, params) -> states`; donates the states."""
        return _jitted(self)[0]

    @property
    def improve(self) -> jax.stages.Wrapped:
        """`Trainer.improve` for every seed, `improve(states, params) -> states, metrics`; donates the states."""
        return _jitted(self)[2]

    @property
    def check(self) -> jax.stages.Wrapped:
        """`Trainer.check` for every seed, `check(states, params, final) -> states, metrics`; donates the states."""
        return _jitted(self)[3]

    @property
    def epoch(self) -> jax.stages.Wrapped:
        """`Trainer.epoch` for every seed, `epoch(states, params, steps) -> states, metrics`, metrics (seeds,).

        Donates the states; compiled once for each number of steps.
        """
        return _jitted(self)[1]


@cache  # so that equal fleets share compiled functions
def _jitted(fleet: Fleet) -> tuple[jax.stages.Wrapped, ...]:
    def mapped(function: Callable[..., Any], out_specs: Any) -> Callable[..., Any]:
        def of_one(states: TrainState, *given: Any) -> Any:
            state = jax.tree.map(lambda leaf: jnp.squeeze(leaf, 0), states)
            return jax.tree.map(lambda leaf: jnp.expand_dims(leaf, 0), function(state, *given))

        # No check of replication: it has no benefit here, and scans would need casts.
        return lambda states, *given: jax.shard_map(
            of_one,
            mesh=fleet.mesh,
            in_specs=(fleet.layout, *(P() for _ in given)),
            out_specs=out_specs,
            check_vma=False,
        )(states, *given)

    # Fix the layout of the results; XLA might choose another one, and the next call would compile again.
    layout = jax.tree.map(lambda spec: NamedSharding(fleet.mesh, spec), fleet.layout)
    on_cpu = fleet.mesh.devices.flat[0].platform == "cpu"

    @partial(jax.jit, donate_argnums=0, out_shardings=layout, compiler_options=RUN_ONCE)
    def prefill(states: TrainState, params: EnvParams) -> TrainState:
        return mapped(fleet.trainer.prefill, fleet.layout)(states, params)

    with_metrics = (layout, NamedSharding(fleet.mesh, SEED))
    options = EIGEN if on_cpu else None

    @partial(jax.jit, static_argnums=2, donate_argnums=0, out_shardings=with_metrics, compiler_options=options)
    def epoch(states: TrainState, params: EnvParams, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        return mapped(lambda *given: fleet.trainer.epoch(*given, steps), (fleet.layout, SEED))(states, params)

    @partial(jax.jit, donate_argnums=0, out_shardings=with_metrics, compiler_options=options)
    def improve(states: TrainState, params: EnvParams) -> tuple[TrainState, dict[str, jax.Array]]:
        return mapped(fleet.trainer.improve, (fleet.layout, SEED))(states, params)

    often = fleet.trainer.config.agent_epochs > 0

    @partial(jax.jit, donate_argnums=0, out_shardings=with_metrics, compiler_options=options if often else RUN_ONCE)
    def check(states: TrainState, params: EnvParams, final: bool) -> tuple[TrainState, dict[str, jax.Array]]:
        return mapped(fleet.trainer.check, (fleet.layout, SEED))(states, params, final)

    return prefill, epoch, improve, check


def spread(tree: Tree, members: int, devices: int) -> Tree:
    """Split arrays with one entry per member, such as the parameters of a large population, over devices.

    Computations on them under jit are split alike, with the same random numbers as on one device.

    Args:
        tree: pytree; arrays of shape (members,) are split, all others are on every device.
        members: how many.
        devices: must divide `members`.

    Raises:
        ValueError: there are too few devices, or the members can't be split evenly.
    """
    if not 0 < devices <= jax.device_count() or members % devices:
        raise ValueError(
            f"devices is {devices}; it must divide the {members} members and be at most {jax.device_count()}"
        )
    over = Mesh(np.array(jax.devices()[:devices]), (MEMBERS,))

    def place(leaf: chex.Array) -> jax.Array:
        return jax.device_put(leaf, NamedSharding(over, P(MEMBERS) if leaf.shape == (members,) else P()))

    return jax.tree.map(place, tree)
