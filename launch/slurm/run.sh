#!/usr/bin/env bash
# `rtcd` under srun, requeued when it was asked to stop: the last line of every script in this folder.
#
#   launch/slurm/run.sh optimize configs/pendulum_rtcd.yaml --run checkpoints/pendulum_rtcd
#
# On preemption, or shortly before the time limit (#SBATCH --signal=TERM@120), Slurm sends SIGTERM: rtcd saves and exits
# with 85. With 75 it has lost one of its processes (a node failed). Both times the job goes back into the queue, and the
# same command goes on where the state was saved. A cancelled job does not come back.
#
# RTCD is another program than the `rtcd` on the path; RTCD_CONTAINER=IMAGE.sif runs the one in an image, made by
# launch/container/rtcd.def, with the node's GPUs where JAX_PLATFORMS asks for them. RTCD_APPTAINER has more options for
# it, as `--bind /scratch`.
set -uo pipefail

trap : TERM   # this shell must outlive the signal, to requeue

command=("${RTCD:-rtcd}")
if [[ -n ${RTCD_CONTAINER:-} ]]; then
  gpus=()
  [[ ${JAX_PLATFORMS:-} == cuda ]] && gpus=(--nv)
  read -ra more <<<"${RTCD_APPTAINER:-}"
  command=(apptainer exec "${gpus[@]}" "${more[@]}" "$RTCD_CONTAINER" "${RTCD:-rtcd}")
fi
srun --kill-on-bad-exit=0 "${command[@]}" "$@"
code=$?

restarts=${SLURM_RESTART_COUNT:-0}
if [[ $code == 85 || $code == 75 ]]; then
  if ((restarts >= ${RTCD_RESTARTS:-100})); then
    echo "restarted $restarts times: not requeued"
  elif ! command -v scontrol >/dev/null; then
    echo "scontrol is not here (a container?): requeue by hand, scontrol requeue $SLURM_JOB_ID"
  else
    # Job arrays are requeued task by task. A job that is cancelled is at its end already.
    job=${SLURM_ARRAY_JOB_ID:+${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID}
    job=${job:-$SLURM_JOB_ID}
    state=$(scontrol show job --oneliner "$job" | sed -n 's/.* JobState=\([A-Z]*\).*/\1/p')
    if [[ $state == RUNNING ]]; then
      scontrol requeue "$job" && sleep 60   # until Slurm ends this script: one that exits before it may count as failed
    else
      echo "job $job is $state: not requeued"
    fi
  fi
fi
exit $code
