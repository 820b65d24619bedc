"""Golden results: short trainings, exports and a comparison, as before the last restructuring of the code.

    python scripts/golden.py            # compares with tests/golden.json; status 1 if anything differs
    python scripts/golden.py --write    # writes that file again
    python scripts/golden.py --only heaters-td3    # only this training and what depends on it; the others stay

The file holds a hash and a few elements of every array. On the same kind of machine and version of jaxlib the hashes
must agree (equality to the last bit); elsewhere the elements must agree to a small tolerance.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import platform
import re
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

# isort: off
from jaxouter import compare, export, train  # before JAX, as it configures JAX's messages

# isort: on
import jax
import numpy as np
import tyro

from jaxouter.training.config import preset
from jaxouter.training.run import RunFolder
from jaxouter.training.trainer import build

FILE = Path(__file__).resolve().parent.parent / "tests" / "golden.json"
ELEMENTS = 16  # of each array, evenly spaced
AMPLIFIED = re.compile("^/(compare|export)/|-(default|record)/(learner|summary)/|/worst$")
"""What the rounding of another machine moves without bound, through the gradient steps of a pretraining, and `worst`,
which is in standard errors: there only the MAE is compared."""
TOLERANCE = 0.05  # relative to the largest of them, on other machines: 50 steps of Adam amplify rounding
PAPER = ["--preset", "paper", "--steps", "205", "--epoch", "5"]  # five updates
RECORD = ["--preset", "record", "--pretraining.gradient-steps", "50", "--compared", "0"]
DEFAULT = ["--pretraining.gradient-steps", "5", "--pairs.rounds", "2", "--pairs.states", "512", "--pairs.updates", "25"]
DEFAULT += ["--pairs.environments", "8", "--compared", "64"]
TD3 = ["--preset", "record", "--pretraining.gradient-steps", "0", "--compared", "0", "--steps", "1040"]
TD3 += ["--epoch", "400", "--agent.prefill", "640", "--environments", "8", "--redraws", "10", "10"]
TD3 += ["--disturbances.noise", "0", "--disturbances.load", "0", "--agent.no-hold", "--agent.n-step", "3"]
TD3 += ["--agent.critic", "mlp", "--agent.layer-norm", "--agent.critics", "2", "--agent.policy-delay", "2"]
TD3 += ["--agent.noise-end", "0.5", "--agent.target-noise", "0.2", "--agent.hidden", "32", "32"]


def main(write: bool = False, only: tuple[str, ...] = ()) -> None:
    """Compare the results with those in the file, or write them to it."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        found = {"machine": machine(), "results": dict(sorted(results(Path(folder), only).items()))}
    if write:
        if only:
            others = json.loads(FILE.read_text())
            if others["machine"] != found["machine"]:
                raise SystemExit(
                    "the other results are of another machine or jaxlib; write all of them, without --only"
                )
            found["results"] = dict(sorted((others["results"] | found["results"]).items()))
        FILE.write_text(json.dumps(found, indent=0) + "\n")
        print(f"{len(found['results'])} results written to {FILE}")
        return
    wanted = json.loads(FILE.read_text())
    if only:
        wanted["results"] = {name: value for name, value in wanted["results"].items() if name in found["results"]}
    exact = wanted["machine"] == found["machine"]
    wrong = differences(wanted["results"], json.loads(json.dumps(found["results"])), exact)
    print("\n".join(wrong) or f"{len(wanted['results'])} results agree, {'to the last bit' if exact else 'about'}")
    if wrong:
        raise SystemExit(1)


def machine() -> dict[str, str]:
    """What the last bits depend on."""
    flags = ""
    with contextlib.suppress(OSError):
        flags = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags"))
    features = hashlib.sha256(" ".join(sorted(flags.split())).encode()).hexdigest()[:16]
    return {"processor": platform.machine(), "features": features, "jaxlib": version("jaxlib")}


