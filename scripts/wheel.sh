#!/usr/bin/env bash
# Build sdist and wheel, install the wheel in a fresh virtual environment with what requirements.lock pins, and run the
# library's example there, in an empty folder. The last line says what came out.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# --no-isolation: by the hatchling of the lock. The wheel is built from the sdist.
"$PYTHON" -m build --no-isolation --outdir "$folder/dist" . >&2
wheel=$(echo "$folder"/dist/*.whl)
sed -e '/^ *--hash=/d' -e 's/ *\\$//' requirements.lock >"$folder/constraints"  # pip takes no hashes in constraints
"$PYTHON" -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip --disable-pip-version-check install --quiet --constraint "$folder/constraints" \
    "$wheel" >&2

git ls-files jaxouter >"$folder/files"
cat >"$folder/example.py" <<'PYTHON'
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import jaxouter

wheel, files = sys.argv[1], Path(sys.argv[2]).read_text().split()
held = set(zipfile.ZipFile(wheel).namelist())
missing = {*files, f"jaxouter-{version('jaxouter')}.dist-info/licenses/LICENSE"} - held
assert not missing, f"the wheel lacks {missing}"
assert Path(jaxouter.__file__).is_relative_to(sys.prefix), jaxouter.__file__

run = jaxouter.learn("pitch", seed=0, pretraining={"gradient_steps": 300})
run.plot(path="paper.png")
told = run.export("controller.c")
policy = jaxouter.load(run.path).policy
_, r_tilde = policy.act(policy.init(10.0, 0.0), 10.0, 0.0)
low, high = policy.spec.r_tilde_bounds
assert low <= r_tilde <= high, r_tilde
assert all(Path(name).exists() for name in ("paper.png", "controller.c", "controller.h"))
size = Path(wheel).stat().st_size // 1000
print(f"{Path(wheel).name}, {len(held)} files, {size} kB; MAE {run.metrics[-1]['mae']:.3g} crad; {told}")
PYTHON
mkdir "$folder/empty"
cd "$folder/empty"
unset PYTHONPATH
export XDG_CACHE_HOME=$folder/cache
told=$("$folder/venv/bin/jaxouter" --version)
[[ $wheel == *-"$told"-* ]] || fail "jaxouter --version is $told, and the wheel is $wheel"
"$folder/venv/bin/jaxouter" train --list >/dev/null
"$folder/venv/bin/python" "$folder/example.py" "$wheel" "$folder/files"
