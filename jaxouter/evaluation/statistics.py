"""Statistics of a comparison: ranks, intervals over seeds, probability of improvement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from msgspec.structs import replace

from jaxouter.evaluation.baselines import Kind
from jaxouter.evaluation.results import (
    BestBaseline,
    GridErrors,
    Improvement,
    Interval,
    LineSummary,
    Location,
    PolicyInfo,
    Row,
    Summary,
    SweepErrors,
)

KINDS = ("learned", "user", "baseline", "limit", "preview")  # in the order in which they are shown
RANKED = ("learned", "user", "baseline")  # the others know what no outer loop can know
RESAMPLES = 9999

Rows = Sequence[Row]
Policies = Mapping[str, PolicyInfo]


class Line(NamedTuple):
    """What is shown as one line: a policy or, where it has several runs, one of them, with all its seeds."""

    label: str
    policy: str
    run: str | None
    kind: Kind
    rows: dict[str, list[Row]]  # by scenario, one a seed

    def values(self, scenario: str, key: str) -> np.ndarray:
        """Figure of merit `key` (seeds,): infinite where the policy diverged, nan where it is not defined."""
        rows = self.rows.get(scenario, [])
        return np.array([np.inf if row.diverged else getattr(row, key) for row in rows], float)

    def median(self, scenario: str, key: str) -> float | None:
        """Median over seeds; None where it is not defined or the policy diverged."""
        values = self.values(scenario, key)
        return finite(np.median(values)) if len(values) else None

    def within_limits(self, scenario: str) -> bool:
        """Whether most of the seeds kept the limits."""
        outside = [not row.within_limits for row in self.rows.get(scenario, [])]
        return 2 * sum(outside) < len(outside)


def lines(rows: Rows, policies: Policies) -> list[Line]:
    """The lines of a comparison, learned first; of several runs each is named by its folder."""
    runs: dict[str, list[str | None]] = {}
    for row in rows:
        known = runs.setdefault(row.policy, [])
        known += [] if row.run in known else [row.run]
    found = []
    for policy in sorted(runs, key=lambda name: KINDS.index(policies[name].kind)):
        folders = [run and Path(run).name for run in runs[policy]]
        for run, folder in zip(runs[policy], folders, strict=True):
            label = policy if len(folders) == 1 else f"{policy} {folder if folders.count(folder) == 1 else run}"
            own = [row for row in rows if (row.policy, row.run) == (policy, run)]
            by_scenario = {name: [row for row in own if row.scenario == name] for name in scenarios(own)}
            found.append(Line(label, policy, run, policies[policy].kind, by_scenario))
    return found


def scenarios(rows: Rows) -> list[str]:
    """Scenarios in the order of the rows."""
    return list(dict.fromkeys(row.scenario for row in rows))


def finite(value: Any) -> float | None:
    """The number as a JSON value: None where it is not finite."""
    return float(value) if np.isfinite(value) else None


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis without the lowest and the highest quarter."""
    return scipy.stats.trim_mean(values, 0.25, axis=-1)


