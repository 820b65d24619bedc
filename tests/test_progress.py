"""What commands show: on terminals of several widths, by a clock that stands still, and in plain lines."""

import io
import re
import sys
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from unittest.mock import patch

import pytest
from rich.console import Console

from jaxouter import check, cli, compare, evaluate, export, progress, train
from jaxouter.api import learning as learning_
from jaxouter.evaluation import policies as evaluation
from jaxouter.evaluation import scenarios
from jaxouter.evaluation.metrics import FiguresOfMerit
from jaxouter.evaluation.results import Comparison, PolicyInfo, Row, Summary
from jaxouter.evaluation.scenarios import Known
from jaxouter.plants import REGISTRY, host, registry
from jaxouter.progress import FIRST_PHASE, Progress, TimeLeft
from jaxouter.training.config import preset
from tests import lag
from tests.load import ROOT
from tests.training.small import small

STYLE = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")


class Clock:
    """Time that passes only when told."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def shown(of: Progress, width: int) -> list[str]:
    """What a terminal of that width shows, without colours."""
    console = Console(file=io.StringIO(), force_terminal=True, width=width, height=24)
    console.print(of._render())
    lines = STYLE.sub("", console.file.getvalue()).splitlines()
    assert max(map(len, lines)) <= width
    return lines


def learning(clock: Clock, width: int = 80, seeds: int = 1) -> Progress:
    """A third of a training, after ten seconds of compilation."""
    of = Progress(Console(file=io.StringIO(), force_terminal=True, width=width), clock=clock)
    of.phase("compiling", 1500.0)
    clock.now += 10
    of.phase("learning")
    mae = "MAE " + ("2.812" if seeds == 1 else ", ".join(f"seed {i} 2.812" for i in range(seeds))) + " crad"
    for done in range(50, 501, 50):
        of.reach(done, mae=mae, count=f"{done:,} of 1,500 gradient steps")
        clock.now += 1
    return of


@pytest.mark.parametrize("width", [80, 200])
def test_one_line_and_a_bar_across_the_terminal(clock, width):
    text, bar = shown(learning(clock, width), width)
    assert text.rstrip() == "learning  MAE 2.812 crad  500 of 1,500 gradient steps"
    assert bar.endswith(" 33% 0:19 left")  # 1,000 gradient steps at 50 a second, a second after the last report
    assert len(bar) == width
    assert re.fullmatch(r"━+[╸╺]━+  33% 0:19 left", bar)


@pytest.mark.parametrize("width", [20, 30, 40])
def test_narrow_terminals_show_mae_and_time_left(clock, width):
    lines = shown(learning(clock, width), width)
    whole = " ".join(" ".join(lines).split())
    assert len(lines) <= 5
    assert "MAE 2.812 crad" in whole
    assert lines[-1].endswith(" 0:19 left")
    assert ("33%" in lines[-1]) == (width >= 30)


def test_many_seeds_take_few_lines(clock):
    lines = shown(learning(clock, seeds=8), 80)
    assert len(lines) <= 4
    assert all(f"seed {i} 2.812" in " ".join(" ".join(lines).split()) for i in range(8))


def test_compilation_moves_the_bar_and_does_not_count(clock):
    of = Progress(Console(file=io.StringIO(), force_terminal=True, width=80), clock=clock)
    of.phase("compiling", 1500.0)
    clock.now += 7
    text, bar = shown(of, 80)
    assert text.strip() == "compiling"
    assert bar.endswith("  0% 0:07 elapsed")
    of.phase("learning")
    of.reach(50)
    assert "left" not in of.time  # one report tells nothing of the pace
    clock.now += 2
    of.reach(150)
    assert of.time == "0:27 left"
    of.phase("compiling")  # for longer episodes
    clock.now += 10
    assert of.time == "0:27 left"


def test_no_colours_of_the_text_but_those_of_rich(clock):
    """Nothing white, black or grey but the bar's own: it is read on light and on dark."""
    console = Console(file=io.StringIO(), force_terminal=True, width=80, color_system="truecolor")
    console.print(learning(clock)._render().renderables[0])
    assert set(re.findall(r"\x1b\[([0-9;]*)m", console.file.getvalue())) <= {"1", "0"}


