#!/bin/bash
# What both sbatch files run inside an allocation: a job on every task, then requeue where it asks for that. The job is
# the first word, train (default), evaluate or mine; the rest are its options.
# Settings, by environment: PLACE_RECOGNITION_ROOT (this checkout; default the folder sbatch was called in), PYTHON
# (default .venv/bin/python there), PRECISION (no, bf16, fp16; default bf16), ENGINE (ddp, fsdp2, zero1, zero2, zero3;
# default ddp), PORT (default from the job's number).
set -u
case "${1:-}" in
    train | evaluate | mine) export JOB="jobs.$1"; shift ;;
    "" | --*) export JOB=jobs.train ;;
    *) echo "'$1' is not one of train, evaluate, mine" >&2; exit 2 ;;
esac
cd "${PLACE_RECOGNITION_ROOT:-$SLURM_SUBMIT_DIR}" || exit 2
export PYTHON="${PYTHON:-.venv/bin/python}"
export MASTER_ADDR="${MASTER_ADDR:-$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)}"
export MASTER_PORT="${PORT:-$((20000 + SLURM_JOB_ID % 20000))}"
export ACCELERATE_MIXED_PRECISION="${PRECISION:-bf16}"
case "${ENGINE:-ddp}" in
    ddp) ;;
    fsdp2) export ACCELERATE_USE_FSDP=true FSDP_VERSION=2 ;;
    zero[123]) export ACCELERATE_USE_DEEPSPEED=true ACCELERATE_DEEPSPEED_ZERO_STAGE="${ENGINE#zero}" ;;
    *) echo "ENGINE $ENGINE is not one of ddp, fsdp2, zero1, zero2, zero3" >&2; exit 2 ;;
esac

# kill-on-bad-exit: a rank that dies takes the others along at once, instead of after their timeout. A rank that leaves
# with 75 does so together with all others, after the checkpoint.
srun --kill-on-bad-exit=1 bash -c '
    export RANK=$SLURM_PROCID LOCAL_RANK=$SLURM_LOCALID WORLD_SIZE=$SLURM_NTASKS
    export LOCAL_WORLD_SIZE=${SLURM_NTASKS_PER_NODE:-$SLURM_NTASKS}
    exec "$PYTHON" -m "$JOB" "$@"' bash "$@"
code=$?
echo "$JOB ended with $code"
if [ "$code" -eq 75 ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
