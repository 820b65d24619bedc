#!/usr/bin/env bash
# One training over several machines, one process on each: sbatch scripts/slurm.sh pitch --preset default
# All arguments go to `python -m jaxouter.train`. Environments, batch and seeds must divide over the devices (--help).
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --signal=TERM@120
# SLURM runs a copy of this script elsewhere, so the clone is where sbatch was called; it must be on a shared disk.
source "$SLURM_SUBMIT_DIR/scripts/setup.sh"
# JAX reads from SLURM where the others are. One device a process; with GPUs, --gpus-per-task and as many times more.
srun --kill-on-bad-exit=1 --cpus-per-task="$SLURM_CPUS_PER_TASK" "$PYTHON" -m jaxouter.train "$@" --devices "$SLURM_NTASKS"
