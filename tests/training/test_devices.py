import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.agents.agent import Experience, Transitions
from jaxouter.agents.ddpg import DDPG, DDPGConfig
from jaxouter.agents.ppo import PPO, PPOConfig
from jaxouter.agents.trpo import TRPO, TRPOConfig
from jaxouter.train import parse
from jaxouter.training.devices import Processes
from jaxouter.training.run import RunFolder
from tests import interrupts
from tests.precision import of_single_draws
from tests.training.small import PAIRS, small

HERE = Path(__file__).parent
OPTIONS = ["--steps", "1040", "--agent.prefill", "640", "--epoch", "8", "--environments", "8", "--agent.replay", "1600"]
OPTIONS += ["--agent.hidden", "16", "16", "--agent.batch-size", "32", "--agent.updates", "1"]
OPTIONS += ["--history", "3", "--base", "absolute"]
OPTIONS += PAIRS


@of_single_draws
@pytest.mark.slow
def test_on_four_forced_devices():
    """The tests in `four_devices.py`, in a process that has them."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", str(HERE / "four_devices.py")],
        env=os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"},
        cwd=HERE.parents[1],
        capture_output=True,
        text=True,
        timeout=420,
    )
    assert done.returncode == 0, done.stdout


def test_gradients_of_parts_of_a_batch_average_to_that_of_the_whole():
    config = DDPGConfig(hidden=(16, 16))
    keys = jax.random.split(jax.random.key(0), 5)
    batch = Transitions(
        *(jax.random.normal(key, shape) for key, shape in zip(keys, [(8, 3), (8, 1), (8,), (8,), (8, 3)], strict=True))
    )
    whole, parts = DDPG(config, 3), DDPG(config, 3, axis="parts")
    state = whole.init(keys[0])
    expected, _ = jax.jit(whole.update)(state, batch, keys[1])
    halves = jax.tree.map(lambda leaf: leaf.reshape(2, 4, *leaf.shape[1:]), batch)
    update = jax.vmap(lambda half: parts.update(state, half, keys[1])[0], axis_name="parts")
    for i in range(2):
        found = jax.tree.map(lambda leaf, i=i: leaf[i], jax.jit(update)(halves))
        # Not the weights: the first step of Adam turns rounding of a vanishing gradient into a step.
        chex.assert_trees_all_close(found.critic_optimiser, expected.critic_optimiser, rtol=1e-4, atol=1e-7)
        chex.assert_trees_all_close(found.actor_optimiser, expected.actor_optimiser, rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize("kind", [PPO, TRPO])
def test_an_on_policy_step_from_parts_of_a_batch_is_that_from_the_whole(kind):
    config = (PPOConfig if kind is PPO else TRPOConfig)(hidden=(16, 16))
    config = replace(config, kl=0.0) if kind is PPO else replace(config, fisher_every=1, epochs=1, minibatches=1)
    whole, parts = kind(config, 3), kind(config, 3, axis="parts")
    keys = jax.random.split(jax.random.key(0), 4)
    state, obs = whole.init(keys[0]), jax.random.normal(keys[1], (8, 3))
    explore = jax.vmap(whole.explore, (None, None, 0, 0, None, None))
    action, _, sample = explore(state, (), obs, jax.random.normal(keys[2], (8, 1)), False, 0.0)
    advantage, target = jax.random.normal(keys[3], (2, 8))
    batch = Experience(obs, action, sample, advantage, target)
    expected, metrics = jax.jit(whole.update)(state, batch, keys[1])
    halves = jax.tree.map(lambda leaf: leaf.reshape(2, 4, *leaf.shape[1:]), batch)
    update = jax.vmap(lambda half: parts.update(state, half, keys[1]), axis_name="parts")
    found, of_parts = jax.jit(update)(halves)
    for i in range(2):
        chex.assert_trees_all_close(jax.tree.map(lambda leaf, i=i: leaf[i], of_parts), metrics, rtol=1e-4, atol=1e-6)
        policy, critic = (jax.tree.map(lambda leaf, i=i: leaf[i], part) for part in (found.policy, found.critic))
        if kind is TRPO:
            chex.assert_trees_all_close(policy, expected.policy, rtol=1e-3, atol=1e-4)
        else:  # as above: Adam
            optimiser = jax.tree.map(lambda leaf, i=i: leaf[i], found.policy_optimiser)
            chex.assert_trees_all_close(optimiser, expected.policy_optimiser, rtol=1e-2, atol=1e-6)
        chex.assert_trees_all_close(critic, expected.critic, atol=2.1e-3)  # twice its learning rate


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((None, 2, 0), "go together; give all three or none"),
        (("here:1", 3, 0), "--num-processes is 3; it must divide --devices, which is 4"),
        (("here:1", 2, 2), "--process-id is 2; it must lie in 0 to 1"),
        (("here", 2, 1), "--coordinator is 'here'; it must be HOST:PORT of process 0"),
    ],
)
def test_processes_that_do_not_fit_are_named(options, text):
    with pytest.raises(ValueError, match=text):
        Processes(*options).check(devices=4)


def test_resumption_takes_the_devices_of_the_run_unless_told(tmp_path):
    path = str(RunFolder.create(small(devices=4), tmp_path / "run").path)
    assert parse(["--resume", path]).config == small(devices=4)
    assert parse(["--resume", path, "--devices", "1"]).config == small()


@contextmanager
def started(folder: Path, *options: list[str]) -> Iterator[list[subprocess.Popen[str]]]:
    """The command in one process for each list of options; none of them outlives the block."""
    with interrupts.heard():
        processes = [
            subprocess.Popen(
                [sys.executable, "-m", "jaxouter.train", *each],
                cwd=folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for each in options
        ]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def ended(processes: list[subprocess.Popen[str]]) -> list[int]:
    """Exit codes; where one is not expected, pytest shows what was printed."""
    for process in processes:
        print(process.communicate(timeout=600)[0])
    return [process.returncode for process in processes]


def pair() -> list[list[str]]:
    """Options by which two processes find each other, on a free port."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port = listening.getsockname()[1]
    common = ["--coordinator", f"127.0.0.1:{port}", "--num-processes", "2", "--process-id"]
    return [[*common, str(i)] for i in range(2)]