def test_time_left_of_few_pieces_counts_from_the_beginning():
    work = TimeLeft(2.0, 0.0)
    assert work.left(3.0) is None
    work.reach(1.0, 10.0)
    assert work.left(10.0) == 10.0
    assert work.left(14.0) == 6.0
    assert work.left(30.0) == 0.0


def test_time_left_of_what_was_done_before():
    work = TimeLeft(1000.0, 0.0, 900.0)
    for done, now in ((910.0, 5.0), (920.0, 6.0)):
        work.reach(done, now)
    assert work.left(6.0) == pytest.approx(8.0)


def test_a_counter_moves_the_bar_within_a_piece(clock):
    steps = [7_000]  # of a simulator, since it began
    of = Progress(Console(file=io.StringIO(), force_terminal=True, width=80), clock=clock)
    of.phase("evaluating", 4_000, counter=lambda: steps[0])
    for _ in range(10):
        clock.now += 1
        steps[0] += 100
        bar = shown(of, 80)[-1]
    assert bar.endswith("25% 0:30 left")
    of.advance(2_000)  # a scenario, which took fewer steps than thought
    assert shown(of, 80)[-1].split()[-3] == "50%"
    steps[0] += 5_000
    assert "100%" in shown(of, 80)[-1]


def test_plain_lines_come_at_each_phase_and_now_and_then(clock, monkeypatch):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.02)
    out = io.StringIO()
    with Progress(Console(file=out, width=140), clock=clock) as of:
        of.phase("recording")
        of.phase("learning", 100.0)
        for done in (20, 40):
            clock.now += 10
            of.reach(done, mae="MAE 1 crad", count=f"{done} of 100 gradient steps")
        deadline = time.monotonic() + 20
        while "left" not in out.getvalue() and time.monotonic() < deadline:
            clock.now += 0.001
            time.sleep(0.005)
    lines = out.getvalue().splitlines()
    assert lines[:2] == ["recording", "learning"]
    assert lines[2] == "learning  MAE 1 crad  40 of 100 gradient steps  40 %  0:30 left"


def test_a_dumb_terminal_and_other_processes_get_no_bar(clock):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=80, _environ={"TERM": "dumb"})
    with Progress(console, clock=clock) as of:
        of.phase("learning")
    with Progress(console, shown=False, clock=clock) as of:
        of.phase("evaluating")
        of.print("nothing")
    assert out.getvalue() == "learning\n"


def test_a_notebook_without_widgets_gets_lines(monkeypatch):
    monkeypatch.setattr(progress.importlib.util, "find_spec", lambda name: None)
    assert not Progress(Console(file=io.StringIO(), force_jupyter=True))._live
    monkeypatch.setattr(progress.importlib.util, "find_spec", lambda name: name)
    assert Progress(Console(file=io.StringIO(), force_jupyter=True))._live


def test_what_goes_to_a_file_stays_there(monkeypatch):
    errors = io.StringIO()
    monkeypatch.setattr("sys.stderr", errors)
    with Progress(Console(file=io.StringIO(), force_terminal=True, width=80)):
        print("warning: so it is", file=sys.stderr)
    assert errors.getvalue() == "warning: so it is\n"


def test_the_terminal_is_left_as_it_was():
    out = io.StringIO()
    with Progress(Console(file=out, force_terminal=True, width=80)) as of:
        of.phase("learning", 10.0)
        of.print("[a line] that :+1: stays")
    text = out.getvalue()
    assert text.count("\x1b[?25l") == text.count("\x1b[?25h") == 1  # the cursor comes back
    assert "[a line] that :+1: stays\n" in text
    assert text.endswith("\x1b[2K")  # and the bar goes


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0:00"), (59.6, "1:00"), (754, "12:34"), (3723, "1:02:03"), (360_000, "100:00:00")]
)
def test_clock(seconds, text):
    assert progress.clock(seconds) == text


class Heard:
    """A pretraining that is so far."""

    def __init__(self, done, best=-0.25):
        self.done, self.best = done, best