def interval(statistic: Callable[..., Any], samples: Sequence[np.ndarray]) -> Interval | None:
    """95 % bootstrap interval of a statistic, each sample resampled on its own.

    Args:
        statistic: of the samples, vectorised: each has the shape (..., n), the result (...).
        samples: (n,) each; one with a single value stays as it is.

    Returns:
        Lowest and highest value, the same at every call; None where no sample has two values.
    """
    free = [i for i, sample in enumerate(samples) if len(sample) > 1]
    if not free:
        return None

    def of_free(*resampled: np.ndarray, axis: int) -> Any:
        assert axis == -1
        return statistic(*(dict(zip(free, resampled, strict=True)).get(i, fixed) for i, fixed in enumerate(samples)))

    found = scipy.stats.bootstrap(
        [samples[i] for i in free],
        of_free,
        n_resamples=RESAMPLES,
        vectorized=True,
        axis=-1,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(found.low), float(found.high)


def location(samples: Sequence[np.ndarray]) -> Location:
    """Median and interquartile mean over seeds, averaged over scenarios, with stratified bootstrap intervals.

    Args:
        samples: of each scenario (seeds,); infinite where a seed diverged.

    Returns:
        None where there is no sample or the value is infinite, and for intervals with one seed or where one diverged.
    """
    if not samples:
        return Location()
    bounded = all(np.isfinite(sample).all() for sample in samples)

    def averaged(centre: Callable[[np.ndarray], Any]) -> tuple[float | None, Interval | None]:
        def mean(*strata: np.ndarray) -> Any:
            return sum(centre(stratum) for stratum in strata) / len(strata)

        return finite(mean(*samples)), interval(mean, samples) if bounded else None

    return Location(*averaged(partial(np.median, axis=-1)), *averaged(interquartile_mean))


def improvement(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> Improvement:
    """Probability that a seed of ours has a lower error than one of theirs: mean over scenarios, ties count half.

    Args:
        ours, theirs: errors of each scenario, (seeds,) and (seeds of the other,); infinite where diverged.

    Source: Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, 2021, section 4.3.
    """
    n = len(ours)

    def probability(*samples: np.ndarray) -> Any:
        pairs = [(x[..., :, None], y[..., None, :]) for x, y in zip(samples[:n], samples[n:], strict=True)]
        return sum(np.mean((x < y) + 0.5 * (x == y), axis=(-2, -1)) for x, y in pairs) / n

    samples = [*ours, *theirs]
    return Improvement(float(probability(*samples)), interval(probability, samples))


def ranking(rows: Rows, policies: Policies) -> dict[str, dict[str, int]]:
    """Rank of each line, by scenario.

    Learned, users' and baseline policies that stay within the limits and do not diverge are ranked by their MAE, a line
    by its median over seeds; ties get the better rank. The other lines have none.
    """
    contestants = [line for line in lines(rows, policies) if line.kind in RANKED]
    table = {}
    for name in scenarios(rows):
        maes = {line.label: line.median(name, "mae") for line in contestants if line.within_limits(name)}
        maes = {label: mae for label, mae in maes.items() if mae is not None}
        table[name] = dict(zip(maes, map(int, scipy.stats.rankdata([*maes.values()], method="min")), strict=True))
    return table


def ranks(rows: Rows, policies: Policies) -> list[Row]:
    """The rows with `rank` and `best` filled in; all seeds of a line get its rank."""
    table = ranking(rows, policies)
    label = {(line.policy, line.run): line.label for line in lines(rows, policies)}
    found = [table[row.scenario].get(label[row.policy, row.run]) for row in rows]
    return [replace(row, rank=rank, best=rank == 1) for row, rank in zip(rows, found, strict=True)]


def summarise(rows: Rows, policies: Policies) -> Summary:
    """Everything that is said over seeds."""
    every, table = lines(rows, policies), ranking(rows, policies).values()
    limited = scenarios([row for row in rows if row.ratio_to_limit is not None])
    last = sum(line.kind in RANKED for line in every)
    found = {}
    for line in every:
        ratios = {name: line.values(name, "ratio_to_limit") for name in limited if name in line.rows}
        own = [of_scenario.get(line.label) for of_scenario in table] if line.kind in RANKED else []
        found[line.label] = LineSummary(
            policy=line.policy,
            run=line.run,
            kind=line.kind,
            seeds=max(map(len, line.rows.values())),
            mean_rank=float(np.mean([rank or last for rank in own])) if own else None,
            first=own.count(1) if own else None,
            unranked=own.count(None) if own else None,
            scenarios={name: location([sample]) for name, sample in ratios.items()},
            mean=location(list(ratios.values()) if len(ratios) == len(limited) else []),
        )
    learned = [line for line in every if line.kind == "learned"]
    others = [line for line in every if line.kind in ("baseline", "user")]
    return Summary(limited, found, {line.label: _improvements(line, others) for line in learned})


def _improvements(ours: Line, others: Sequence[Line]) -> dict[str, Improvement]:
    """Over each of the other lines, by label."""
    found = {}
    for theirs in others:
        common = [name for name in ours.rows if name in theirs.rows]
        if common:
            samples = ([line.values(name, "mae") for name in common] for line in (ours, theirs))
            found[theirs.label] = improvement(*samples)
    return found


def table(rows: Rows, policies: Policies, best: str) -> tuple[list[str], list[list[str]]]:
    """MAE and ratio to the limit as text, a line a scenario and a column a policy, medians over seeds.

    Args:
        rows: with their ranks.
        policies: as in comparison.json.
        best: format of the best of each scenario, such as `**{}**`; one outside the limits has a `!`.

    Returns:
        Titles of the columns, and the lines.
    """
    every, body = lines(rows, policies), []
    for name in scenarios(rows):
        cells = [name]
        for line in every:
            mae, ratio = line.median(name, "mae"), line.median(name, "ratio_to_limit")
            text = "diverged" if mae is None else f"{mae:.3g}" + ("" if ratio is None else f" ({ratio:.2f})")
            text += "" if mae is None or line.within_limits(name) else "!"
            cells.append(best.format(text) if any(row.best for row in line.rows.get(name, [])) else text)
        body.append(cells)
    return ["scenario", *(line.label for line in every)], body


def on_grid(swept: GridErrors, values: Sequence[Sequence[float]]) -> np.ndarray:
    """MAE of one policy of a sweep at other values of the axes; nan where it diverged or did not run.

    Args:
        swept: of the policy, on its own grid.
        values: wanted, a list an axis.
    """
    mae = swept.grid
    out = np.full([len(axis) for axis in values], np.nan)
    for place in np.ndindex(*out.shape):
        hits = [
            np.flatnonzero(np.isclose(own, wanted[i], rtol=0, atol=1e-9))
            for own, wanted, i in zip(swept.values, values, place, strict=True)
        ]
        if all(len(hit) for hit in hits):
            out[place] = mae[tuple(hit[0] for hit in hits)]
    return out


def best_baseline(sweep: SweepErrors, policies: Policies) -> BestBaseline | None:
    """The least MAE of all baselines; None without a baseline or a point of the grid that they have in common."""
    baselines = {
        name: swept for name, swept in sweep.policies.items() if name in policies and policies[name].kind == "baseline"
    }
    if not baselines:
        return None
    grids = [swept.values for swept in baselines.values()]
    values = [
        [v for v in grids[0][i] if all(np.isclose(grid[i], v, rtol=0, atol=1e-9).any() for grid in grids)]
        for i in range(len(sweep.axes))
    ]
    if not all(values):
        return None
    maes = np.stack([on_grid(swept, values) for swept in baselines.values()])
    maes = np.where(np.isnan(maes), np.inf, maes)
    least = maes.min(0)
    policy = np.where(np.isfinite(least), np.array([*baselines], object)[maes.argmin(0)], np.array(None))
    mae = np.where(np.isfinite(least), least.astype(object), np.array(None))
    return BestBaseline(values, mae.tolist(), policy.tolist())
