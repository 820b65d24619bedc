"""Plants in other simulators: `gym:ID`, a Gymnasium environment, and `fmu:FILE`, an FMU for co-simulation."""

from __future__ import annotations

import atexit
import importlib
import inspect
import math
import multiprocessing
import shutil
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxouter.plants import declaration, host
from jaxouter.plants.base import Plant
from jaxouter.plants.cosimulation import Apart, FmuError, Instance, Setup
from jaxouter.plants.errors import Raised, said

EPISODE = 200  # default control steps of an episode
APART = 16  # most episodes at the same time of an FMU that needs a process for each
NOTICED = 0.01  # s; if an episode takes longer to begin, the warning says so
ROUNDING = 1e-6  # control steps


@dataclass(frozen=True)
class PlantOptions:
    """What a plant gym:, fmu: or log: does not declare itself. A JAX plant declares all of it."""

    y_index: int = 0
    """gym: index of y in the flattened observation."""
    input: str | None = None
    """fmu: name of the variable for r~; default: the only input."""
    output: str | None = None
    """fmu: name of the variable for y; default: the only output."""
    r_tilde_bounds: tuple[float, float] | None = None
    """Least and greatest r~; default: the bounds of the action or of the FMU's input, or the recorded range."""
    setpoint_range: tuple[float, float] | None = None
    """Set-points to train and evaluate on; default: the middle half of the range of r~; log: what y has reached."""
    control_step: float | None = None
    """Length of a control step; default: the environment's `dt` or else 1; the FMU's step size."""
    episode_steps: int | None = None
    """Control steps of an episode; default: the environment's limit or else 200; log: by the settling time."""
    y_unit: str | None = None
    """Unit of y and r~."""
    validate: bool = True
    """fmu: refuse a description that violates the FMI standard."""

    def declared(self, **defaults: Any) -> dict[str, Any]:
        """The declaration: these options if given, else the defaults.

        Raises:
            ValueError: an option without default is missing, or a value is not allowed; names the option.
        """
        kinds = {
            name: declaration.PLANT[name] for name in ("setpoint_range", "control_step", "episode_steps", "y_unit")
        }
        kinds["r_tilde_bounds"] = declaration.RANGE
        given = {
            name: declaration.checked(kind, f"--{name.replace('_', '-')}", getattr(self, name))
            for name, kind in kinds.items()
            if getattr(self, name) is not None
        }
        whole = defaults | given
        low, high = whole["r_tilde_bounds"]
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(
                f"the bounds of r~ are {low:g} and {high:g}; give finite ones with --r-tilde-bounds LOW HIGH"
            )
        whole.setdefault("setpoint_range", ((3 * low + high) / 4, (low + 3 * high) / 4))
        return whole


def _gymnasium() -> Any:
    try:
        import gymnasium
    except ImportError:
        raise ValueError('a plant gym:ID needs Gymnasium: pip install "jaxouter[gymnasium]"') from None
    return gymnasium


def file_of(identifier: str) -> Path:
    """The file of a Gymnasium environment's class; the identifier may begin with a module, as in `gymnasium.make`.

    Raises:
        ValueError: Gymnasium is not installed, or has no such environment.
    """
    gymnasium = _gymnasium()
    module, _, identifier = identifier.rpartition(":")
    with _made(f"gym:{identifier}"):
        if module:
            importlib.import_module(module)
        entry = gymnasium.spec(identifier).entry_point
        creator = gymnasium.envs.registration.load_env_creator(entry) if isinstance(entry, str) else entry
    return Path(inspect.getsourcefile(creator) or "")


@contextmanager
def _made(what: str) -> Iterator[None]:
    """Turn any error in making a simulator, which may be a user's code, into a ValueError."""
    try:
        yield
    except Raised as error:
        raise ValueError(f"{what} can't be made: {said(error)}") from error


