"""More than one device or process: the mesh, what stands where on it, and what processes tell each other.

Seeds are split over the first axis of the mesh; over the second one the environments of each learner, with their part
of the replay and of each batch. One device is a mesh of one.
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
HOUSES = "houses"
# Matrix products on a CPU by Eigen, not by YNNPACK, jax 0.10's choice: a twentieth faster, and a tenth where devices
# share their cores.
EIGEN = {"xla_cpu_experimental_ynn_fusion_type": ""}
Tree = TypeVar("Tree")

SEED: Any = P(SEEDS)
ENVIRONMENT: Any = P(SEEDS, AXIS)


@dataclass(frozen=True)
class Processes:
    """How this process finds the others; None: there are none, or JAX finds them (SLURM, Kubernetes)."""

    coordinator: str | None = None
    num_processes: int | None = None
    process_id: int | None = None

    def check(self, devices: int) -> Processes:
        """Itself.

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
    """Make CPU devices where the CPU is what there is, and join the other processes; before JAX is used at all.

    JAX finds the others by itself in a step of several SLURM tasks and in an indexed Kubernetes job, if more than one
    device is asked for.

    Args:
        devices: in all processes together.
        processes: checked.

    Raises:
        ValueError: the processes did not come together.
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
        raise ValueError(f"the processes did not come together: {error}") from None


def part() -> None:
    """The end of what the processes do together: each goes on, or ends, without waiting for the others."""
    if jax.distributed.is_initialized():
        jax.distributed.shutdown()


def _make_cpu_devices(count: int) -> None:
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        return  # JAX is in use already: the devices are those that there are, and `mesh` counts them


def mesh(config: TrainConfig) -> Mesh:
    """Devices (seeds, environments) of a run, as many of each process.

    Raises:
        ValueError: there are fewer devices, or they can't be shared out evenly.
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
    """Whether the flag is set in any process; asked in all of them at once."""
    return flag if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def text_from_first(make: Callable[[], str]) -> str:
    """What `make` gives in the first process, in all of them; it is called there alone.

    Raises:
        ValueError, OSError: as `make` does, in all of them.
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
    """Do it in the first process alone; where it fails, all do, as `text_from_first`."""

    def text() -> str:
        act()
        return ""

    text_from_first(text)


def state_from_first(make: Callable[[], TrainState], like: TrainState) -> TrainState:
    """As `text_from_first`, for a state whose shapes are those of `like`."""
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
    """Arrays that lie on many devices, whole, on the host of every process."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    everywhere = NamedSharding(jax.tree.leaves(tree)[0].sharding.mesh, P())
    gathered = jax.jit(_plain, out_shardings=everywhere)(tree)
    return _keyed(jax.tree.map(lambda leaf: np.asarray(leaf.addressable_data(0)), gathered), tree)


@dataclass(frozen=True)
class Fleet:
    """The trainer's functions over a mesh, one seed on each member of its first axis. Static and hashable."""

    trainer: Trainer  # of one shard
    mesh: Mesh

    @classmethod
    def of(cls, config: TrainConfig) -> Fleet:
        """The fleet of a configuration.

        Raises:
            ValueError: the configuration does not fit together, or not to the devices that there are.
        """
        return cls(build(config, config.shards)[0], mesh(config))

    def put(self, states: Sequence[TrainState]) -> TrainState:
        """Whole states, one a seed, stacked and laid out over the mesh."""

        def place(spec: P, part: Any) -> Any:
            return jax.tree.map(lambda *leaves: self._place(spec, leaves), *part)

        return jax.tree.map(lambda spec, *parts: place(spec, parts), self.layout, *states)

    @property
    def layout(self) -> Any:
        """What of the states of all seeds lies on which axis of the mesh."""
        return TrainState(
            agent=SEED,
            data=self.trainer.driver.layout(SEED, ENVIRONMENT),
            env=ENVIRONMENT,
            obs=ENVIRONMENT,
            noise=ENVIRONMENT,
            base=SEED,
            key=SEED,
            steps=SEED,
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
        """`Trainer.prefill` of every seed, `prefill(states, params) -> states`; donates the states."""
        return _jitted(self)[0]

    @property
    def epoch(self) -> jax.stages.Wrapped:
        """`Trainer.epoch` of every seed, `epoch(states, params, steps) -> states, metrics`, the metrics (seeds,).

        Donates the states; compiled once for each number of steps.
        """
        return _jitted(self)[1]


@cache  # so that equal fleets share what is compiled
def _jitted(fleet: Fleet) -> tuple[jax.stages.Wrapped, jax.stages.Wrapped]:
    def mapped(function: Callable[..., Any], out_specs: Any) -> Callable[..., Any]:
        def of_one(states: TrainState, params: EnvParams) -> Any:
            state = jax.tree.map(lambda leaf: jnp.squeeze(leaf, 0), states)
            return jax.tree.map(lambda leaf: jnp.expand_dims(leaf, 0), function(state, params))

        # Without the check of replication: what XLA is told by it is not used here, and scans would need casts.
        return jax.shard_map(
            of_one, mesh=fleet.mesh, in_specs=(fleet.layout, P()), out_specs=out_specs, check_vma=False
        )

    # Told where its results are, XLA does not choose another layout that would be compiled for once more.
    layout = jax.tree.map(lambda spec: NamedSharding(fleet.mesh, spec), fleet.layout)
    on_cpu = fleet.mesh.devices.flat[0].platform == "cpu"

    @partial(jax.jit, donate_argnums=0, out_shardings=layout, compiler_options=RUN_ONCE)
    def prefill(states: TrainState, params: EnvParams) -> TrainState:
        return mapped(fleet.trainer.prefill, fleet.layout)(states, params)

    @partial(
        jax.jit,
        static_argnums=2,
        donate_argnums=0,
        out_shardings=(layout, NamedSharding(fleet.mesh, SEED)),
        compiler_options=EIGEN if on_cpu else None,
    )
    def epoch(states: TrainState, params: EnvParams, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        return mapped(lambda *given: fleet.trainer.epoch(*given, steps), (fleet.layout, SEED))(states, params)

    return prefill, epoch


def spread(tree: Tree, members: int, devices: int) -> Tree:
    """Arrays with one entry a member, such as the parameters of a large population, split over so many devices.

    What is computed from them under jit is split alike, and draws the same numbers as on one device.

    Args:
        tree: pytree; arrays of shape (members,) are split, all others are on every device.
        members: houses.
        devices: must divide `members`.

    Raises:
        ValueError: there are fewer devices, or members can't be shared out evenly.
    """
    if not 0 < devices <= jax.device_count() or members % devices:
        raise ValueError(
            f"devices is {devices}; it must divide the {members} members and be at most {jax.device_count()}"
        )
    over = Mesh(np.array(jax.devices()[:devices]), (HOUSES,))

    def place(leaf: chex.Array) -> jax.Array:
        return jax.device_put(leaf, NamedSharding(over, P(HOUSES) if leaf.shape == (members,) else P()))

    return jax.tree.map(place, tree)
