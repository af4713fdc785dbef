#!/bin/sh
# A folder of renders on a Slurm cluster: 16 tasks, each of which does its share of the images.
#
#     sbatch tools/examples/slurm_array.sh frames/ -o out --iso 3200
#
# All arguments go to clpipe run. Inputs and output lie on a file system that all nodes see. Each task
# has a log of its own, out/run.03-of-16.jsonl. What a task has finished stays: sent again, as a whole
# or as "sbatch --array=3,7 ...", it does only what is missing.
#
#SBATCH --job-name=clpipe
#SBATCH --array=1-16
#SBATCH --cpus-per-task=4
#SBATCH --mem=4G
#SBATCH --time=01:00:00
# Two minutes before the time is up Slurm sends SIGTERM: clpipe finishes the images that are in
# flight, and leaves with status 130. (B: to this script, which exec below makes clpipe itself.)
#SBATCH --signal=B:TERM@120
set -eu
parts=${CLPIPE_PARTS:-16} # as --array says; not SLURM_ARRAY_TASK_COUNT, which is 2 for --array=3,7

exec clpipe run "$@" --shard "$SLURM_ARRAY_TASK_ID/$parts" --jobs "${SLURM_CPUS_PER_TASK:-1}"
