"""The commands as users call them."""

import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tensorboardX.proto import event_pb2
from wandb.proto import wandb_internal_pb2

from jaxouter import evaluate, train
from jaxouter.api import learning
from jaxouter.plants import REGISTRY
from jaxouter.training.config import to_dict
from jaxouter.training.run import RunFolder
from tests import interrupts, lag
from tests.precision import of_single_draws
from tests.training.small import small

SMALL = ["--steps", "1600", "--agent.prefill", "640", "--epoch", "480", "--environments", "8", "--agent.replay", "1600"]
SMALL += ["--history", "3", "--agent.hidden", "16", "16", "--agent.batch-size", "32", "--agent.updates", "1"]
SMALL += ["--base", "absolute", "--pairs.rounds", "0", "--compared", "16"]
TWO = ["--randomise", "gain", "0.8", "1.2", "--seed", "3", "--seeds", "2"]
ADDITIONS = Path(__file__).parent / "additions"
PLACES = {"pitch/paper": "inside"} | {f"pitch/delay-{name}": "outside" for name in ("5.7", "0.57", "swapped")}


def command(module: str, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", f"jaxouter.{module}", *arguments], cwd=cwd, capture_output=True, text=True, timeout=250
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Output and folder of a small run of two seeds on pitch, through the real entry point."""
    folder = tmp_path_factory.mktemp("train")
    done = command("train", "pitch", *SMALL, *TWO, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done, folder / "runs" / "pitch-scratch-3"


def test_train_writes_the_run_folder(trained):
    _, folder = trained
    config = json.loads((folder / "config.json").read_text())["config"]
    assert (config["plant"], config["steps"], config["seeds"]) == ("pitch", 1600, 2)
    assert config["integral_steps"] == 20.0  # of the preset
    for seed in (3, 4):
        rows = [json.loads(line) for line in (folder / f"seed-{seed}" / "metrics.jsonl").read_text().splitlines()]
        compared = 2 * 16 * 200
        assert [row["steps"] for row in rows] == [1120 + compared, 1600 + 2 * compared, 1600 + 3 * compared]
        assert {"mae", "reward", "critic_loss", "saturation", "actor_gradient", "q_start"} <= set(rows[0])
    names = {path.name for path in (folder / "figures").iterdir()}
    drawn = ["paper", "learning-curve", *(name.replace("/", "-") for name in PLACES)]
    assert names == {f"{name}.{kind}" for name in drawn for kind in ("png", "svg")} | {"episode.webp"}
    summary = json.loads((folder / "summary.json").read_text())
    assert [(r["policy"], r.get("seed")) for r in summary["results"]] == [
        ("learned", 3), ("learned", 4), ("none", None), ("static", None)
    ]  # fmt: skip
    assert summary["places"] == PLACES


@of_single_draws
def test_train_ends_with_the_table_and_the_main_figure(trained):
    done, folder = trained
    for text in (
        *PLACES,
        "inner loop alone",
        "static prefilter",
        "3.90 of 10.91",
        "10.91",
        "gain is drawn from 0.8 to 1.2",
        "inside",
    ):
        assert text in done.stdout
    assert done.stdout.rstrip().endswith(str(Path("runs") / folder.name / "figures" / "paper.png"))
    begun = [line.split("  ")[0] for line in done.stdout.splitlines()]  # plain lines where there is no terminal
    phases = ["compiling", "learning", "evaluating", "drawing"]
    assert sorted(phases, key=begun.index) == phases
    (learned,) = (line for line in done.stdout.splitlines() if line.startswith("learned in "))
    assert re.search(r"  MAE seed 3 \S+, seed 4 \S+ \w+ on \S+/\S+  240 gradient steps$", learned)


def test_evaluate_takes_a_run_and_one_seed_of_it(trained, tmp_path):
    _, folder = trained
    maes = {}
    for name, path in (("run", folder), ("seed-3", folder / "seed-3"), ("seed-4", folder / "seed-4")):
        out = tmp_path / f"{name}.json"
        evaluate.main([str(path), "--scenario", "pitch/paper", "--json", str(out)])
        content = json.loads(out.read_text())
        assert content["policy"] == "learned"
        maes[name] = content["scenarios"]["pitch/paper"]["mae"]
    summary = json.loads((folder / "summary.json").read_text())
    expected = [result["scenarios"]["pitch/paper"]["mae"] for result in summary["results"][:2]]
    assert [maes["seed-3"], maes["seed-4"]] == pytest.approx(expected, rel=1e-4)
    assert maes["run"] == pytest.approx(min(expected), rel=1e-4)


def test_evaluate_says_where_plants_lie_among_those_of_the_training(trained, capsys):
    scenarios = ["pitch/paper", "pitch/delay-0.57"]
    evaluate.main([str(trained[1]), "--scenario", *scenarios, "--episodes", "1"])
    lines = {line.split()[1]: line for line in capsys.readouterr().out.splitlines() if "pitch/" in line}
    assert ["inside" in lines[name] for name in scenarios] == [True, False]
    assert "outside" in lines["pitch/delay-0.57"]


def test_evaluate_through_its_entry_point_writes_figures_and_traces(tmp_path):
    options = ["--policy", "static", "--scenario", "pitch/paper", "pitch/staircase", "--episodes", "2"]
    done = command("evaluate", *options, "--json", "out.json", "--traces", "out.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["policy"] == "static"
    assert content["scenarios"]["pitch/paper"]["mae"] == pytest.approx(3.404, abs=0.01)
    with np.load(tmp_path / "out.npz") as arrays:
        assert arrays["pitch/staircase/r_tilde"].shape == (2, 600)
        assert len(arrays.files) == 6


def test_a_dry_run_shows_shapes_memory_and_arithmetic_and_does_nothing(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    train.main(["pitch", "--preset", "paper", "--dry-run"])
    out = capsys.readouterr().out
    for text in ('"batch_size": 64', "33 - 400 - 300 - 1, 134,201 parameters", "157 MFLOP each", "memory in all"):
        assert text in out
    assert list(tmp_path.iterdir()) == []


def test_list_names_plants_presets_scenarios_and_policies(capsys):
    train.main(["--list"])
    out = capsys.readouterr().out
    for text in ("pitch", "heaters", "paper", "default", "pitch/doublets", "static"):
        assert text in out


@pytest.mark.parametrize(("plant", "default"), [("pitch", "0.99"), ("heaters", "0.95")])
def test_help_shows_the_defaults_of_the_preset(capsys, plant, default):
    with pytest.raises(SystemExit) as end:
        train.main([plant, "--help"])
    assert end.value.code == 0
    assert default in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["submarine"], "no plant 'submarine'; the plants are: pitch, heaters"),
        (["--preset", "fast"], "no preset 'fast' for pitch; the presets are: default, scratch, record,"),
        (["--steps", "-5"], "steps is -5; it must be positive, or 0 with pretraining"),
        (["--seeds", "0"], "seeds is 0; it must be positive"),
        (["--agent.replay", "100"], "replay is 100; it must hold at least a batch of 256"),
        (["--no-such-option", "1"], "--no-such-option"),
        (["--steps", "many"], "--steps"),
        (["--out", "."], "exists; choose another --out"),
        (["--resume", "."], "is not a run folder"),
        (["--resume", ".", "--steps", "5"], "--resume takes no other option"),
        (["--history", "0"], "history is 0"),
    ],
)
def test_bad_input_to_train_is_one_message_and_status_2(arguments, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        train.main(arguments)
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert text in " ".join((captured.out + captured.err).split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "say what to evaluate"),
        (["."], "is not a run folder"),
        (["--policy", "best"], "no policy 'best'; it may be FILE.py:CLASS or one of: none, static"),
        (
            ["--policy", "nowhere.py:Lead"],
            "nowhere.py is not a Python file; a policy of your own is named FILE.py:NAME",
        ),
        (["--policy", "clairvoyant"], "clairvoyant is a bound, not a policy; python -m jaxouter.compare shows it"),
        (["--policy", "none", "--scenario", "pitch/papers"], "no scenario 'pitch/papers'"),
        (["--policy", "none", "--scenario", "boat/paper"], "no plant 'boat'"),
        (["--policy", "none", "--episodes", "0"], "--episodes is 0; it must be at least 1"),
        (["--policy", "none", "--family-seed", "-1"], "--family-seed is -1"),
        (["--policy", "none", "--json", "nowhere/out.json"], "can't be written"),
    ],
)
def test_bad_input_to_evaluate_is_one_message_and_status_2(arguments, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        evaluate.main(arguments)
    assert end.value.code == 2
    assert text in capsys.readouterr().err


def test_bad_input_leaves_no_traceback(tmp_path):
    done = command("train", "submarine", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: there is no plant 'submarine'")
    assert "Traceback" not in done.stderr


def test_run_without_or_with_a_damaged_checkpoint_is_refused(tmp_path, capsys):
    run = RunFolder.create(small(), tmp_path / "run")
    path = run.seed_folder(0) / "checkpoint-000001.npz"
    for content, text in ((None, "has no checkpoint yet"), (b"junk", "is not a readable checkpoint")):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(SystemExit) as end:
            evaluate.main([str(run.path)])
        assert end.value.code == 2
        assert text in capsys.readouterr().err


def test_run_of_one_plant_is_not_evaluated_on_another(trained, capsys):
    with pytest.raises(SystemExit):
        evaluate.main([str(trained[1]), "--scenario", "heaters/cold"])
    assert "the plant is pitch; heaters/cold is another plant's" in capsys.readouterr().err


def test_ctrl_c_saves_says_how_to_go_on_and_ends_with_130(tmp_path):
    learner = ["--agent", f"{ADDITIONS}/reinforce.py:Reinforce", "--history", "2", "--environments", "16"]
    long = ["--preset", "paper", *learner, "--epoch", "6400", "--steps", "64000000", "--out", "run"]
    with interrupts.heard():
        process = subprocess.Popen(
            [sys.executable, "-m", "jaxouter.train", f"{ADDITIONS}/room.py:Room", *long],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    metrics = tmp_path / "run" / "seed-0" / "metrics.jsonl"
    deadline = time.monotonic() + 200
    while not (metrics.exists() and metrics.read_text()) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=100)
    assert process.returncode == 130, errors
    assert "python -m jaxouter.train --resume run" in errors
    rows = [json.loads(line) for line in metrics.read_text().splitlines()]
    assert 0 < rows[-1]["steps"] < 64_000_000
    assert max(metrics.parent.glob("checkpoint-*.npz")).stem == f"checkpoint-{len(rows):06d}"


def logged(path: Path) -> tuple[str, list[dict[str, float]]]:
    """Name and rows of a run of Weights & Biases: records in parts, headers of seven bytes, blocks of 32 KiB."""
    content, at, data, name, rows = path.read_bytes(), 7, b"", "", []
    while at < len(content):
        if at % 32_768 > 32_768 - 7:
            at += -at % 32_768
        size, kind = struct.unpack_from("<HB", content, at + 4)
        data, at = data + content[at + 7 : at + 7 + size], at + 7 + size
        if kind not in (1, 4):  # whole, or the last part
            continue
        record, data = wandb_internal_pb2.Record.FromString(data), b""
        name = record.run.display_name or name
        items = {(item.key or item.nested_key[0]): json.loads(item.value_json) for item in record.history.item}
        rows += [{key: value for key, value in items.items() if not key.startswith("_")}] if items else []
    return name, rows


@pytest.mark.slow
def test_metrics_go_to_tensorboard_and_wandb_too(trained):
    """Also those of rows that were there before; of each value the row's, once."""
    _, folder = trained
    shutil.copytree(folder, folder.parent / "events")
    run = RunFolder.open(folder.parent / "events")
    for seed in run.seeds:
        run.forget(seed, 0)  # all epochs run again
    train.main(["--resume", str(run.path), "--tensorboard", "--wandb"])
    runs = {name: rows for path in run.path.glob("wandb/offline-run-*/*.wandb") for name, rows in [logged(path)]}
    assert runs == {f"events, seed {seed}": run.rows(seed) for seed in run.seeds}
    for seed in run.seeds:
        (path,) = run.seed_folder(seed).glob("events.out.tfevents.*")
        content, found = path.read_bytes(), []
        while content:  # records of a length (8 bytes), its checksum (4), the event and its checksum (4)
            size = int.from_bytes(content[:8], "little")
            event = event_pb2.Event.FromString(content[12 : 12 + size])
            found += [(value.tag, event.step, value.simple_value) for value in event.summary.value]
            content = content[16 + size :]
        expected = [(name, row["steps"], np.float32(value)) for row in run.rows(seed) for name, value in row.items()]
        assert len(run.rows(seed)) == run.config.epochs
        assert sorted(found) == sorted(expected)


def test_resume_of_a_finished_run_only_shows_it_again_also_where_nothing_can_be_drawn(trained, capsys, monkeypatch):
    def draw(*_: object) -> None:
        raise RuntimeError("no fonts")

    monkeypatch.setattr(learning, "draw", draw)
    _, folder = trained
    (folder / "figures" / learning.MAIN_FIGURE).unlink()
    before = (folder / "seed-3" / "metrics.jsonl").read_text()
    summary = (folder / "summary.json").read_text()
    (folder / "summary.json").unlink()
    train.main(["--resume", str(folder)])
    shown = capsys.readouterr()
    assert "pitch/delay-swapped" in shown.out
    assert shown.out.endswith(f"s in all; run folder {folder}\n")
    assert "warning: no figures: RuntimeError: no fonts\n" in shown.err
    assert (folder / "seed-3" / "metrics.jsonl").read_text() == before
    assert json.loads((folder / "summary.json").read_text()) == json.loads(summary)


@pytest.mark.slow
def test_third_plant_goes_through_the_whole_of_training(tmp_path, monkeypatch, capsys):
    """Registered by one line, the lag with a delay is learned, and beats the inner loop and the static prefilter."""
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    out = tmp_path / "run"
    train.main(["lag", "--preset", "record", "--pretraining.gradient-steps", "200", "--out", str(out)])
    assert to_dict(RunFolder.open(out).config)["plant"] == "lag"
    results = json.loads((out / "summary.json").read_text())["results"]
    maes = {result["policy"]: result["scenarios"]["lag/steps"]["mae"] for result in results}
    assert maes["learned"] < maes["static"] < maes["none"]
    assert "lag/ramps" in capsys.readouterr().out
    assert (out / "figures" / "paper.png").stat().st_size > 10_000
