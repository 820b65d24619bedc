"""What the code of others raises: one message, exit status 2, and the trace where it is asked for."""

import pickle
import sys
from types import SimpleNamespace
from unittest.mock import patch

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import check, cli, compare, evaluate, export, live, plants, train
from jaxouter.api import learning
from jaxouter.evaluation import jobs
from jaxouter.evaluation.jobs import Entrant, Job
from jaxouter.plants import host, registry, simulate
from jaxouter.plants.errors import PlantError, said
from tests.precision import makes_nan

DECLARED = dict(y_unit="1", time_unit="s", control_step=0.1, episode_steps=8, family_steps=8)
DECLARED |= dict(r_tilde_bounds=(-2.0, 2.0), setpoint_range=(-0.5, 0.5))


@pytest.fixture(autouse=True)
def forgotten():
    """No plant that a test adds stays."""
    with patch.dict(plants.REGISTRY), patch.dict(registry.REGISTRATIONS):
        yield


class Lag:
    """A simulator whose control step `when` does what `fails` does."""

    fails, when = staticmethod(lambda: 1 / 0), 4

    def reset(self, seed):
        self.y, self.k = 0.0, 0
        return self.fails() if self.when == 0 else self.y

    def step(self, r_tilde):
        self.k += 1
        self.y += 0.1 * (r_tilde - self.y)
        return self.fails() if self.k == self.when else self.y


def leave():
    sys.exit("no licence")


def long():
    raise RuntimeError("\n".join(["solver diverged", "", *(f"node {i} " + 80 * "=" for i in range(99))]))


def failed(act, *arguments):
    """What a command prints that does this."""
    with pytest.raises(SystemExit) as end, cli.user_errors(arguments):
        act()
    assert end.value.code == 2


@pytest.fixture(scope="module")
def failing():
    """A plant around `Lag`; its functions compiled once, whatever `Lag` does."""
    plant, params = host.plant(Lag, name="mine", **DECLARED)
    return lambda: simulate(plant, params, jnp.ones(8), jax.random.key(0))


@pytest.mark.parametrize(
    ("fails", "when", "text"),
    [
        (lambda: 1 / 0, 4, ", r~ = 1: ZeroDivisionError: division by zero"),
        (lambda: [][3], 1, ", r~ = 1: IndexError: list index out of range"),
        (lambda: None, 5, ", r~ = 1: TypeError: float() argument"),
        (leave, 2, ", r~ = 1: SystemExit: no licence"),
        (long, 8, ", r~ = 1: RuntimeError: solver diverged\nnode 0"),
        (lambda: {}["table"], 0, ": KeyError: 'table'"),
    ],
)
def test_a_simulator_that_fails_is_one_message(failing, fails, when, text, monkeypatch, capsys):
    monkeypatch.setattr(Lag, "fails", staticmethod(fails))
    monkeypatch.setattr(Lag, "when", when)
    failed(failing)
    message = capsys.readouterr().err
    place = "at the start" if when == 0 else f"control step {when}"
    assert message.startswith(f"error: plant mine, {place} of the episode with seed ")
    assert text in message
    assert "Traceback" not in message
    assert len(message.splitlines()) <= 4
    assert len(message) < 800


def test_the_trace_is_shown_where_it_is_asked_for(failing, capsys):
    failed(failing, "--debug")
    message = capsys.readouterr().err
    assert "Traceback" in message
    assert "fails, when = staticmethod(lambda: 1 / 0), 4" in message
    assert "error: plant mine, control step 4" in message.splitlines()[-1]


def interrupted():
    raise KeyboardInterrupt


def test_ctrl_c_is_no_error_of_a_simulator(failing, monkeypatch, capsys):
    monkeypatch.setattr(Lag, "fails", staticmethod(interrupted))
    with pytest.raises(KeyboardInterrupt), cli.user_errors([]):
        failing()
    assert capsys.readouterr().err == ""


def test_an_error_goes_from_a_process_to_another():
    error = pickle.loads(pickle.dumps(PlantError("mine", "control step 3", "KeyError: 'x'")))
    assert str(error) == "plant mine, control step 3: KeyError: 'x'"
    assert said(ValueError()) == "ValueError"


def test_a_plant_that_fails_in_a_comparison_is_named(capsys):
    plants.REGISTRY["mine"] = lambda: MINE
    job = Job("evaluate", Entrant("none", "baseline"), "mine", "mine/steps")
    with pytest.raises(PlantError, match="plant mine, control step 4 of the episode with seed"):
        jobs.run(job)
    assert capsys.readouterr().err == ""


