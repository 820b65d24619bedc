#!/usr/bin/env bash
# Print the Python interpreter of the benchmark's peers: PYTHON=$(bash scripts/peers.sh)
# Makes their virtual environment benchmarks/peers/.venv, once, from their lock file, with the python3 on the path or the
# one that the variable PYTHON names. On Linux it takes 5 GB: PyTorch on PyPI needs CUDA's libraries even on a CPU.
# The argument rejax names the environment of rejax and gymnax instead, in benchmarks/peers/rejax; it takes 1 GB.
set -euo pipefail
peers=$(cd "$(dirname "${BASH_SOURCE[0]}")/../benchmarks/peers/${1:-}" && pwd)
venv=$peers/.venv
python=${PYTHON:-python3}

fail() { printf 'error: %s\n' "$*" >&2; exit 2; }

wanted=$(cksum <"$peers/requirements.lock")
if [ "$(cat "$venv/.installed" 2>/dev/null || true)" != "$wanted" ]; then
    "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null ||
        fail "$python is not Python 3.11, 3.12 or 3.13; name one: PYTHON=/path/to/python3 bash $0"
    echo "setting up $venv (once; some minutes, and on Linux $([ $# -eq 0 ] && echo 5 || echo 1) GB)" >&2
    rm -rf "$venv"
    "$python" -m venv "$venv" >&2 || {
        rm -rf "$venv"
        fail "$python can't make a virtual environment; on Debian and Ubuntu: apt-get install python3-venv"
    }
    # --no-deps: the lock of the peers leaves out what PyTorch declares and can do without.
    "$venv/bin/python" -m pip --disable-pip-version-check install --quiet --no-deps --require-hashes \
        --requirement "$peers/requirements.lock" >&2
    printf '%s\n' "$wanted" >"$venv/.installed"
fi
printf '%s\n' "$venv/bin/python"
