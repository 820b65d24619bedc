"""How fast the plants, the environments and training are, as ratios to what the machine can do.

Every case runs in a process of its own. The runs are interleaved, round by round, with one process at work at a time,
and in each round the two yardsticks are measured too: sgemm_gflops (numpy float32, 2048 cubed, all cores) and
normals_per_s (jitted jax.random.normal, float32, shape (1000, 256)). A ratio is the median of the ratios of the rounds.

    python benchmarks/throughput.py                                   # everything, into benchmarks/results
    python benchmarks/throughput.py --peers                           # with stable-baselines3 and sbx on the same work
    python benchmarks/throughput.py --quick --json now.json           # about two minutes
    python benchmarks/throughput.py --cases 'plant/*' fused/paper     # some cases, only printed

What the figures mean stands in benchmarks/README.md.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from statistics import median
from typing import IO, Annotated, Any, Protocol

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from tables import machine, table

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
GROUP = 8  # cases whose processes live at the same time
PEERS = ("stable-baselines3", "sbx")
PEER_UPDATES = 300  # a window
PAPER_MFLOP = 157  # of an update of the preset `paper`, as `update_mflop` counts it
PITCH_FLOP = 2 * 16 * 17  # of a control step, one matrix product
HEATERS_NORMALS = 4 * 10  # of an hour of 4 houses, one a substep

console = Console(width=None if sys.stdout.isatty() else 140)
Row = dict[str, Any]


class CaseError(Exception):
    """A case that does not run; the text says why."""


@dataclass(frozen=True)
class About:
    """What a case measures."""

    unit: str
    of: str | None = None
    extra: dict[str, Any] = field(default_factory=dict)


class Runner(Protocol):
    """A case that is set up."""

    about: About

    def run(self) -> float:
        """The figure of one run; raises CaseError."""
        ...


@dataclass(frozen=True)
class Case:
    """A case before it is set up."""

    name: str
    start: Any  # () -> context manager of a Runner, which raises CaseError
    quick: bool = False


@dataclass
class Measured:
    """What came out of the rounds of a case."""

    about: About
    rounds: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    """Of each round: the figure of the case, and those of the yardsticks."""

    def row(self, name: str) -> Row:
        """As it stands in the JSON."""
        about, values = self.about, [value for value, _ in self.rounds]
        factor = about.extra.get("mflop", 1000) / 1000  # an update counts as so many GFLOP
        ratios = [value * factor / yardsticks[about.of] for value, yardsticks in self.rounds] if about.of else []
        row: Row = {"case": name, "median": median(values), "min": min(values), "max": max(values), "unit": about.unit}
        row |= {"ratio": median(ratios) if ratios else None, "of": about.of, **about.extra}
        return {key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in row.items()}


class Worker:
    """A process of cases.py; it works only when asked."""

    def __init__(self, process: subprocess.Popen[str], errors: IO[str]) -> None:
        self._process, self._errors = process, errors
        self.about = About(**self._answer())

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if line:
            return json.loads(line)
        status = self._process.wait()
        self._errors.seek(0)
        raise CaseError((self._errors.read().strip().splitlines() or [f"its process ended with status {status}"])[-1])

    def run(self) -> float:
        """The figure of one run."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write("\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # why, stands in what it said instead of an answer
        return self._answer()["value"]


@contextmanager
def worker(name: str, seconds: float, cache: Path | None = None) -> Iterator[Worker]:
    """A process for the case, set up, whose runs take about so many seconds; compiled functions are kept in `cache`."""
    surroundings = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    surroundings |= {} if cache is None else {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    command = [sys.executable, str(HERE / "cases.py"), name, str(seconds)]
    pipes: dict[str, Any] = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=surroundings)
    with tempfile.TemporaryFile("w+") as errors, subprocess.Popen(command, stderr=errors, **pipes) as process:
        try:
            yield Worker(process, errors)
        finally:
            process.kill()


class Fresh:
    """A new process for every run."""

    def __init__(self, name: str, cache: Path | None) -> None:
        self._name, self._cache = name, cache
        with worker(name, 0, cache) as first:
            self.about = first.about
            if cache is not None:
                first.run()  # fills it

    def run(self) -> float:
        """The figure of one run."""
        with worker(self._name, 0, self._cache) as new:
            return new.run()


@contextmanager
def fresh(name: str, cached: bool) -> Iterator[Fresh]:
    """A new process for every run; if cached, they share compiled functions, and one more run fills the cache first."""
    with tempfile.TemporaryDirectory() as folder:
        yield Fresh(name, Path(folder) if cached else None)


class Peer:
    """Another library on the same work, in its own virtual environment; a run is the median of its windows."""

    def __init__(self, library: str, python: str) -> None:
        self._command = [python, str(HERE / "peers" / "run.py"), library, "--updates", str(PEER_UPDATES), "--json"]
        self.about = About("updates/s", "sgemm_gflops", {"mflop": PAPER_MFLOP, "updates_per_step": 1.0})

    def run(self) -> float:
        """The figure of one run."""
        done = subprocess.run(self._command, capture_output=True, text=True)
        if done.returncode:
            raise CaseError((done.stderr.strip().splitlines() or [f"it ended with status {done.returncode}"])[-1])
        answer = json.loads(done.stdout.strip().splitlines()[-1])
        self.about.extra.update({key: answer[key] for key in ("environment_share", "versions")})
        return median(answer["rates"])


