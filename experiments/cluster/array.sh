#!/bin/bash
#SBATCH --job-name=skin
#SBATCH --array=1-8
#SBATCH --cpus-per-task=1
#SBATCH --output=skin-%A_%a.log
# One task of a job array: part i of n of a multirun or a study. Submit it again to run what is missing.
#
#     sbatch experiments/cluster/array.sh train -m sweep=table seed=0,1,2 tracking.uri=http://127.0.0.1:5000
#     sbatch --array=1-20 experiments/cluster/array.sh study study=models study.part=norm tracking.uri=http://127.0.0.1:5000
set -euo pipefail

export OMP_NUM_THREADS=${OMP_NUM_THREADS:-${SLURM_CPUS_PER_TASK:-1}}
exec "${PYTHON:-python}" -m skin "$@" "shard=$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT"