@pytest.mark.timeout(1500)
@of_single_draws
@pytest.mark.slow
def test_two_processes_train_as_two_devices_of_one_do(tmp_path):
    """50 updates; the two processes are stopped through the second one, and resumed."""
    train = ["heaters", *OPTIONS, "--devices", "2", "--out"]
    with started(tmp_path, *([*train, "apart", *which] for which in pair())) as processes:
        metrics, deadline = tmp_path / "apart" / "seed-0" / "metrics.jsonl", time.monotonic() + 600
        while not (metrics.exists() and metrics.read_text()) and time.monotonic() < deadline:
            time.sleep(0.02)
        processes[1].send_signal(signal.SIGINT)
        assert ended(processes) == [130, 130]
    assert 0 < len(RunFolder.open(tmp_path / "apart").rows(0)) < 50
    again = ([*train, "together"], *(["--resume", "apart", *which] for which in pair()))
    with started(tmp_path, *again) as processes:
        assert ended(processes) == [0, 0, 0]

    runs = [RunFolder.open(tmp_path / name) for name in ("together", "apart")]
    together, apart = (run.load(0)[0] for run in runs)
    assert int(apart.agent.updates) == 50
    assert [row["epoch"] for row in runs[1].rows(0)] == list(range(1, 53))  # then pairs, and the last check
    first, last = runs[0].trainer[0].driver.replay.mirror, runs[0].trainer[0].driver.replay.mirror + 640 // 8
    np.testing.assert_array_equal(together.data.rows[:, first:last], apart.data.rows[:, first:last])
    keys = [
        [
            jax.random.key_data(leaf)
            for leaf in jax.tree.leaves(state)
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        ]
        for state in (together, apart)
    ]
    assert len(keys[0]) > 1
    chex.assert_trees_all_equal(*keys)
    chex.assert_trees_all_close(together.agent, apart.agent, rtol=1e-4, atol=1e-7)
