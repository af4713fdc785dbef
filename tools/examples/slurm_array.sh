#!/bin/sh
# Develop a folder of renders on a Slurm cluster with 16 tasks. Each task develops its share of the images.
#
#     sbatch tools/examples/slurm_array.sh frames/ -o out --iso 3200
#
# All arguments go to clpipe run. Inputs and output must be on a file system that all nodes share. Each
# task has its own log, such as out/run.03-of-16.jsonl. To resume, submit all tasks again, or some of
# them with "sbatch --array=3,7 ...". A task develops only missing images.
#
#SBATCH --job-name=clpipe
#SBATCH --array=1-16
#SBATCH --cpus-per-task=4
#SBATCH --mem=4G
#SBATCH --time=01:00:00
# Two minutes before the time limit, Slurm sends SIGTERM. clpipe finishes the images that it has
# started, and exits with status 130. B: sends the signal to this script, which exec replaces by clpipe.
#SBATCH --signal=B:TERM@120
set -eu
parts=${CLPIPE_PARTS:-16} # as in --array; not SLURM_ARRAY_TASK_COUNT, which is 2 for --array=3,7

exec clpipe run "$@" --shard "$SLURM_ARRAY_TASK_ID/$parts" --jobs "${SLURM_CPUS_PER_TASK:-1}"