def begun(clock, config, plant, flop=(10.0, 1.0)):
    of = Progress(Console(file=io.StringIO(), force_terminal=True, width=80), clock=clock)
    with patch.object(learning_, "arithmetic", lambda config: flop):
        return of, learning_.Learning(of, config, plant, "lag/steps")


def test_one_bar_over_the_gradient_steps_of_all_seeds_and_phases(clock):
    config = small(
        "heaters", seeds=2, pretraining=preset("heaters", "record").pretraining
    )  # 2,000 gradient steps, 300 updates
    of, learned = begun(clock, config, lag.LAG)
    learned.pretrained(0, Heard(2_000), lambda: {"mae": 0.51234})
    assert of.line.startswith("learning  MAE seed 0 0.5123 on lag/steps  2,000 of 4,600 gradient steps  49 %")
    learned.pretrained(1, Heard(1_000), lambda: pytest.fail("looked at again so soon"))
    learned.epoch(0, {"epoch": 1, "mae": 0.4, "updates": 150, "skipped": 0.125})
    assert (
        "MAE seed 0 0.4000 on lag/steps  3,150 of 4,600 gradient steps  12.5% of the updates skipped  74 %" in of.line
    )
    learned.epoch(0, {"epoch": 2, "mae": 0.4, "updates": 300, "skipped": 0.0})
    learned.epoch(1, {"epoch": 2, "mae": 0.3, "updates": 300})
    assert of.line.startswith(
        "learning  MAE seed 0 0.4000, seed 1 0.3000 on lag/steps  4,600 of 4,600 gradient steps  100 %"
    )


def test_the_mae_is_looked_at_seldom_and_not_on_simulators(clock, monkeypatch):
    config = preset("pitch", "record")
    of, learned = begun(clock, config, lag.LAG)
    now, looks = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    def look():
        looks.append(now[0])
        now[0] += 2.0 if len(looks) == 1 else 0.2  # the first time it is compiled
        return {"mae": 2.5}

    while now[0] < 60.0:
        learned.pretrained(0, Heard(50), look)
        now[0] += 0.5
    assert len(looks) >= 6
    assert min(b - a for a, b in pairwise(looks)) >= 5.0
    assert 0.2 * (len(looks) - 1) < 0.025 * 60.0
    host = replace(lag.LAG, differentiable=False)
    of, learned = begun(clock, config, host)
    learned.pretrained(0, Heard(50), lambda: pytest.fail("minutes of a simulator"))
    assert of.line.startswith("learning  cost a step on the model 0.250  50 of 1,500 gradient steps")


@pytest.mark.parametrize(("plant", "there"), [("pitch", True), ("lag", False)])
def test_the_papers_column_is_for_its_plants_alone(plant, there, monkeypatch, capsys):
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    figures = dict.fromkeys(scenarios.reported(plant), FiguresOfMerit(mae=1.0))
    results = [evaluation.Evaluation(policy=name, scenarios=figures) for name in ("learned", "none", "static")]
    train.show(SimpleNamespace(results=results, episodes=figures, places={}), preset(plant))
    assert ("paper's DRL" in capsys.readouterr().out) == there


def comparison(*rows):
    infos = {row.policy: PolicyInfo("baseline") for row in rows}
    return Comparison(
        plant="lag", y_unit="1", time_unit="s", family_seed=0, date="", machine={}, policies=infos, rows=list(rows),
        statistics=Summary([], {}, {}), sweeps={}, stability=[], seconds=0.0, command="", folder="",
    )  # fmt: skip


def row(policy, mae, **other):
    known = {"ratio_to_limit": None, "ratio_to_bound": None, "within_limits": True, "worse_than_static": None}
    return Row(policy=policy, run=None, seed=None, scenario="lag/steps", mae=mae, **known | other)


def test_comparison_explains_only_what_is_there(capsys):
    legends = {"In brackets": "ratio_to_limit", "*: best": "best", "!: outside": "within_limits"}
    for changed in ({}, {"ratio_to_limit": 1.5}, {"best": True}, {"within_limits": False}):
        compare.show(comparison(row("none", 2.0), row("static", 1.0, **changed)))
        out = capsys.readouterr().out
        assert [name for name in legends if name in out] == [n for n, key in legends.items() if key in changed]


