#!/bin/bash
# A tsbench command for each task of a Slurm array. It goes on after every interruption:
#
#   sbatch --array=0-9 array.sh run -m task=laikago_trot seed=%a
#   sbatch --array=0-7 array.sh tune task=laikago_trot method=twostage trials=60
#
# %a stands for the number of the array's task. Submit it from a directory that all nodes share, in
# which the command `tsbench` works.
#
#SBATCH --job-name=tsbench
#SBATCH --cpus-per-task=2
#SBATCH --time=04:00:00
#SBATCH --output=slurm-%A_%a.out
#SBATCH --open-mode=append
#
# Slurm starts a task again after preemption or the failure of its node.
#SBATCH --requeue
# Two minutes before the time limit this shell gets SIGTERM. It then asks for another start.
#SBATCH --signal=B:TERM@120

tsbench "${@//%a/$SLURM_ARRAY_TASK_ID}" threads="$SLURM_CPUS_PER_TASK" &
command=$!
trap 'kill -TERM "$command"' TERM  # tsbench saves a checkpoint and ends with status 143
wait "$command"
status=$?
while kill -0 "$command" 2>/dev/null; do  # the signal has ended `wait`, not yet the command
    wait "$command"
    status=$?
done
if ((status == 143)); then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$status"