@contextmanager
def peer(library: str) -> Iterator[Peer]:
    """The peer, in an environment that scripts/peers.sh makes the first time."""
    script = HERE.parent / "scripts" / "peers.sh"
    done = subprocess.run(["bash", str(script)], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise CaseError(f"{script} ended with status {done.returncode}; what it said stands above")
    yield Peer(library, done.stdout.strip().splitlines()[-1])


def catalogue(seconds: float) -> tuple[list[Case], list[Case]]:
    """Yardsticks and cases, as cases.py lists them; importing it here would start JAX in this process."""
    listed = subprocess.run([sys.executable, str(HERE / "cases.py"), "--list"], stdout=subprocess.PIPE)
    if listed.returncode:
        raise CaseError("the cases cannot be loaded; why, stands above")
    yardsticks: list[Case] = []
    cases: list[Case] = []
    for line in listed.stdout.splitlines():
        about = json.loads(line)
        name = about["name"]
        start = partial(fresh, name, about["cached"]) if about["fresh"] else partial(worker, name, seconds)
        (yardsticks if about["yardstick"] else cases).append(Case(name, start, about["quick"]))
    return yardsticks, cases


def choose(cases: list[Case], globs: Sequence[str], quick: bool) -> list[Case]:
    """Those that one of the globs names (none given: all), of which --quick keeps the quick ones.

    Raises:
        ValueError: a glob names nothing, or nothing is left.
    """
    for glob in globs:
        if not any(fnmatch(case.name, glob) for case in cases):
            raise ValueError(f"--cases: {glob!r} is no case; there are: {', '.join(case.name for case in cases)}")
    named = [case for case in cases if not globs or any(fnmatch(case.name, glob) for glob in globs)]
    chosen = [case for case in named if case.quick or not quick]
    if not chosen:
        raise ValueError(f"--quick leaves none of {', '.join(case.name for case in named)}; leave it away")
    return chosen


def measure_group(
    cases: list[Case], yardsticks: dict[str, Runner], runs: int, progress: Progress, task: Any
) -> tuple[dict[str, Measured], dict[str, str]]:
    """Set up some cases one after the other, then run all of them in each round.

    Returns:
        What was measured, and why the others failed.
    """
    measured: dict[str, Measured] = {}
    failed: dict[str, str] = {}
    with ExitStack() as stack:
        ready: dict[str, Runner] = {}
        for case in cases:
            progress.update(task, description=f"{case.name}, setting up")
            started: AbstractContextManager[Runner] = case.start()
            try:
                ready[case.name] = stack.enter_context(started)
                measured[case.name] = Measured(ready[case.name].about)
            except CaseError as error:
                failed[case.name] = str(error)
            progress.advance(task)
        for i in range(runs):
            now = {name: yardstick.run() for name, yardstick in yardsticks.items()}
            for case in cases:
                progress.update(task, description=f"{case.name}, run {i + 1} of {runs}")
                if case.name not in failed:
                    try:
                        measured[case.name].rounds.append((ready[case.name].run(), now))
                    except CaseError as error:
                        failed[case.name] = str(error)
                progress.advance(task)
    return {name: result for name, result in measured.items() if name not in failed}, failed


def measure(cases: list[Case], yardsticks: list[Case], runs: int) -> tuple[dict[str, Measured], dict[str, str]]:
    """All cases, a group at a time; the yardsticks live as long as all of them."""
    columns = BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}")
    measured: dict[str, Measured] = {}
    failed: dict[str, str] = {}
    with ExitStack() as stack, Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        rulers = {yardstick.name: stack.enter_context(yardstick.start()) for yardstick in yardsticks}
        task = progress.add_task("", total=len(cases) * (runs + 1))
        for first in range(0, len(cases), GROUP):
            group, failures = measure_group(cases[first : first + GROUP], rulers, runs, progress, task)
            measured |= group
            failed |= failures
            for name, result in group.items():
                progress.console.print("  ".join(cells(result.row(name))))
            for name, why in failures.items():
                progress.console.print(f"{name} failed: {why}", style="red", markup=False)
    return measured, failed


def results(measured: dict[str, Measured], about: dict[str, Any]) -> dict[str, Any]:
    """The content of the JSON file."""
    rounds = {id(now): now for result in measured.values() for _, now in result.rounds}.values()
    names = next(iter(rounds), {})
    yardsticks = {name: float(f"{median(now[name] for now in rounds):.4g}") for name in names}
    return {"machine": about, "yardsticks": yardsticks, "rows": [result.row(name) for name, result in measured.items()]}


COLUMNS = ("case", "median (min to max)", "unit", "ratio", "of")


