#!/usr/bin/env bash
# Lint, types and tests, in under 9 minutes on 2 cores, set-up aside.
# --all, under 120 minutes: all tests as users compile, the default suite by a second Python, the slow ones by this one; the
# default suite in double precision, all but plants and loop with checks for NaN; places broken on purpose, 20 kills, run
# folders of the version that made them, the wheel in an environment of its own, the code blocks of the documentation, and
# stable-baselines3 and rejax on our environments (6 GB the first time, see peers.sh).
# --all WORDS: of these parts only those whose titles hold the words. What came out of each the last time is in
# benchmarks/results/tests.md. Other arguments go to pytest, and nothing else is tested then.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
tests() { "$PYTHON" -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder "$@"; }
quick=--xla_backend_optimization_level=0
"$PYTHON" -c 'import sys; sys.exit(sys.version_info >= (3, 12))' &&
    quick="$quick --xla_cpu_use_fusion_emitters=false"  # which newer versions than jax 0.10 don't know, and refuse
fast() {  # XLA compiles fast rather than well: most of what runs in tests is small
    XLA_FLAGS="$quick ${XLA_FLAGS:-}" "$@"
}
in_double() { JAX_ENABLE_X64=1 fast tests "$@"; }
no_nan() { JAX_DEBUG_NANS=1 in_double "$@"; }
by_peers() { PYTHONPATH=$root "$(PYTHON=$PYTHON bash scripts/peers.sh)" "$@"; }
rejax() {  # gymnax itself on our environment too
    local python
    python=$(PYTHON=$PYTHON bash scripts/peers.sh rejax) || return
    "$python" -m pytest tests/loop/test_spaces.py tests/runtime/test_gymnax.py || return
    PYTHONPATH=$root "$python" scripts/examples/rejax_td3.py
}
second_python() {  # the first of these that is there and is another than the default one
    local version python own
    own=$("$PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    for version in 3.14 3.13 3.12; do
        for python in "python$version" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".*/bin/python; do
            if [ "$version" != "$own" ] && "$python" -c 'import ensurepip' 2>/dev/null; then
                PYTHON=$python VENV=$root/.venv-$version bash scripts/test.sh tests
                return
            fi
        done
    done
    tests && echo "by Python $own alone: no Python 3.12 to 3.14 beside it on the path or under pyenv"
}
documentation() { NO_MKDOCS_2_WARNING=1 "$PYTHON" -m mkdocs build --strict --quiet && "$PYTHON" scripts/docs.py; }
commit=$(git rev-parse --short HEAD)$(git diff --quiet HEAD -- . ':!benchmarks/results' || echo -dirty)
result=benchmarks/results/tests.md failed=0
part() {  # TITLE COMMAND...: run it, and note its last line, minutes, commit and date in place of those before
    local title=$1 begin=$SECONDS last
    shift
    [[ $title == *$only* ]] || return 0
    last=$("$@" | tee >(cat >&2) | tail -n 1 | tr -d '=' | xargs) || failed=1
    sed -i "/^| $title |/d" "$result"
    printf '| %s | %s | %d | %s | %s |\n' "$title" "$last" $(((SECONDS - begin + 59) / 60)) \
        "$commit" "$(date --utc +%F)" >>"$result"
}

"$PYTHON" -m ruff format --check .
"$PYTHON" -m ruff check .
"$PYTHON" -m basedpyright --pythonpath "$PYTHON"
if [ $# -eq 0 ]; then
    fast tests
elif [ "$1" = --all ]; then
    only=${*:2}
    [ -e "$result" ] ||
        printf '`scripts/test.sh --all`, %s CPUs\n\n| part | last line | minutes | commit | date |\n|---|---|---|---|---|\n' \
            "$(nproc)" >"$result"
    part "the slow tests" tests --all -m slow
    part "plants and loop, double precision" in_double --all tests/plants tests/loop
    part "the others, double precision, checked for NaN" no_nan --ignore=tests/plants --ignore=tests/loop tests
    part "places broken on purpose" fast "$PYTHON" scripts/mutants.py
    part "20 kills" "$PYTHON" scripts/soak.py
    part "golden run folders" "$PYTHON" scripts/golden_runs.py
    part "a wheel in a fresh environment" bash scripts/wheel.sh
    part "the default suite, compiled as for users, by a second Python" second_python
    part "docs: built and executed" documentation
    part "stable-baselines3 learns" by_peers scripts/examples/sb3.py
    part "rejax learns" rejax
    exit $failed
else
    tests "$@"
fi