class _Gym:
    """A Gymnasium environment whose action is r~; y is nan after its end."""

    def __init__(self, environment: Any, y_index: int) -> None:
        self._environment, self._y_index, self._done = environment, y_index, 0
        self.ended: str | None = None

    def reset(self, seed: int) -> float:
        obs, _ = self._environment.reset(seed=seed)
        self._done, self.ended = 0, None
        return self._y(obs)

    def step(self, r_tilde: float) -> float:
        if self.ended:
            return math.nan
        space = self._environment.action_space
        obs, _, terminated, truncated, _ = self._environment.step(np.full(space.shape, r_tilde, space.dtype))
        self._done += 1
        if terminated or truncated:
            self.ended = f"the environment {'terminated' if terminated else 'truncated'} in control step {self._done}"
        return self._y(obs)

    def _y(self, obs: Any) -> float:
        return float(np.ravel(obs)[self._y_index])


def from_gymnasium(name: str, identifier: str, options: PlantOptions) -> tuple[Plant, tuple[()]]:
    """The plant in a Gymnasium environment with one continuous action, which becomes r~; its reward is ignored.

    Raises:
        ValueError: Gymnasium is not installed or has no such environment, or its spaces do not fit.
    """
    gymnasium = _gymnasium()

    def make() -> Any:
        return gymnasium.make(identifier, max_episode_steps=-1, disable_env_checker=True)

    with _made(f"gym:{identifier}"):  # it may need packages that are not there
        first = make()
        limit = gymnasium.spec(identifier.rpartition(":")[2]).max_episode_steps
        dt = getattr(first.unwrapped, "dt", None)
    if dt is not None and options.control_step is None:
        dt = declaration.checked(declaration.POSITIVE, f"gym:{identifier} has no --control-step, and its dt", dt)
    action, observation = first.action_space, first.observation_space
    if not isinstance(action, gymnasium.spaces.Box) or math.prod(action.shape) != 1:
        raise ValueError(f"gym:{identifier}: its action is {action}; it must be one number, r~")
    if not isinstance(observation, gymnasium.spaces.Box):
        raise ValueError(f"gym:{identifier}: its observation is {observation}; it must be an array of numbers")
    if not 0 <= options.y_index < math.prod(observation.shape):
        last = math.prod(observation.shape) - 1
        raise ValueError(f"--y-index is {options.y_index}; gym:{identifier} observes numbers 0 to {last}")
    declared = options.declared(
        r_tilde_bounds=(declaration.number(action.low.ravel()[0]), declaration.number(action.high.ravel()[0])),
        control_step=dt or 1.0,
        episode_steps=limit or EPISODE,
        y_unit="1",
    )
    free = [first]

    def simulator() -> _Gym:
        return _Gym(free.pop() if free else make(), options.y_index)

    return _plant(simulator, name, "step" if dt is None else "s", declared)


def _plant(
    make: Callable[[], host.Simulator], name: str, time_unit: str, declared: dict[str, Any], **rest: Any
) -> tuple[Plant, tuple[()]]:
    """The plant of these simulators. Evaluation episodes are as long as training ones, as simulators may end then."""
    return host.plant(make, name=name, time_unit=time_unit, family_steps=declared["episode_steps"], **declared, **rest)


def _attribute(variable: Any, attribute: str) -> str | None:
    """An attribute of an FMU's variable, or else of its declared type."""
    own = getattr(variable, attribute)
    return getattr(variable.declaredType, attribute, None) if own is None else own