def test_bold_is_explained_where_it_can_be_seen(monkeypatch, capsys):
    out = io.StringIO()
    for module in (cli, compare):
        monkeypatch.setattr(module, "console", Console(file=out, force_terminal=True, width=80))
    compare.show(comparison(row("none", 2.0, best=True)))
    assert capsys.readouterr().out == "Bold: best without the model.\n"
    assert "2*" not in STYLE.sub("", out.getvalue())


def test_evaluate_takes_a_policy_of_your_own(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    (tmp_path / "own.py").write_text(
        "class Twice:\n    host = True\n    def __init__(self, plant): pass\n"
        "    def init(self, params, r, y): return 0\n    def act(self, params, memory, r, y): return memory, 2.0 * r\n"
        "class Broken(Twice):\n    def act(self, params, memory, r, y): raise RuntimeError('out of ideas')\n"
    )
    asked = ["--scenario", "lag/steps", "--episodes", "2", "--policy"]
    evaluate.main([*asked, f"{tmp_path}/own.py:Twice"])
    out = capsys.readouterr().out
    assert "policy own.py:Twice" in out
    assert "evaluating" in out
    with pytest.raises(SystemExit) as end:
        evaluate.main([*asked, f"{tmp_path}/own.py:Broken"])
    assert end.value.code == 2
    assert "own.py:Broken failed on lag/steps: RuntimeError: out of ideas" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        evaluate.main(["--policy", f"{ROOT}/scripts/examples/lead.py:Lag", "--scenario", "lag/steps"])
    assert "has no 'Lag'" in capsys.readouterr().err


def test_a_policy_that_the_plant_does_not_allow_is_refused(monkeypatch, capsys):
    plant, params = lag.make()
    host = replace(plant, differentiable=False)
    monkeypatch.setitem(REGISTRY, "lag", lambda: (host, params))
    with pytest.raises(SystemExit) as end:
        evaluate.main(["--policy", "oracle", "--scenario", "lag/steps"])
    assert end.value.code == 2
    assert "there is no oracle for lag, which is not declared differentiable" in capsys.readouterr().err


def test_evaluate_says_what_it_identifies_first(monkeypatch, clock):
    out = io.StringIO()
    of = Progress(Console(file=out, width=140), clock=clock)

    def slow(name, known, report):
        report("", 0.0)
        for share in (0.1, 0.2, 0.3):
            clock.now += 5
            report(f"{share:.0%} of it", share)
        said.append(of.line)
        return evaluation.NamedPolicy(name, None, (), known.plant)

    said = []
    monkeypatch.setattr(evaluation, "baseline", slow)
    evaluation.named("oracle", Known("pitch", 0.2), of)
    identifying, told, tuning = out.getvalue().splitlines()
    assert (identifying, tuning) == ("identifying oracle", "tuning oracle")
    assert told.startswith(
        "oracle on pitch with sensor noise of 0.2: A correction of lq-exact by the learner's network, trained by"
    )
    assert said == ["tuning oracle  30% of it  30 %  0:35 left"]


@pytest.mark.parametrize("width", [20, 40, 80, 99, 200])
def test_tables_are_not_cut(width, monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(cli, "console", Console(file=out, force_terminal=True, width=width))
    names = ["scenario", "inner loop alone", "static prefilter", "paper's DRL", "ours", "improvement, %"]
    cells = ["pitch/delay-swapped", "10.91", "3.409", "3.90 of 10.91", "2.750 (2.736-2.764)", "74.8"]
    cli.table("MAE in crad", names, [cells])
    lines = STYLE.sub("", out.getvalue()).splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in out.getvalue()
    if width >= 40:  # below, words are folded
        assert all(word in " ".join(lines) for cell in (*names, *cells) for word in cell.split())
    if width >= 80:
        assert sum("pitch/delay-swapped" in line for line in lines) == 1  # in one part


def test_recording_from_a_simulator_has_a_bar_of_its_own(clock, monkeypatch):
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    simulators = SimpleNamespace(speed=SimpleNamespace(steps=1_000))
    monkeypatch.setattr(host, "of", lambda plant: simulators, raising=False)
    config = replace(
        small("lag", pretraining=preset("pitch", "record").pretraining), base="static", explored_steps=400
    )  # 64 + 8 episodes of 50 steps, besides those explored before
    of, learned = begun(clock, config, lag.LAG)
    learned.begins("recording", 0, 0)
    for _ in range(2):
        clock.now += 9
        simulators.speed.steps += 900
        of._count()
    assert of.line == "recording  50 %  0:18 left"
    learned.begins("compiling", 0, 0)
    assert of.line == "compiling"
    learned.pretrained(0, Heard(750), lambda: {"mae": 2.5})
    assert of.line.startswith("learning  MAE 2.500 on lag/steps  750 of 1,800 gradient steps  49 %")


def test_the_bar_of_the_default_preset_is_that_of_its_rounds_of_pairs(clock):
    config = preset("pitch")
    of, learned = begun(clock, config, lag.LAG)
    learned.epoch(0, {"epoch": 15, "mae": 2.6, "updates": config.total_updates // 2})
    assert of.line.startswith("learning  MAE 2.600 on lag/steps  9,000 of 18,000 gradient steps  50 %")


def test_a_simulator_is_checked_and_identified_under_bars_that_end_full(monkeypatch, clock):
    plant, params = host.plant(Simulated, name="mine", **DECLARED)
    monkeypatch.setitem(REGISTRY, "mine", lambda: (plant, params))
    bars, of_plant = [], host.of(plant)

    def phase(self, what, total=None, done=0.0, counter=None):
        bars.append((what, total, None if counter is None else counter()))

    monkeypatch.setattr(Progress, "phase", phase)
    check.main(["mine"])
    learning_.chosen(preset("mine"), Progress(Console(file=io.StringIO()), clock=clock))
    whats, totals, counts = zip(*bars, ("end", 0, of_plant.speed.steps), strict=True)
    assert whats == ("checking", "responding", "identifying", "end")
    assert [after - before for before, after in pairwise(counts)] == list(totals[:-1])


class Simulated:
    """A lag outside JAX."""

    def reset(self, seed):
        self.y = 0.0
        return self.y

    def step(self, r_tilde):
        self.y += 0.5 * (r_tilde - self.y)
        return self.y


DECLARED = dict(y_unit="1", time_unit="s", control_step=0.1, episode_steps=40, family_steps=40)
DECLARED |= dict(r_tilde_bounds=(-2.0, 2.0), setpoint_range=(-0.5, 0.5))


@pytest.mark.parametrize("command", [train, evaluate, compare, check, export])
def test_a_plant_that_is_made_slowly_is_announced_first(command, monkeypatch, tmp_path):
    events = []

    def make(*_):
        events.append("made")
        raise ValueError("too short")

    (tmp_path / "plant.csv").touch()
    monkeypatch.setitem(registry.KINDS, "log", make)
    monkeypatch.setattr(Progress, "__enter__", lambda self: events.append(self.line))
    reference, run = f"log:{tmp_path}/plant.csv", str(next(iter((ROOT / "tests" / "runs").glob("pitch-*"))))
    named = {evaluate: [run, "--plant", reference], export: [run, "--format", "npz", "--plant", reference]}
    with pytest.raises(SystemExit):
        command.main(named.get(command, [reference]))
    assert events == [FIRST_PHASE, "made"]


def test_ctrl_c_after_the_learning_says_how_to_go_on(monkeypatch, tmp_path, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    monkeypatch.setattr(learning_, "_trained", lambda *_: {})
    monkeypatch.setattr(learning_, "report", interrupted)
    with pytest.raises(SystemExit) as end:
        train.main(["lag", "--out", str(tmp_path / "run")])
    assert end.value.code == 130
    assert capsys.readouterr().err == f"saved; resume with: python -m jaxouter.train --resume {tmp_path}/run\n"