def results(folder: Path, only: tuple[str, ...]) -> dict[str, Any]:
    """Results by name; `only` selects some trainings."""
    found: dict[str, Any] = {}
    for plant in ("pitch", "heaters"):
        for name, options in (("paper", PAPER), ("record", RECORD), ("default", DEFAULT), ("td3", TD3)):
            path = folder / f"{plant}-{name}"
            if only and path.name not in only:
                continue
            train.main([plant, *options, "--out", str(path)])
            found |= {f"{path.name}/{key}": value for key, value in trained(path).items()}
    run = folder / "pitch-record"
    if not run.exists():
        return found
    for kind in ("npz", "c"):
        export.main([str(run), "--format", kind, "--force"])
    with np.load(run / "controller.npz") as file:
        found |= {f"export/npz/{name}": array(file[name]) for name in file.files if name != "header"}
    for suffix in ("c", "h"):
        found[f"export/{suffix}"] = hashlib.sha256((run / f"controller.{suffix}").read_bytes()).hexdigest()
    out = folder / "compare"
    scenarios = ["pitch/paper", "pitch/delay-0.57", "pitch/noise", "pitch/load", "pitch/steps"]
    policies = ["--run", str(run), "--policy", "static"]
    compare.main(["pitch", *policies, "--scenario", *scenarios, "--sweep", "pitch/gain", "--out", str(out)])
    found["compare"] = numbers(json.loads((out / "comparison.json").read_text()), ("rows", "sweeps", "stability"))
    return found


def trained(path: Path) -> dict[str, Any]:
    """Initial weights, final state and metrics of a run."""
    run = RunFolder.open(path)
    state, _ = run.load(0)
    trainer, params = build(preset(run.config.plant, run.config.preset))
    fresh = trainer.fresh(jax.random.key(0), params).agent
    summary = json.loads((path / "summary.json").read_text())
    trees = {
        "initial": (fresh.actor, fresh.critics),
        "learner": (state.agent.actor, state.agent.critics, state.agent.target_actor),
        "replay": state.data.rows,
        "loop": (state.env.r, state.env.y, state.obs, state.noise.x, jax.random.key_data(state.key)),
        "base": tuple(state.base),
    }
    rows = [{name: value for name, value in row.items() if "second" not in name} for row in run.rows(0)]
    arrays = {f"{name}/{i}": array(x) for name, tree in trees.items() for i, x in enumerate(jax.tree.leaves(tree))}
    return arrays | {"rows": rows, "summary": numbers(summary, ("results", "verdict"))}


def array(x: Any) -> dict[str, Any]:
    """Hash and some elements of an array."""
    x = np.ascontiguousarray(x)
    flat = x.ravel()[:: max(1, x.size // ELEMENTS)][:ELEMENTS]
    digest = hashlib.sha256(f"{x.shape} {x.dtype}".encode() + x.tobytes()).hexdigest()
    return {"sha256": digest, "elements": [float(value) for value in flat]}


def numbers(content: Any, keys: tuple[str, ...]) -> Any:
    """These keys of a JSON file, without paths and times."""

    def of(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                key: of(part) for key, part in value.items() if key not in ("run", "seconds", "text", "trained_return")
            }
        return [of(part) for part in value] if isinstance(value, list) else value

    return of({key: content[key] for key in keys if key in content})


def differences(wanted: Any, found: Any, exact: bool, name: str = "") -> list[str]:
    """Differences, by name."""
    amplified = not exact and AMPLIFIED.search(name) is not None
    if isinstance(wanted, dict) and isinstance(found, dict):
        if "elements" in wanted and not exact:
            pair = np.array([wanted["elements"], found["elements"]])
            close = np.abs(pair[0] - pair[1]).max(initial=0.0) <= TOLERANCE * np.abs(pair).max(initial=0.0)
            return [] if close or amplified else [f"{name}: {found['elements']}, not {wanted['elements']}"]
        once = [f"{name}/{key} is {'missing' if key in wanted else 'new'}" for key in sorted(set(wanted) ^ set(found))]
        both = [key for key in wanted if key in found]
        return once + [text for key in both for text in differences(wanted[key], found[key], exact, f"{name}/{key}")]
    if isinstance(wanted, list) and isinstance(found, list) and len(wanted) == len(found):
        pairs = enumerate(zip(wanted, found, strict=True))
        return [text for i, pair in pairs for text in differences(*pair, exact, f"{name}/{i}")]
    if amplified and not name.endswith("/mae"):
        return []
    numeric = isinstance(wanted, float) and isinstance(found, float)
    if wanted == found or (not exact and numeric and abs(wanted - found) <= TOLERANCE * max(abs(wanted), 1.0)):
        return []
    return [f"{name}: {str(found)[:200]}, not {str(wanted)[:200]}"]


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
