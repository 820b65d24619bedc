#!/usr/bin/env bash
# Lint, types and tests, under 12 minutes on 2 cores; --all adds the slow tests. Other arguments go to pytest.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
"$PYTHON" -m ruff format --check .
"$PYTHON" -m ruff check .
"$PYTHON" -m basedpyright --pythonpath "$PYTHON"
exec "$PYTHON" -m pytest --numprocesses 2 --dist loadfile "$@"
