#!/usr/bin/env bash
# Look up the packages of requirements.lock in the list of known vulnerabilities; needs the internet.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
audit=$(mktemp -d)
trap 'rm -rf "$audit"' EXIT
"$PYTHON" -m venv "$audit"
"$audit/bin/python" -m pip --disable-pip-version-check install --quiet pip-audit
"$audit/bin/pip-audit" --requirement "$root/requirements.lock" --require-hashes --disable-pip
