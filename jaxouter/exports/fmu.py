"""The controller as an FMU for FMI 2.0 co-simulation; it runs the C code of `exports.c`, no Python."""

from __future__ import annotations

import platform
import tempfile
import uuid
import zipfile
from pathlib import Path

import jaxouter
from jaxouter.exports import c
from jaxouter.exports.spec import ControllerSpec

SECONDS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
BASE_UNITS = {  # attributes of FMI's BaseUnit, so that importers can convert these units
    "s": {"s": 1},
    "rad": {"rad": 1},
    "crad": {"rad": 1, "factor": 0.01},
    "K": {"K": 1},
    "degC": {"K": 1, "offset": 273.15},
}
PLATFORMS = {"Linux": ("linux64", ".so"), "Windows": ("win64", ".dll"), "Darwin": ("darwin64", ".dylib")}
BEGINNING = (1980, 1, 1, 0, 0, 0)  # earliest time in a zip file; fixed, so that equal controllers give equal files


def control_step(spec: ControllerSpec) -> float:
    """The control step in seconds, FMI's unit of time; unconverted if the unit is unknown."""
    return spec.control_step * SECONDS.get(spec.time_unit, 1.0)


def platform_folder() -> tuple[str, str]:
    """FMI's folder for libraries of this system, and their file suffix.

    Raises:
        FileNotFoundError: FMI 2.0 does not support this system.
    """
    system = platform.system()
    if system not in PLATFORMS:
        raise FileNotFoundError(f"this system is {system}; FMI 2.0 has binaries for {', '.join(PLATFORMS)}")
    return PLATFORMS[system]


def texts(spec: ControllerSpec) -> dict[str, str]:
    """The text files of the FMU, by their path in it."""
    name = c.prefix(spec)
    header, source = c.header_and_source(spec, name)
    time_unit = "s" if spec.time_unit in SECONDS else spec.time_unit
    values = dict(
        spec=spec,
        name=name,
        guid=f"{{{uuid.uuid5(uuid.NAMESPACE_URL, source)}}}",  # differs from controller to controller
        step=control_step(spec),
        time_unit=time_unit,
        units={unit: BASE_UNITS.get(unit) for unit in dict.fromkeys((spec.y_unit, time_unit))},
        version=jaxouter.__version__,
    )
    return {
        "modelDescription.xml": c.render("modelDescription.xml.j2", **values),
        "sources/buildDescription.xml": c.render("buildDescription.xml.j2", **values),
        f"sources/{name}.h": header,
        f"sources/{name}.c": source,
        "sources/fmu.c": c.render("fmu.c.j2", **values),
    }


def save(spec: ControllerSpec, path: Path) -> None:
    """Write the FMU, with a library for this system.

    Raises:
        FileNotFoundError: there is no C compiler.
    """
    folder, suffix = platform_folder()
    name, files = c.prefix(spec), texts(spec)
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        (root / "sources").mkdir()
        for each, text in files.items():
            (root / each).write_text(text, encoding="utf-8")
        library = root / f"{name}{suffix}"
        sources = sorted((root / "sources").glob("*.c"))
        c.shared_library(sources, library, "-fvisibility=hidden")  # symbols of two FMUs in one process must not clash
        contents = {each: text.encode() for each, text in files.items()}
        contents[f"binaries/{folder}/{name}{suffix}"] = library.read_bytes()
    with zipfile.ZipFile(path, "w") as file:
        for each, content in contents.items():
            file.writestr(zipfile.ZipInfo(each, BEGINNING), content, zipfile.ZIP_DEFLATED)