def number(value: float) -> str:
    """Three digits and the prefix of the unit, or all before the point."""
    for size, letter in ((1e9, "G"), (1e6, "M")):
        if value >= size:
            return f"{value / size:.3g} {letter}"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def cells(row: Row) -> tuple[str, ...]:
    """A row of the table."""
    middle = f"{number(row['median'])} ({number(row['min'])} to {number(row['max'])})"
    ratio = ("", "") if row["ratio"] is None else (f"{row['ratio']:.3g}", row["of"])
    return row["case"], middle, row["unit"], *ratio


def headline(content: dict[str, Any]) -> str:
    """Machine and yardsticks in a sentence."""
    about = content["machine"]
    yardsticks = ", ".join(f"{name} {number(value)}" for name, value in content["yardsticks"].items())
    versions = ", ".join(f"{name} {about[name]}" for name in ("python", "jax", "numpy"))
    return f"{about['date']}, {about['cores']} cores of {about['cpu']}, {versions}. {yardsticks}."


def markdown(content: dict[str, Any]) -> str:
    """The table as a page."""
    rows = table(COLUMNS, map(cells, content["rows"]))
    return f"# Throughput\n\n{headline(content)}\nWhat the figures mean: [README](../README.md).\n\n{rows}\n"


def plot(content: dict[str, Any], path: Path) -> None:
    """Control steps a second against environments, for both plants, with the machine's limit."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    yardsticks = content["yardsticks"]
    limits = {
        "pitch": (yardsticks["sgemm_gflops"] * 1e9 / PITCH_FLOP, "limit: sgemm, 544 FLOP a step"),
        "heaters": (yardsticks["normals_per_s"] / HEATERS_NORMALS, "limit: normals, 40 a step"),
    }
    colors = {"plant": "#0b6fb8", "rollout": "#d1701f", "policy": "#8a8a8a"}
    labels = {"plant": "plant alone", "rollout": "environment, random r~", "policy": "with the default actor"}
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    for axes, (plant, (limit, text)) in zip(figure.subplots(1, 2, sharey=True), limits.items(), strict=True):
        for kind, color in colors.items():
            start = f"{kind}/{plant}/"
            rows = {
                int(r["case"][len(start) :]): r
                for r in content["rows"]
                if r["case"].startswith(start) and r["unit"] == "steps/s"
            }
            low, middle, high = ([rows[n][key] for n in sorted(rows)] for key in ("min", "median", "max"))
            axes.plot(sorted(rows), middle, "o-", color=color, label=labels[kind], ms=4)
            axes.fill_between(sorted(rows), low, high, color=color, alpha=0.2, lw=0)
        axes.axhline(limit, color="#b3261e", ls="--", lw=1.2, label=text)
        axes.set(title=plant, xlabel="environments", xscale="log", yscale="log")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.6)
        axes.legend(frameon=False, fontsize=8)
    figure.axes[0].set_ylabel("control steps a second")
    about = content["machine"]
    figure.suptitle(f"{about['cores']} cores of {about['cpu']}, jax {about['jax']}, {about['date']}", fontsize=9)
    figure.savefig(path, dpi=130)


def write(content: dict[str, Any], path: Path) -> None:
    """The JSON file."""
    path.write_text(json.dumps(content, indent=2) + "\n")


def main(
    json_file: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    quick: bool = False,
    peers: bool = False,
    cases: tuple[str, ...] = (),
    runs: int | None = None,
) -> None:
    """Measure, print, and write.

    Args:
        json_file: Results go here and nowhere else. Without it they go to benchmarks/results, as JSON, table and
            plot, if all cases were measured; otherwise they are only printed.
        quick: Fewer cases, short runs.
        peers: Stable-baselines3 and sbx on the work of fused/paper; the first time scripts/peers.sh installs them.
        cases: Names or globs of the cases to run; default: all.
        runs: Runs of each case; default 5, with --quick 3.
    """
    runs = runs if runs is not None else 3 if quick else 5
    if runs < 1:
        raise ValueError(f"--runs is {runs}; it must be at least 1")
    if json_file is not None and not json_file.resolve().parent.is_dir():
        raise ValueError(f"--json: there is no folder {json_file.resolve().parent}; make it first")
    yardsticks, everything = catalogue(0.2 if quick else 0.5)
    if peers:  # beside fused/paper, so that they share its rounds
        everything[1:1] = [Case(f"peer/{name}", partial(peer, name), quick=True) for name in PEERS]
    chosen = choose(everything, cases, quick)
    about = machine()
    if about["load_before"] > 0.5:
        console.print(
            f"something else is at work here (load {about['load_before']}): the figures will suffer", style="red"
        )
    measured, failed = measure(chosen, yardsticks, runs)
    content = results(measured, about)
    if json_file is not None:
        write(content, json_file)
    elif not quick and not cases and not failed:
        write(content, RESULTS / "throughput.json")
        (RESULTS / "throughput.md").write_text(markdown(content))
        plot(content, RESULTS / "throughput.png")
    shown = Table(*COLUMNS, title=headline(content), title_justify="left")
    for row in content["rows"]:
        shown.add_row(*cells(row))
    console.print(shown)
    if failed:
        raise SystemExit(f"error: {len(failed)} of {len(chosen)} cases failed: {', '.join(failed)}")


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except (ValueError, CaseError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
