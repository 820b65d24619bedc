#!/usr/bin/env bash
# Write requirements.lock anew from pyproject.toml: one file for Python 3.11 to 3.14 and all platforms, with hashes.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
"$PYTHON" -m pip --disable-pip-version-check install --quiet uv
"$PYTHON" -m uv pip compile --universal --fork-strategy fewest --python-version 3.11 --generate-hashes --extra dev \
    --no-header --no-annotate --upgrade --quiet pyproject.toml --output-file requirements.lock
