"""Read columns of numbers from CSV and Parquet files; errors say what is wrong and what to write instead."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

CONTENTS = {  # first bytes of files that are no CSV in spite of their name
    b"PK\x03\x04": "a workbook (.xlsx, .ods) or another zip file; export it as CSV",
    b"\xd0\xcf\x11\xe0": "an old workbook (.xls); export it as CSV",
    b"\x1f\x8b": "compressed; unpack it first",
    b"PAR1": "Parquet; name it .parquet",
}
SEPARATORS = {";": ("';'", "';'"), "\t": ("tabs", r"'\t'"), "|": ("'|'", "'|'"), None: ("spaces", r"r'\s+'")}
MEANT = {  # column names that data loggers write; in lower case, letters and digits only
    "time": ("t", "times", "timestamp", "datetime", "date", "seconds", "sec", "elapsedtime", "zeit", "temps", "tiempo"),
    "r_tilde": ("r~", "r̃", "rt", "r", "setpoint", "sp", "reference", "ref", "command", "input", "u", "sollwert"),
    "y": ("output", "out", "pv", "processvalue", "measurement", "measured", "istwert"),
    "r": ("reference", "ref", "setpoint", "sp", "sollwert"),
}
PREAMBLE = 50  # lines in which the header is searched
MISSING = ("", "-", "?", "na", "n/a", "#n/a", "null", "none", "missing")
NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?"
DATE = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}([T\s]|$)|\d{1,2}:\d{2}", re.IGNORECASE)
THOUSANDS = re.compile(r"[+-]?\d{1,3}((?P<mark>[,.' _\u00a0\u202f’])\d{3})((?P=mark)\d{3})*([.,]\d+)?")


def read(path: Path, names: Sequence[str]) -> list[np.ndarray]:
    """The columns with these names, (N,) each; others are ignored.

    Args:
        path: a CSV or, by its suffix, a Parquet file.
        names: of the columns.

    Raises:
        ValueError: names the file, the row (of the data, from 1 on), what is wrong and what to write instead.
    """
    try:
        content = path.read_bytes()
        table = _parquet(content, names) if path.suffix.lower() == ".parquet" else _csv(content, names)
        return [_floats(name, column) for name, column in zip(names, table, strict=True)]
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror or error}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _csv(content: bytes, names: Sequence[str]) -> list[list[str]]:
    """The columns with these names."""
    text = _text(content, names)
    try:
        reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
        rows = [row for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise ValueError(f"it is no CSV: {error}") from None
    header = [name.strip() for name in rows.pop(0)]
    while not header[-1]:  # a separator at the end of the line
        header.pop()
    if not set(names) <= set(header):
        _look_for_header(header, text.splitlines()[:PREAMBLE], names)
    places = _places(header, names)
    for number, row in enumerate(rows, 1):
        if len(row) < len(header) or any(map(str.strip, row[len(header) :])):
            raise ValueError(_length(number, row, header))
    return [[row[place] for row in rows] for place in places]


def _text(content: bytes, names: Sequence[str]) -> str:
    """Raises ValueError if it is empty or not UTF-8."""
    for begin, what in CONTENTS.items():
        if content.startswith(begin):
            raise ValueError(f"it is no CSV but {what}")
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or content[:200].count(0) > 50:
        raise ValueError("it is UTF-16; save it as UTF-8, in a spreadsheet as 'CSV UTF-8'")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ValueError(f"line {line} is no UTF-8; save the file as UTF-8, in a spreadsheet as 'CSV UTF-8'") from None
    if not text.strip():
        raise ValueError(f"it is empty; its first line must be {','.join(names)}, and a row of numbers each other one")
    return text


def _look_for_header(header: list[str], lines: list[str], names: Sequence[str]) -> None:
    """Raises ValueError if the header is hidden: lines before it, another separator, or numbers in its place."""
    for number, line in enumerate(lines[1:], 2):
        cells = [cell.strip(" '\"") for cell in re.split(r"[,;\t|]", line)]
        if all(any(_means(cell, name) for cell in cells) for name in names):
            before = f"{number - 1} lines" if number > 2 else "line"
            raise ValueError(f"its header is in line {number}; remove the {before} before it")
    first, *others = [line for line in lines if line.strip()]
    for mark, (called, sep) in SEPARATORS.items():
        cells = len(first.split(mark))
        if cells > max(len(header), len(names) - 1) and all(len(line.split(mark)) == cells for line in others[:1]):
            comma = any(re.search(r"\d,\d", line) for line in others)
            raise ValueError(
                f"its columns are separated by {called}{' and its decimals are commas' if comma else ''}; write "
                "',' between columns and '.' in numbers: with pandas, "
                f"read_csv(FILE, sep={sep}{', decimal=' + repr(',') if comma else ''}).to_csv(NEW, index=False)"
            )
    if all(_is_number(name) for name in header):
        raise ValueError(f"its first line is numbers; write the header {','.join(names)} above it")


def _places(header: Sequence[str], names: Sequence[str]) -> list[int]:
    """Indices of the columns.

    Raises:
        ValueError: a column is missing or there twice.
    """
    found = []
    for name in names:
        if header.count(name) > 1:
            found.append(f"{header.count(name)} columns {name!r}")
        elif name not in header:
            perhaps = [repr(other) for other in header if other not in names and _means(other, name)]
            found.append(f"no column {name!r}" + (f" but {' and '.join(perhaps)}" if perhaps else ""))
    if found:
        unit = " (in s)" if "time" in names and "time" not in header else ""
        wanted = ",".join(names)
        raise ValueError(
            f"it has {', and '.join(found)}; its header must hold {wanted}{unit}, and is {','.join(header)}"
        )
    return [header.index(name) for name in names]


def _means(cell: str, name: str) -> bool:
    """Whether a column's name is a variant of `name`: another case, unit, language or the like."""
    plain = re.sub(r"[\[({<].*|[/,].*", "", cell.strip().strip("#%/;!'\" ").lower())
    plain = re.sub(r"[\s_.-]", "", plain)
    if name == "time":
        plain = re.sub(r"^(time|t)(s|ms|us|sec|min|h)$", r"\1", plain)
    return plain in (name.replace("_", ""), *MEANT.get(name, ()))


