"""CSV and Parquet files as loggers, spreadsheets and their exports write them: the cause and the cure are named."""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from jaxouter.identification import columns

NAMES = ("time", "r_tilde", "y")
ROWS = [(0.0, 1.0, 2.5), (0.5, 1.5, -3e-2), (1.0, 2.0, 1234.5)]


def table(header: str = "time,r_tilde,y", sep: str = ",", decimal: str = ".", before: str = "", end: str = "\n") -> str:
    rows = [sep.join(f"{value}".replace(".", decimal) for value in row) for row in ROWS]
    return before + end.join([header.replace(",", sep), *rows, ""])


def read(place: Path, content: str | bytes, names: tuple[str, ...] = NAMES) -> list[np.ndarray]:
    path = place / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return columns.read(path, names)


@pytest.mark.parametrize(
    "content",
    [
        table(),
        table(" time , r_tilde , y ", ", "),
        table('"time","r_tilde","y"'),
        "\n".join(",".join(f'"{value}"' for value in row) for row in [NAMES, *ROWS]),
        "\ufeff" + table(),
        table(end="\r\n"),
        table(end="\r"),
        table(before="\n\n") + "\n ,,\n",
        table("time,r_tilde,y,"),
        table().replace("\n", ",\n"),
    ],
)
def test_variations_without_harm_are_read(tmp_path, content):
    np.testing.assert_array_equal(np.transpose(read(tmp_path, content)), ROWS)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ["is empty", "time,r_tilde,y"]),
        ("\ufeff \n\n", ["is empty"]),
        (table(sep=";"), ["separated by ';'", "sep=';')"]),
        (table(sep=";", decimal=","), ["separated by ';' and its decimals are commas", "sep=';', decimal=',')"]),
        (table("Zeit [s],Soll,Ist", sep=";", decimal=","), ["separated by ';' and its decimals are commas"]),
        (table("Zeit [s],Soll,Ist", sep="\t", decimal=","), ["separated by tabs and its decimals are commas"]),
        (table(sep="\t"), ["separated by tabs", r"sep='\t'"]),
        (table(sep="|"), ["separated by '|'"]),
        (table(sep="  "), ["separated by spaces", r"sep=r'\s+'"]),
        (table(sep=";", before="sep=;\n"), ["its header is in line 2; remove the line before it"]),
        (table(decimal=","), ["row 1 has 6 values, the header 3 names", "decimals are commas", "as in 0.5"]),
        (table().replace("2.5", "2,5"), ["row 1 has 4 values, the header 3 names", "not ','"]),
        (table().replace("1.5,", ""), ["row 2 has 2 values, the header 3 names", "complete the row or remove it"]),
        (table().replace("1.5", '"1,5"'), ["r_tilde in row 2 is '1,5'", "write 1.5 where ',' is a decimal comma"]),
        (table().replace("1234.5", '"1,234.5"'), ["y in row 3 is '1,234.5'", "without marks between thousands"]),
        (table().replace("1234.5", '"1.234,5"'), ["without marks between thousands"]),
        (table().replace("1234.5", "1 234.5"), ["without marks between thousands"]),
        (table().replace("1234.5", "1'234.5"), ["without marks between thousands"]),
        (table().replace("1234.5", "1_234.5"), ["without marks between thousands"]),
        (table().replace("2.5", "2.5 degC"), ["y in row 1 is '2.5 degC'", "without a unit"]),
        (table().replace("2.5", "25%"), ["without a unit"]),
        (table().replace("2.5", "#N/A"), ["y in row 1 is '#N/A'", "it is missing"]),
        (table().replace("2.5", ""), ["y in row 1 is ''", "it is missing"]),
        (table().replace("2.5", "high"), ["y in row 1 is 'high'; it must be a number"]),
        (table().replace("0.5,", "2026-11-28T22:00:01Z,"), ["time in row 2", "of seconds", "total_seconds()"]),
        (table().replace("0.5,", "2026-11-28 22:00,"), ["of seconds", "total_seconds()"]),
        (table().replace("0.5,", "28.11.2026 22:00:00,"), ["of seconds"]),
        (table().replace("0.5,", "11/28/26,"), ["of seconds"]),
        (table().replace("0.5,", "22:00:01.5,"), ["of seconds"]),
        (table("Time,R_tilde,Y"), ["no column 'time' but 'Time'", "'r_tilde' but 'R_tilde'", "no column 'y' but 'Y'"]),
        (table("time [s],r~,y [degC]"), ["no column 'time' but 'time [s]'", "'r~'", "but 'y [degC]'"]),
        (table("Time (ms),r_tilde,y"), ["no column 'time' but 'Time (ms)'", "time,r_tilde,y (in s), and is Time (ms)"]),
        (table("Zeit,Sollwert,Istwert"), ["but 'Zeit'", "but 'Sollwert'", "but 'Istwert'"]),
        (table("time_s,r-tilde,PV"), ["but 'time_s'", "but 'r-tilde'", "but 'PV'"]),
        (table("timestamp,r_tilde,y"), ["no column 'time' but 'timestamp'"]),
        (table("# time,r_tilde,y"), ["no column 'time' but '# time'"]),
        (table("k,r_tilde,y"), ["no column 'time'; its header must hold time,r_tilde,y (in s), and is k,r_tilde,y"]),
        (table("time,r_tilde,y,y").replace("2.5", "2.5,1"), ["2 columns 'y'"]),
        (table("k,a,b", sep=";", before="Device 7, lab 2, made on Monday\n"), ["no column 'time', and no"]),
        (table("0,1,2"), ["its first line is numbers", "header time,r_tilde,y"]),
        (table(before="# made by a logger, 2026\n"), ["its header is in line 2; remove the line before it"]),
        (table("Time [s],r~,y", before="Device,7\nDate,today\n\n"), ["its header is in line 4; remove the 3 lines"]),
        (table().encode("utf-16"), ["is UTF-16", "UTF-8"]),
        (table().encode("utf-16-le"), ["is UTF-16"]),
        (table("time,r_tilde,y,°C").encode("latin-1"), ["line 1 is no UTF-8", "save the file as UTF-8"]),
        (b"PK\x03\x04 and so on", ["it is no CSV but a workbook", "export it as CSV"]),
        (b"\x1f\x8b\x08", ["compressed"]),
        (b"PAR1...", ["name it .parquet"]),
    ],
)
def test_cause_and_cure_are_named(tmp_path, content, words):
    with pytest.raises(ValueError, match=r"log\.csv: ") as caught:
        read(tmp_path, content)
    assert [word for word in words if word not in str(caught.value)] == []
    assert len(str(caught.value)) < 400