def from_fmu(name: str, path: str, options: PlantOptions) -> tuple[Plant, tuple[()]]:
    """The plant in an FMU for co-simulation (FMI 2 or 3), from one input to one output.

    Raises:
        ValueError: FMPy is not installed, the file is no such FMU, its variables do not fit, or it fails at once.
    """
    description, folder = _extracted(path, options.validate)
    given, seen = (_variable(description, causality, getattr(options, causality), path) for causality in _CAUSALITIES)
    try:
        experiment = _Experiment.of(description)
        bounds = tuple(float(_attribute(given, end) or math.nan) for end in ("min", "max"))
    except ValueError as error:
        raise ValueError(f"{path} has an attribute that is not a number: {error}") from None
    asked = experiment.step or 1.0 if options.control_step is None else options.control_step
    control_step = experiment.check(declaration.checked(declaration.POSITIVE, "--control-step", asked))
    declared = options.declared(
        r_tilde_bounds=bounds,
        control_step=control_step,
        episode_steps=min(EPISODE, experiment.most(control_step) or EPISODE),
        y_unit=_attribute(seen, "unit") or "1",
    )
    setup = Setup(folder, given.name, seen.name, experiment.start, control_step)
    once = str(description.coSimulation.canBeInstantiatedOnlyOncePerProcess).lower() in ("true", "1")
    try:
        make, first = _started(name, setup, once, experiment.step, declared["setpoint_range"][1])
        _check_whole(first, declared, experiment)
    except FmuError as error:
        raise ValueError(f"{path} {error}") from error
    free = [first]

    def simulator() -> Instance | Apart:
        return free.pop() if free else make()

    most = APART if isinstance(first, Apart) else host.SIMULATORS
    return _plant(simulator, name, "s", declared, side_by_side=most)


_CAUSALITIES = ("input", "output")


def _extracted(path: str, validate: bool) -> tuple[Any, str]:
    """Description of an FMU, and the folder to which it is extracted until this process ends."""
    try:
        import fmpy
        from fmpy.model_description import ValidationError
    except ImportError:
        raise ValueError('a plant fmu:FILE needs FMPy: pip install "jaxouter[fmu]"') from None
    try:
        folder = str(fmpy.extract(path))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        description = fmpy.read_model_description(folder, validate=validate)
    except ValidationError as error:
        raise ValueError(f"{path}: {error}\nFix it, or accept it with --no-validate") from None
    except Exception as error:  # FMPy may raise anything on a file that is not an FMU
        raise ValueError(f"{path} is not a readable FMU: {said(error)}") from None
    if description.coSimulation is None or not str(description.fmiVersion).startswith(("2", "3")):
        raise ValueError(f"{path} is FMI {description.fmiVersion}; it must be FMI 2 or 3, for co-simulation")
    return description, folder


def _variable(description: Any, causality: str, asked: str | None, path: str) -> Any:
    """The variable with the given name, or the only one of this causality."""
    known = {
        variable.name: variable
        for variable in description.modelVariables
        if variable.causality == causality and variable.type in ("Real", "Float64") and not variable.dimensions
    }
    if asked not in known and (asked is not None or len(known) != 1):
        raise ValueError(f"--{causality} is {asked}; {path} has: {', '.join(known) or 'none'}")
    return known[asked or next(iter(known))]


class _Experiment(NamedTuple):
    """The FMU's declared times, s; None: not declared."""

    start: float
    stop: float | None
    step: float | None
    fixed: float | None  # fixed internal step; a communication step must be a multiple of it

    @classmethod
    def of(cls, description: Any) -> _Experiment:
        default, own = description.defaultExperiment, description.coSimulation
        pairs = (default, "startTime"), (default, "stopTime"), (default, "stepSize"), (own, "fixedInternalStepSize")
        values = [getattr(where, name, None) for where, name in pairs]
        start, stop, step, fixed = (None if value is None else float(value) for value in values)
        return cls(start or 0.0, stop, step or fixed, fixed)

    def most(self, control_step: float) -> int | None:
        """Control steps until its stop time."""
        return None if self.stop is None else max(1, math.floor((self.stop - self.start) / control_step + ROUNDING))

    def check(self, control_step: float) -> float:
        """The control step; raises ValueError if it is not a multiple of the fixed internal step."""
        if self.fixed is not None:
            times = control_step / self.fixed
            if round(times) < 1 or abs(times - round(times)) > ROUNDING * times:
                raise ValueError(
                    f"--control-step is {control_step:g}; it must be a multiple of the FMU's fixed internal step size, "
                    f"{self.fixed:g} s"
                )
        return control_step


