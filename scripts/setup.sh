# Sourced by the other scripts: makes the virtual environment .venv in the clone, once, from the lock file.
# Sets PYTHON to its interpreter. Uses the python3 on the path, or the one that the variable PYTHON names.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=${VENV:-$root/.venv}

fail() { printf 'error: %s\n' "$*" >&2; exit 2; }

find_python() {
    local candidate
    for candidate in "${PYTHON:-python3}" python3.14 python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    fail "Python 3.11 to 3.14 is needed and was not found; install one, or name it: PYTHON=/path/to/python3 bash $0"
}

wanted=$(cat "$root/requirements.lock" "$root/pyproject.toml" | cksum)
if [ "$(cat "$venv/.installed" 2>/dev/null || true)" != "$wanted" ]; then
    python=$(find_python)
    echo "setting up $venv (once; about a minute)" >&2
    rm -rf "$venv"
    "$python" -m venv "$venv" >&2 || {
        rm -rf "$venv"
        fail "$python can't make a virtual environment; on Debian and Ubuntu: apt-get install python3-venv"
    }
    pip=("$venv/bin/python" -m pip --disable-pip-version-check install --quiet)
    "${pip[@]}" --require-hashes --requirement "$root/requirements.lock" >&2
    "${pip[@]}" --no-deps --no-build-isolation --editable "$root" >&2
    printf '%s\n' "$wanted" >"$venv/.installed"
fi
PYTHON=$venv/bin/python