def test_other_columns_may_be_anything_and_a_name_that_is_there_counts(tmp_path):
    (r,) = read(tmp_path, 'Time,note,R,r\n22:00,"a, b",1,0.5\n22:01,,2,0.75\n', ("r",))
    np.testing.assert_array_equal(r, [0.5, 0.75])
    with pytest.raises(ValueError, match="no column 'r' but 'Setpoint'; its header must hold r, and is Setpoint,y"):
        read(tmp_path, "Setpoint,y\n1,2\n", ("r",))


def test_what_is_no_file_is_said_in_a_line(tmp_path):
    with pytest.raises(ValueError, match=r"none\.csv can't be read: No such file"):
        columns.read(tmp_path / "none.csv", NAMES)
    with pytest.raises(ValueError, match="can't be read: Is a directory"):
        columns.read(tmp_path, NAMES)


NOW = datetime.datetime(2026, 11, 28, 22)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"Time": [0.0], "r_tilde": [1.0], "y": [2.0]}, ["no column 'time' but 'Time'"]),
        ({"time": [NOW], "r_tilde": [1.0], "y": [2.0]}, ["time is of type timestamp[us]", "number of seconds"]),
        ({"time": [datetime.timedelta(seconds=1)], "r_tilde": [1.0], "y": [2.0]}, ["time is of type duration"]),
        ({"time": [0.0], "r_tilde": ["1,5"], "y": [2.0]}, ["r_tilde in row 1 is '1,5'", "a decimal comma"]),
        ({"time": ["2026-11-28T22:00"], "r_tilde": [1.0], "y": [2.0]}, ["time in row 1", "total_seconds()"]),
        ({"time": [0.0], "r_tilde": [None], "y": [2.0]}, ["r_tilde in row 1 is None", "it is missing"]),
        ({"time": [0.0], "r_tilde": [[1.0]], "y": [2.0]}, ["r_tilde in row 1 is [1.0]; it must be a number"]),
    ],
)
def test_parquet_has_the_same_causes(tmp_path, content, words):
    path = tmp_path / "log.parquet"
    parquet.write_table(pyarrow.table(content), path)
    with pytest.raises(ValueError, match=re.escape(words[0])) as caught:
        columns.read(path, NAMES)
    assert [word for word in [str(path), *words] if word not in str(caught.value)] == []


@pytest.mark.parametrize(("content", "words"), [(b"time,r_tilde,y\n", "name it .csv"), (b"PAR1 cut", "can be read")])
def test_what_is_no_parquet_is_told(tmp_path, content, words):
    path = tmp_path / "log.parquet"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(words)):
        columns.read(path, NAMES)
