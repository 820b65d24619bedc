"""Plant registry: plants that a command line may name instead of `pitch` or `heaters`.

`FILE.py:NAME` is your own plant: a function in a file that returns the plant and its parameters, like
`jaxouter.plants.pitch.make`. An installed package may provide one as an entry point of the group `jaxouter.plants`.
`gym:ID` and `fmu:FILE` run in another simulator; `log:FILE` is a model identified from recorded r~ and y.

A plant is imported only if a command line names it, never because a run folder does. Scenarios (`Tank/steps`) and
folders (`runs/Tank-default-0`) use its short name.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import logging
import re
import sys
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, wraps
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxouter import plants
from jaxouter.plants import declaration, interface, simulators
from jaxouter.plants.base import Plant, float_leaves
from jaxouter.plants.errors import PlantError, Raised, said
from jaxouter.plants.simulators import PlantOptions

GROUP = "jaxouter.plants"  # of entry points
KINDS: dict[str, Callable[[str, str, PlantOptions], tuple[Plant, Any]]] = {
    "gym": simulators.from_gymnasium,
    "fmu": simulators.from_fmu,
}
"""Makers of plants KIND:WHICH, by kind. `jaxouter.identification` adds log:FILE, as plants do not depend on it."""
FORMS = "FILE.py:NAME, gym:ID, fmu:FILE, log:FILE"


Maker = Callable[..., tuple[Plant, Any]]
"""A function, or a `jaxouter.tasks.Task`, that gives a plant and its parameters."""


class Registration(NamedTuple):
    """Where a plant comes from."""

    reference: str
    options: PlantOptions
    sha256: str  # of the plant's file, or of its function's source
    session: str = ""  # not empty if the plant is an object of this process, which no other one can import


SETTING = re.compile(r"(.*?)(\(\w+=.*\))")
"""A plant's reference and the parameters that it sets."""
REGISTRATIONS: dict[str, Registration] = {}
"""All added plants, by short name."""


def attribute(path: Path, name: str, what: str) -> Any:
    """The object called `name` in a user's Python file.

    Args:
        path, name: the file and the name in it.
        what: what it should be, for the error message.

    Raises:
        ValueError: there is no such file or name, or the file can't be imported.
    """
    spec = importlib.util.spec_from_file_location(f"jaxouter_user_{path.stem}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file; {what} is named FILE.py:NAME")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses resolve their annotations there
    try:
        spec.loader.exec_module(module)
    except Raised as error:
        raise ValueError(f"{path} can't be imported: {said(error)}") from error
    if not hasattr(module, name):
        raise ValueError(f"{path} has no {name!r}")
    return getattr(module, name)


def add(
    reference: str | Maker,
    options: PlantOptions = PlantOptions(),  # noqa: B008 - frozen
    parameters: Mapping[str, Any] | None = None,
) -> str:
    """Register a plant; returns the name by which `plants.make` finds it.

    Args:
        reference: a registered name, FILE.py:NAME and the like; parameters may follow, as in `pitch(tau=0.7)`. Or the
            plant's maker or task itself, which takes the place of one of the same name.
        options: what a plant of another simulator does not declare itself.
        parameters: of the plant, set in addition.

    Raises:
        ValueError: there is no such plant or parameter, it does not implement the interface, or its short name is
            taken.
    """
    if not isinstance(reference, str):
        return plants.with_parameters(_add_object(reference), parameters or {})
    found = SETTING.fullmatch(reference)
    plant, inner = found.groups() if found else (reference, "")
    named = _add(plant, options)
    settings = plants.parameters(named + inner) | dict(parameters or {})
    return plants.with_parameters(named, settings)


def _add_object(maker: Maker) -> str:
    """Register a maker or a task of this process; returns its short name."""
    _check(f"the plant {maker!r}", maker)
    name = getattr(maker, "__name__", None) or maker()[0].name
    if name in plants.REGISTRY and name not in REGISTRATIONS:
        raise ValueError(f"the plant {maker!r} has the name {name!r} of a built-in plant; rename it")
    try:
        source = inspect.getsource(getattr(maker, "make", maker))
    except (OSError, TypeError):  # typed in, or no function
        source = repr(maker)
    digest = hashlib.sha256(source.encode()).hexdigest()
    plants.REGISTRY[name] = _named(name, maker)
    plants._derived.cache_clear()  # of the one before
    REGISTRATIONS[name] = Registration(f"a Python object {name}", PlantOptions(), digest, uuid.uuid4().hex)
    return name


def _add(reference: str, options: PlantOptions) -> str:
    """Register a plant without parameters; returns its short name."""
    if reference in plants.REGISTRY:
        if reference not in REGISTRATIONS or options != REGISTRATIONS[reference].options:
            _plain(reference, options)
        return reference
    name, make, path = _find(reference, options)
    registered = Registration(reference, options, hashlib.sha256(path.read_bytes()).hexdigest())
    if REGISTRATIONS.get(name, registered) != registered or (name in plants.REGISTRY and name not in REGISTRATIONS):
        other = REGISTRATIONS[name].reference if name in REGISTRATIONS else "a built-in plant"
        raise ValueError(f"{reference} has the short name {name!r}, which is that of {other}; rename it")
    if name not in REGISTRATIONS:
        _check(reference, make)
        plants.REGISTRY[name] = make
        REGISTRATIONS[name] = registered
    return name


