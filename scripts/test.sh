#!/usr/bin/env bash
# Lint, types and tests, those of plants and loop in double precision too; under 12 minutes on 2 cores. With --all, under
# 80 minutes, also the slow tests, all others in double precision with checks for NaN, places broken on purpose, and 20
# kills. Other arguments go to pytest, and nothing else is tested then.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
tests() { "$PYTHON" -m pytest --numprocesses 2 --dist loadfile "$@"; }
in_double() { JAX_ENABLE_X64=1 tests "$@"; }

"$PYTHON" -m ruff format --check .
"$PYTHON" -m ruff check .
"$PYTHON" -m basedpyright --pythonpath "$PYTHON"
if [ $# -eq 0 ]; then
    tests
    in_double tests/plants tests/loop
elif [ "$*" = --all ]; then
    tests --all
    in_double --all tests/plants tests/loop
    JAX_DEBUG_NANS=1 in_double --ignore=tests/plants --ignore=tests/loop tests
    "$PYTHON" scripts/mutants.py
    "$PYTHON" scripts/soak.py
else
    tests "$@"
fi