def test_a_plant_that_fails_after_learning_leaves_what_was_learned(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plants.REGISTRY["mine"] = lambda: MINE
    monkeypatch.setattr(learning, "chosen", lambda config, _: config)  # which would step it first
    monkeypatch.setattr(learning, "_trained", lambda *_: {0: None})
    monkeypatch.setattr(learning, "report", lambda *_: simulate(*MINE, jnp.ones(8), jax.random.key(0)))
    with pytest.raises(SystemExit) as end:
        train.main(["mine", "--out", "run", "--history", "2"])
    assert end.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("error: plant mine, control step 4 of")
    assert message.endswith("division by zero; what was learned is in run\n")
    assert (tmp_path / "run").is_dir()


MINE = host.plant(Lag, name="mine", **DECLARED)


OWN = """
import jax, jax.numpy as jnp, numpy as np
from jaxouter.plants import Plant

calls = []

def table(y):
    if y > 0.25:
        raise KeyError("no such entry")
    return np.asarray(y)

def step(params, state, r_tilde, key):
    calls.append(1)
    if len(calls) > LIMIT:
        raise RuntimeError("called too often")
    y = state + 0.1 * (r_tilde - state)
    return jax.pure_callback(table, jax.ShapeDtypeStruct((), y.dtype), y, vmap_method="sequential")

def Own():
    return Plant(
        "Own", lambda key, params: jnp.zeros(()), step, lambda params, state: state, y_unit="1", time_unit="s",
        control_step=0.1, episode_steps=8, r_tilde_bounds=[-1, 1], setpoint_range=[-0.5, 0.5]), ()
"""


@pytest.mark.parametrize(
    ("limit", "text"),
    [
        (99, "error: plant Own, in a function that JAX calls back: KeyError: 'no such entry'"),
        (1, "error: plant Own, in its function step: RuntimeError: called too often"),
    ],
)
def test_a_plant_in_jax_that_fails_is_one_message(tmp_path, limit, text, capsys):
    (tmp_path / "own.py").write_text(OWN.replace("LIMIT", str(limit)))
    plant, params = plants.make(registry.add(f"{tmp_path}/own.py:Own"))
    failed(lambda: simulate(plant, params, jnp.ones(8), jax.random.key(0)))
    assert capsys.readouterr().err.strip() == text


class Short(gymnasium.Env):
    """Truncates itself in its third step."""

    dt = np.float32(0.02)
    action_space = gymnasium.spaces.Box(np.float32(-0.1), np.float32(0.1), (1,))
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))

    def reset(self, *, seed=None, options=None):
        self.k = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.k += 1
        return action, 0.0, False, self.k >= 3, {}


@pytest.fixture
def short(monkeypatch):
    spec = gymnasium.envs.registration.EnvSpec("Short-v0", entry_point=Short)
    monkeypatch.setitem(gymnasium.registry, "Short-v0", spec)


@makes_nan
@pytest.mark.usefixtures("short")
def test_an_environment_that_ends_is_named_with_the_step(capsys, tmp_path, monkeypatch):
    """Its `dt` is that of the plant, and its bounds have the digits that they show."""
    monkeypatch.chdir(tmp_path)
    plant, _ = plants.make(registry.add("gym:Short-v0"))
    assert (plant.control_step, plant.time_unit, plant.r_tilde_bounds) == (0.02, "s", (-0.1, 0.1))
    with pytest.raises(SystemExit) as end:
        check.main(["gym:Short-v0"])
    assert end.value.code == 2
    found = capsys.readouterr()
    assert "the environment truncated in control step 3" in " ".join(found.out.split())
    assert "y is nan from control step 4 of 200 on under r~ = " in found.err
    assert "the environment truncated in control step 3; choose --episode-steps" in found.err


@pytest.mark.usefixtures("short")
def test_an_environment_whose_step_fails_is_one_message(capsys, monkeypatch):
    plant, params = plants.make(registry.add("gym:Short-v0"))
    monkeypatch.setattr(Short, "step", lambda self, action: 1 / 0)
    failed(lambda: simulate(plant, params, jnp.ones(4), jax.random.key(0)))
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith("error: plant Short-v0, control step 1 of the episode with seed")
    assert message.endswith("ZeroDivisionError: division by zero")


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("dt", ["fast", -1.0, np.ones(2)])
def test_a_control_step_that_is_none_is_refused(dt, monkeypatch):
    monkeypatch.setattr(Short, "dt", dt)
    with pytest.raises(ValueError, match=r"gym:Short-v0 has no --control-step, and its dt is .* it must be a positive"):
        registry.add("gym:Short-v0")


@pytest.mark.parametrize("broken", ["raise OSError('no licence')", "import sys; sys.exit(3)", "def ("])
def test_a_module_that_can_not_be_imported_is_one_message(tmp_path, monkeypatch, broken):
    (tmp_path / "broken.py").write_text(broken)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "broken", raising=False)
    for reference in (f"{tmp_path}/broken.py:Own", "gym:broken:Own-v0"):
        with pytest.raises(ValueError, match=r"(OSError: no licence|SystemExit: 3|SyntaxError)"):
            registry.add(reference)


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (train, ["submarine"]),
        (evaluate, ["--policy", "best"]),
        (compare, ["submarine"]),
        (check, ["submarine"]),
        (export, []),
        (live, ["no.py:step", "--run", "run", "--dt", "1"]),
    ],
)
def test_every_command_shows_the_trace_where_it_is_asked_for(command, arguments, capsys):
    for more, shown in (([], False), (["--debug"], True)):
        with pytest.raises(SystemExit) as end:
            command.main([*arguments, *more])
        assert end.value.code == 2
        assert ("Traceback" in capsys.readouterr().err) == shown


def test_the_speed_of_a_simulator_is_counted():
    plant, params = host.plant(lambda: SimpleNamespace(reset=lambda seed: 0.0, step=lambda r: r), name="m", **DECLARED)
    assert host.of(plant).speed.steps == 0
    simulate(plant, params, jnp.ones(8), jax.random.key(0)).block_until_ready()
    assert host.of(plant).speed.steps == 8
    assert host.step_seconds(plant) > 0.0
    assert host.of(plant).speed.steps == 8 + host.TRIED
    assert host.of(plants.make("pitch")[0]) is None