def _check(what: str, make: Maker) -> None:
    """Raises ValueError if it does not make a plant; the message begins with `what`."""
    try:
        made = make()
        plant, params = made if isinstance(made, tuple) and len(made) == 2 else (made, None)
        interface.shapes(plant, params)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error
    except Raised as error:
        raise ValueError(f"{what} can't be made: {said(error)}") from error


def _find(reference: str, options: PlantOptions) -> tuple[str, Callable[..., tuple[Plant, Any]], Path]:
    """Short name, maker and file of a plant."""
    kind, _, rest = reference.partition(":")
    if kind in KINDS:
        make, path = KINDS[kind], simulators.file_of(rest) if kind == "gym" else Path(rest)
        if not path.is_file():
            raise ValueError(f"{reference}: there is no file {rest}")
        name = _short(re.split("[/:]", rest)[-1] if kind == "gym" else path.stem)
        return name, cache(lambda: make(name, rest, options)), path
    _plain(reference, options)
    file, colon, name = reference.rpartition(":")
    if colon and file.endswith(".py"):
        return name, _named(name, attribute(Path(file), name, "a plant of your own")), Path(file)
    offered = list(entry_points(group=GROUP, name=reference))
    if not offered:
        known = dict.fromkeys([*plants.REGISTRY, *(point.name for point in entry_points(group=GROUP))])
        raise ValueError(f"there is no plant {reference!r}; the plants are: {', '.join(known)}, and {FORMS}")
    try:
        make = offered[0].load()
    except Raised as error:
        raise ValueError(f"{reference} can't be imported: {said(error)}") from error
    return reference, _named(reference, make), Path(inspect.getsourcefile(make) or "")


def _plain(reference: str, options: PlantOptions) -> None:
    if options != PlantOptions():
        raise ValueError(
            f"{reference} declares itself; options such as --y-index and --input are for gym:, fmu: and log:"
        )


def _short(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text) or "plant"


def _named(name: str, make: Callable[..., tuple[Plant, Any]]) -> Callable[..., tuple[Plant, Any]]:
    """The maker with the plant renamed and cached, so that the same plant is equal each time it is made."""
    if not callable(make):
        raise ValueError(f"{name} is {make!r}; it must be a function that returns a plant and its parameters")

    @cache
    def known(plant: Plant) -> Plant:
        return _guarded(replace(plant, name=name))

    @cache
    def made() -> Any:
        return make()

    @wraps(make)
    def named(**overrides: Any) -> Any:
        found = make(**overrides) if overrides else made()
        if isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], Plant):
            return known(found[0]), found[1]
        return found

    return named


def _guarded(plant: Plant) -> Plant:
    """The same plant, but errors in its functions name the function."""
    own = [name for name, kind in declaration.PLANT.items() if kind.function and callable(getattr(plant, name))]
    if plant.variables is float_leaves:
        own = [name for name in own if name not in ("variables", "settled")]

    def guarded(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*args: Any) -> Any:
            try:
                return function(*args)
            except PlantError:
                raise
            except Raised as error:
                raise PlantError(plant.name, f"in its function {name}", said(error)) from error

        return call

    terms = tuple(guarded(term.__name__, term) for term in plant.reward_terms)
    return replace(plant, reward_terms=terms, **{name: guarded(name, getattr(plant, name)) for name in own})


class _Kept(logging.Filter):
    """Keeps the last exception that JAX logs, and suppresses the log entry."""

    last: BaseException | None = None

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        self.last = error or self.last
        return error is None


CALLBACKS = ("jax._src.callback", "jax._src.debugging")
"""Loggers to which JAX writes the exceptions of callbacks."""


@contextmanager
def own_errors() -> Iterator[None]:
    """Re-raise errors of a plant's code in JAX callbacks as they were raised, without XLA's wrapping.

    Raises:
        PlantError: the plant's code failed.
        ValueError: JAX is told to use a platform that it does not find.
        KeyboardInterrupt: Ctrl-C in the plant's code.
    """
    kept, loggers = _Kept(), [logging.getLogger(name) for name in CALLBACKS]
    for logger in loggers:
        logger.filters.insert(0, kept)  # before the filter of an enclosing block
    try:
        yield
    except Exception as error:
        if (message := missing_platform()) is not None:
            raise ValueError(message) from error
        last, of_jax = kept.last, isinstance(error, jax.errors.JaxRuntimeError | ValueError)  # JAX raises either
        if isinstance(error, PlantError) or not of_jax or "callback" not in str(error):
            raise
        if isinstance(last, PlantError):
            raise last from last.__cause__
        if isinstance(last, KeyboardInterrupt):  # Ctrl-C while a plant was stepped
            raise last from None
        what = str(error).strip().splitlines()[-1] if last is None else said(last)
        raise PlantError(", ".join(REGISTRATIONS), "in a function that JAX calls back", what) from error
    finally:
        for logger in loggers:
            logger.removeFilter(kept)


def missing_platform() -> str | None:
    """Message if JAX is told to use a platform that it does not find (it then raises all kinds of errors); or None."""
    for variable in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME"):
        asked = jax.config.values[variable.lower()]
        if asked and asked != "cpu":
            try:
                for name in asked.split(","):
                    jax.devices(name)
            except Exception:
                jax.config.update(variable.lower(), None)
                there = ",".join(sorted({device.platform for device in jax.devices()}))
                return f"{variable} is {asked!r}, but JAX finds only {there}: unset it, or set {variable}={there}"
    return None
