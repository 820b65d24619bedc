#!/usr/bin/env bash
# Training, throughput and the tests of plants and loop on this machine's accelerator, in under 8 minutes:
#     bash scripts/gpu.sh
# What came out goes to benchmarks/results/gpu.md, with machine and date. With NVIDIA's driver, JAX for CUDA is installed
# into the environment first; without an accelerator everything runs on the CPU.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
if nvidia-smi >/dev/null 2>&1 && ! "$PYTHON" -c 'import jax_cuda13_plugin' 2>/dev/null; then
    jax=$("$PYTHON" -c 'import jax; print(jax.__version__)')
    "$PYTHON" -m pip --disable-pip-version-check install --quiet "jax[cuda13]==$jax" >&2
fi
result=${RESULT:-benchmarks/results/gpu.md}
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
seconds() {  # COMMAND...: its last line and the seconds it took
    local begin=$SECONDS last
    last=$("$@" 2>&1 | tee /dev/stderr | tail -n 1 | tr '|' ' ')
    printf '%s | %d |\n' "$last" $((SECONDS - begin))
}
{
    "$PYTHON" -c 'import datetime, jax; kinds = ", ".join(each.device_kind for each in jax.devices())
print(f"jax {jax.__version__} on {kinds}, {datetime.date.today()}")'
    printf '\n| what | last line | seconds |\n|---|---|---|\n'
    for preset in default scratch; do
        printf '| `train pitch --preset %s` | ' "$preset"
        seconds timeout 120 "$PYTHON" -m jaxouter.train pitch --preset "$preset" --out "$out/$preset"
    done
    printf '| throughput | '
    seconds timeout 180 "$PYTHON" benchmarks/throughput.py --quick --json "$out/throughput.json" \
        --cases 'plant/pitch/*' 'rollout/*' 'fused/default' 'fused/paper'
    printf '| `pytest tests/plants tests/loop` | '
    seconds timeout 180 "$PYTHON" -m pytest -q -p no:xdist tests/plants tests/loop
    printf '\n```json\n'
    cat "$out/throughput.json" 2>/dev/null || echo '{}'
    printf '```\n'
} >"$out/gpu.md"
mv "$out/gpu.md" "$result"
echo "written to $result"
