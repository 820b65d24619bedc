"""Plants that are simulated elsewhere: `gym:ID`, a Gymnasium environment, and `fmu:FILE`, an FMU for co-simulation."""

from __future__ import annotations

import atexit
import importlib
import inspect
import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxouter.plants import host
from jaxouter.plants.base import Plant

EPISODE = 200  # control steps, where nothing says how long


@dataclass(frozen=True)
class PlantOptions:
    """What a plant from elsewhere (gym:, fmu:, log:) does not say itself. A JAX plant declares all of it."""

    y_index: int = 0
    """gym: which number of the observation, flattened, is y."""
    input: str | None = None
    """fmu: the variable that is r~; default: the only input."""
    output: str | None = None
    """fmu: the variable that is y; default: the only output."""
    r_tilde_bounds: tuple[float, float] | None = None
    """Least and greatest r~; default: those of the action, of the FMU's input, or of the log."""
    setpoint_range: tuple[float, float] | None = None
    """Set-points to train and evaluate on; default: the middle half of the range of r~, of a log what it reached."""
    control_step: float | None = None
    """Length of a control step; default: what gym: calls `dt`, else 1; the FMU's step size."""
    episode_steps: int | None = None
    """Control steps of an episode; default: the environment's limit, else 200; of a log from its settling time."""
    y_unit: str | None = None
    """Unit of y and r~."""

    def declared(self, **defaults: Any) -> dict[str, Any]:
        """The declaration: these where they are given, else the defaults.

        Raises:
            ValueError: what has no default is not given, or is not a range or a positive number.
        """
        names = ("r_tilde_bounds", "setpoint_range", "control_step", "episode_steps", "y_unit")
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        whole = defaults | given
        low, high = whole["r_tilde_bounds"]
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(
                f"r~ lies between {low:g} and {high:g}: give it finite bounds, by --r-tilde-bounds LOW HIGH"
            )
        whole.setdefault("setpoint_range", ((3 * low + high) / 4, (low + 3 * high) / 4))
        if not whole["control_step"] > 0 or whole["episode_steps"] < 1:
            raise ValueError("--control-step and --episode-steps must be positive")
        return whole


def _gymnasium() -> Any:
    try:
        import gymnasium
    except ImportError:
        raise ValueError('a plant gym:ID needs Gymnasium: pip install "jaxouter[gymnasium]"') from None
    return gymnasium


def file_of(identifier: str) -> Path:
    """The file that holds a Gymnasium environment's class; an identifier may begin with a module, as in `make`.

    Raises:
        ValueError: Gymnasium is not there, or knows no such environment.
    """
    gymnasium = _gymnasium()
    module, _, identifier = identifier.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        entry = gymnasium.spec(identifier).entry_point
        creator = gymnasium.envs.registration.load_env_creator(entry) if isinstance(entry, str) else entry
    except (gymnasium.error.Error, ImportError, AttributeError) as error:
        raise ValueError(f"gym:{identifier}: {str(error).partition(chr(10))[0]}") from None
    return Path(inspect.getsourcefile(creator) or "")


class _Gym:
    """A Gymnasium environment whose action is r~; nan after its end."""

    def __init__(self, environment: Any, y_index: int) -> None:
        self._environment, self._y_index, self._over = environment, y_index, False

    def reset(self, seed: int) -> float:
        obs, _ = self._environment.reset(seed=seed)
        self._over = False
        return self._y(obs)

    def step(self, r_tilde: float) -> float:
        if self._over:
            return math.nan
        space = self._environment.action_space
        obs, _, terminated, truncated, _ = self._environment.step(np.full(space.shape, r_tilde, space.dtype))
        self._over = bool(terminated or truncated)
        return self._y(obs)

    def _y(self, obs: Any) -> float:
        return float(np.ravel(obs)[self._y_index])


def from_gymnasium(name: str, identifier: str, options: PlantOptions) -> tuple[Plant, tuple[()]]:
    """The plant in a Gymnasium environment with one continuous action, which becomes r~; its reward is not looked at.

    Raises:
        ValueError: Gymnasium is not there, knows no such environment, or it has other spaces.
    """
    gymnasium = _gymnasium()

    def make() -> Any:
        return gymnasium.make(identifier, max_episode_steps=-1, disable_env_checker=True)

    try:
        first = make()
        limit = gymnasium.spec(identifier.rpartition(":")[2]).max_episode_steps
    except (gymnasium.error.Error, ImportError) as error:  # it may need packages that are not there
        raise ValueError(f"gym:{identifier}: {str(error).partition(chr(10))[0]}") from None
    action, observation = first.action_space, first.observation_space
    if not isinstance(action, gymnasium.spaces.Box) or math.prod(action.shape) != 1:
        raise ValueError(f"gym:{identifier}: its action is {action}; it must be one number, r~")
    if not isinstance(observation, gymnasium.spaces.Box):
        raise ValueError(f"gym:{identifier}: its observation is {observation}; it must be an array of numbers")
    if not 0 <= options.y_index < math.prod(observation.shape):
        last = math.prod(observation.shape) - 1
        raise ValueError(f"--y-index is {options.y_index}; gym:{identifier} observes numbers 0 to {last}")
    dt = getattr(first.unwrapped, "dt", None)
    declared = options.declared(
        r_tilde_bounds=(float(action.low.item()), float(action.high.item())),
        control_step=float(dt) if isinstance(dt, int | float) else 1.0,
        episode_steps=limit or EPISODE,
        y_unit="1",
    )
    free = [first]

    def simulator() -> _Gym:
        return _Gym(free.pop() if free else make(), options.y_index)

    return host.plant(simulator, name=name, time_unit="step" if dt is None else "s", **declared)