def _length(number: int, row: Sequence[str], header: Sequence[str]) -> str:
    """What is wrong with a row whose number of values differs from the header's."""
    counts = f"row {number} has {len(row)} values, the header {len(header)} names"
    if len(row) < len(header):
        return f"{counts}; complete the row or remove it"
    if all(re.fullmatch(r"[+-]?\d+", cell.strip()) for cell in row):
        return f"{counts}: decimals are commas; write '.' in numbers, as in 0.5"
    return f"{counts}; name every column, and write '.', not ',', in numbers"


def _parquet(content: bytes, names: Sequence[str]) -> list[list[Any]]:
    """The columns with these names."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise ValueError("it takes pyarrow to read: pip install 'jaxouter[parquet]', or write it as CSV") from None
    if not content.startswith(b"PAR1"):
        raise ValueError("it is no Parquet; if it is text, name it .csv")
    try:
        table = parquet.read_table(pyarrow.BufferReader(content))
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(f"it is no Parquet that can be read: {error}") from None
    columns = [table.column(place) for place in _places(table.column_names, names)]
    for name, column in zip(names, columns, strict=True):
        if pyarrow.types.is_temporal(column.type):
            raise ValueError(f"{name} is of type {column.type}; {_number_not_date(name)}")
    return [column.to_pylist() for column in columns]


def _floats(name: str, column: Iterable[Any]) -> np.ndarray:
    out = []
    for row, value in enumerate(column, 1):
        if not _is_number(value):
            raise ValueError(f"{name} in row {row} is {value!r}; {_cure(name, value)}")
        out.append(float(value))
    return np.array(out)


def _is_number(value: Any) -> bool:
    with suppress(TypeError, ValueError):
        float(value)
        return "_" not in str(value)
    return False


def _cure(name: str, value: Any) -> str:
    """What to write instead of a value that is not a number."""
    text = "" if value is None else str(value).strip()
    if text.lower() in MISSING:
        return "it is missing: fill it in, or cut the record there"
    if DATE.match(text):
        return _number_not_date(name)
    if THOUSANDS.fullmatch(text) and not re.fullmatch(r"[+-]?\d+,\d+", text):
        return "write it without marks between thousands, and with '.' before decimals, as in 1234.5"
    if re.fullmatch(r"[+-]?\d+,\d+(e[+-]?\d+)?", text.lower()):
        return f"write {text.replace(',', '.')} where ',' is a decimal comma, {text.replace(',', '')} where not"
    if re.match(NUMBER + r"\s*\D", text.lower()):
        return "write the number alone, without a unit"
    return "it must be a number"


def _number_not_date(name: str) -> str:
    if name != "time":
        return f"{name} must be a number, no date"
    return (
        "time must be a number of seconds, no date or time of day: with pandas, t = pandas.to_datetime(time), then "
        "(t - t.iloc[0]).dt.total_seconds()"
    )