def _started(
    name: str, setup: Setup, once: bool, own_step: float | None, r_tilde: float
) -> tuple[Callable[[], Any], Instance | Apart]:
    """A maker of instances of an FMU, and the first one. Tries whether the FMU can be reset and made twice.

    Args:
        name: of the plant.
        setup: how to run it.
        once: whether it declares that a process may have only one instance.
        own_step: its declared step size, s.
        r_tilde: for the steps of this trial.

    Raises:
        FmuError: it can't be started, or refuses the control step.
    """
    kind: type[Instance | Apart] = Apart if once else Instance
    first = kind(setup)
    trouble = _trouble_with_reset(first, setup, own_step, r_tilde)
    if trouble is not None:
        first.free()
        setup = setup._replace(anew=True)
        first = kind(setup)
    if not once:
        second = kind(setup)
        try:
            for instance in (first, second, first):
                instance.reset(0)
                instance.step(r_tilde)
        except FmuError:
            kind = Apart
            first.free()
            first = kind(setup)
        second.free()
    first.reset(0)
    first.step(r_tilde)
    begun = time.perf_counter()
    first.reset(0)
    seconds = time.perf_counter() - begun
    whys = ["can be instantiated once per process"] * (kind is Apart)
    whys += [] if trouble is None else [f"can't be reset ({trouble})"]
    if whys and multiprocessing.parent_process() is None:  # in a child process the parent has warned already
        own = f"a process of its own, {APART} at a time" if kind is Apart else "an instance of its own"
        slow = f", which takes {seconds:.1g} s to begin" if seconds > NOTICED else ""
        warnings.warn(f"{name} {' and '.join(whys)}; each episode has {own}{slow}", stacklevel=2)
    return partial(kind, setup), first


def _trouble_with_reset(instance: Instance | Apart, setup: Setup, own_step: float | None, r_tilde: float) -> str | None:
    """Why an FMU can't be reset; None: it can.

    Raises:
        FmuError: it can't be started, or refuses the control step.
    """
    differs = own_step is not None and abs(own_step - setup.step) > ROUNDING * setup.step
    hint = f"; its own step size is {own_step:g} s, see --control-step" if differs else ""
    try:
        y = [instance.reset(0)]
    except FmuError as error:
        raise FmuError(f"can't be started here: {error}") from error
    try:
        y.append(instance.step(r_tilde))
    except FmuError as error:
        raise FmuError(
            f"failed in control step 1, of {setup.step:g} s, with r~ = {r_tilde:g}: {error}{hint}"
        ) from error
    try:
        again = [instance.reset(0), instance.step(r_tilde)]
    except FmuError as error:
        return str(error)
    return None if np.array_equal(y, again, equal_nan=True) else f"y begins with {again} after it, and with {y} before"


def _check_whole(instance: Instance | Apart, declared: dict[str, Any], experiment: _Experiment) -> None:
    """Check that an FMU goes on beyond its stop time if an episode is longer.

    Raises:
        ValueError: it does not.
    """
    asked, most = declared["episode_steps"], experiment.most(declared["control_step"])
    if most is None or asked <= most:
        return
    y, why = instance.reset(0), ""
    for k in range(asked):
        try:
            y = instance.step(sum(declared["r_tilde_bounds"]) / 2)
        except FmuError as error:
            why = str(error)
        if why or instance.ended or not math.isfinite(y):
            raise ValueError(
                f"--episode-steps is {asked}; the FMU's stop time is {experiment.stop:g} s, after {most} control steps "
                f"of {declared['control_step']:g} s, and it goes no further than {k}: {why or instance.ended or y}"
            )