class _Fmu:
    """An FMU for co-simulation between two of its variables; nan where a step failed."""

    def __init__(self, description: Any, folder: str, given: str, seen: str, control_step: float) -> None:
        from fmpy import instantiate_fmu

        references = {variable.name: variable.valueReference for variable in description.modelVariables}
        self._input, self._output, self._control_step = [references[given]], [references[seen]], control_step
        self._fmu: Any = instantiate_fmu(folder, description, "CoSimulation")
        self._three = description.fmiVersion.startswith("3")
        self._begun = False
        self._time = math.nan

    def reset(self, seed: int) -> float:
        del seed  # an FMU draws nothing
        if self._begun:
            self._fmu.reset()
        self._begun, self._time = True, 0.0
        if self._three:
            self._fmu.enterInitializationMode(startTime=0.0)
        else:
            self._fmu.setupExperiment(startTime=0.0)
            self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        return self._y()

    def step(self, r_tilde: float) -> float:
        from fmpy.fmi1 import FMICallException

        try:
            (self._fmu.setFloat64 if self._three else self._fmu.setReal)(self._input, [r_tilde])
            done = self._fmu.doStep(self._time, self._control_step)
        except FMICallException:
            return math.nan
        self._time += self._control_step
        wants_to_end = self._three and done[1]
        return math.nan if wants_to_end else self._y()

    def _y(self) -> float:
        return float((self._fmu.getFloat64 if self._three else self._fmu.getReal)(self._output)[0])


def _said(variable: Any, attribute: str) -> str | None:
    """An attribute of an FMU's variable, which may stand in its declared type."""
    own = getattr(variable, attribute)
    return getattr(variable.declaredType, attribute, None) if own is None else own


def from_fmu(name: str, path: str, options: PlantOptions) -> tuple[Plant, tuple[()]]:
    """The plant in an FMU for co-simulation (FMI 2 or 3), from one of its inputs to one of its outputs.

    Raises:
        ValueError: FMPy is not there, the file is no such FMU, or it has other variables.
    """
    try:
        import fmpy
    except ImportError:
        raise ValueError('a plant fmu:FILE needs FMPy: pip install "jaxouter[fmu]"') from None
    try:
        description = fmpy.read_model_description(path)
        folder = str(fmpy.extract(path))
    except Exception as error:  # whatever a file that is none makes FMPy raise
        raise ValueError(f"{path} is not a readable FMU: {str(error).partition(chr(10))[0]}") from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if description.coSimulation is None or not str(description.fmiVersion).startswith(("2", "3")):
        raise ValueError(f"{path} is FMI {description.fmiVersion}; it must be FMI 2 or 3, for co-simulation")
    variables = {}
    for causality in ("input", "output"):
        known = {
            variable.name: variable
            for variable in description.modelVariables
            if variable.causality == causality and variable.type in ("Real", "Float64") and not variable.dimensions
        }
        asked = getattr(options, causality)
        if asked not in known and (asked is not None or len(known) != 1):
            raise ValueError(f"--{causality} is {asked}; {path} has: {', '.join(known) or 'none'}")
        variables[causality] = known[asked or next(iter(known))]
    low, high = (float(_said(variables["input"], end) or math.nan) for end in ("min", "max"))
    experiment = description.defaultExperiment
    step_size = None if experiment is None or experiment.stepSize is None else float(experiment.stepSize)
    unit = _said(variables["output"], "unit") or "1"
    declared = options.declared(
        r_tilde_bounds=(low, high), control_step=step_size or 1.0, episode_steps=EPISODE, y_unit=unit
    )
    names = variables["input"].name, variables["output"].name

    def make() -> _Fmu:
        return _Fmu(description, folder, *names, declared["control_step"])

    try:
        free = [make()]
    except Exception as error:  # whatever FMPy raises, as where there is no binary for this system
        raise ValueError(f"{path} can't be started here: {error}") from None

    def simulator() -> _Fmu:
        return free.pop() if free else make()

    return host.plant(simulator, name=name, time_unit="s", **declared)
