#!/usr/bin/env bash
# Train an outer loop and show what came out: bash scripts/train.sh [pitch|heaters] [--seed N] ...
# All arguments go to `python -m jaxouter.train`; the environment is set up the first time.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
exec "$PYTHON" -m jaxouter.train "$@"
