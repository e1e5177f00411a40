#!/usr/bin/env bash
# A run on a workstation, in the background, that outlives the terminal and is started again after a crash of the
# machine by the same command:
#   launch/local.sh configs/cartpole_rtcd.yaml --run checkpoints/cartpole_rtcd
# Its output goes to rtcd.log; `kill -TERM PROCESS` saves and stops it.
set -euo pipefail
rtcd=${RTCD:-$(command -v rtcd || echo .venv/bin/rtcd)}
command -v "$rtcd" >/dev/null || { echo "no $rtcd here: \`make run\` in the repository's root makes it" >&2; exit 2; }
nohup "$rtcd" optimize "$@" >>rtcd.log 2>&1 </dev/null &
echo "process $!, output in rtcd.log"
