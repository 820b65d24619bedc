"""What became slower between two results of throughput.py, and what became faster.

    python benchmarks/slower.py BEFORE.json AFTER.json [--tolerance 0.1]

Compared are the ratios to the yardsticks where there are any, so that another machine, or the same one on another day,
is no difference; otherwise the medians; of one machine both, and the smaller change counts, since a yardstick drifts
too. A case changed if its figure moved by more than the tolerance and each median lies outside the other's range from
least to greatest. Ends with status 1 if something became slower.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

LESS_IS_BETTER = ("s", "MiB")


@dataclass(frozen=True)
class Figure:
    """A row's figure, larger is better."""

    low: float
    middle: float
    high: float


def figure(row: dict[str, Any], by_ratio: bool) -> Figure:
    """The ratio, with the range of the rates scaled alike; or the median; its inverse where less is better."""
    scale = row["ratio"] / row["median"] if by_ratio else 1.0
    low, middle, high = (row[key] * scale for key in ("min", "median", "max"))
    return Figure(1 / high, 1 / middle, 1 / low) if row["unit"] in LESS_IS_BETTER else Figure(low, middle, high)


def change(
    before: dict[str, Any], after: dict[str, Any], tolerance: float, same_machine: bool = False
) -> tuple[float, bool]:
    """How many times as good the second row is, and whether that is more than chance."""
    by_ratio = before["ratio"] is not None and after["ratio"] is not None
    found = [_compared(before, after, tolerance, by_ratio)]
    if by_ratio and same_machine:
        found.append(_compared(before, after, tolerance, False))
    factor = min((factor for factor, _ in found), key=lambda factor: abs(math.log(factor)))
    return factor, all(real for _, real in found) and len({factor > 1 for factor, _ in found}) == 1


def _compared(before: dict[str, Any], after: dict[str, Any], tolerance: float, by_ratio: bool) -> tuple[float, bool]:
    a, b = figure(before, by_ratio), figure(after, by_ratio)
    apart = not a.low <= b.middle <= a.high and not b.low <= a.middle <= b.high
    factor = b.middle / a.middle
    return factor, apart and not 1 - tolerance <= factor <= 1 / (1 - tolerance)


def rows(path: Path) -> tuple[dict[str, dict[str, Any]], Any]:
    """Rows of a results file by case, and the processor and number of cores that they are of.

    Raises:
        ValueError: it is none.
    """
    try:
        content = json.loads(path.read_text())
        machine = content.get("machine") or {}
        return {row["case"]: row for row in content["rows"]}, (machine.get("cpu"), machine.get("cores"))
    except (OSError, json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not a results file of benchmarks/throughput.py ({error!r})") from None


def main(before: tyro.conf.Positional[Path], after: tyro.conf.Positional[Path], tolerance: float = 0.1) -> None:
    """Name what changed.

    Args:
        before: Results to compare with.
        after: Results to judge.
        tolerance: Share of the figure before by which it may change.
    """
    if not 0 <= tolerance < 1:
        raise ValueError(f"--tolerance is {tolerance}; it must lie in [0, 1)")
    (old, old_machine), (new, new_machine) = rows(before), rows(after)
    same = old_machine == new_machine != (None, None)
    changes = {case: change(old[case], new[case], tolerance, same) for case in old if case in new}
    slower = {case: factor for case, (factor, real) in changes.items() if real and factor < 1}
    faster = {case: factor for case, (factor, real) in changes.items() if real and factor > 1}
    for word, those in (("slower", slower), ("faster", faster)):
        for case, factor in sorted(those.items(), key=lambda item: item[1]):
            a, b, unit = old[case]["median"], new[case]["median"], new[case]["unit"]
            print(f"{word}  {case}: {factor:.2f} x as good ({a:g} -> {b:g} {unit})")
    for word, those in (("missing", set(old) - set(new)), ("new", set(new) - set(old))):
        for case in sorted(those):
            print(f"{word}  {case}")
    print(f"{len(changes)} cases compared: {len(slower)} slower, {len(faster)} faster, by more than {tolerance:.0%}")
    raise SystemExit(1 if slower else 0)


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
