#!/usr/bin/env bash
# Everything that is worth measuring where a GPU is lent for ten minutes. From the repository's root:
#   pip install -e '.[cuda12]' && launch/bench/gpu.sh
# Each step has a time limit and leaves its results before the next one begins: steps.jsonl says what came of all of them
# (seconds of wall clock, compilation included; 0 is done, 124 out of time). The dearest steps come last. A tiny version
# shows on a CPU that all of it works:
#   POPULATIONS=8 REPEATS=1 CONFIGS=smoke RUN='configs/smoke.yaml' RESULTS=/tmp/gpu JAX_PLATFORMS=cpu launch/bench/gpu.sh
set -uo pipefail

populations=${POPULATIONS:-1 128 4096 65536}
configs=${CONFIGS:-pendulum_rtcd cartpole_rtcd}
repeats=${REPEATS:-3}
run=${RUN:-configs/pendulum_rtcd.yaml --search.population 4096 --search.generations 20}
resumed=${RESUMED:-configs/smoke.yaml --search.generations 100}
seconds=${SECONDS_A_STEP:-180}
results=${RESULTS:-launch/bench/results/gpu}
platform=${JAX_PLATFORMS:-cuda}   # a machine without its GPU is an error, and not a slow run
python=${PYTHON:-python}

mkdir -p "$results"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
: >"$results/steps.jsonl"
failed=0

step() {   # step NAME COMMAND…: its output in NAME.log, a line in steps.jsonl
  local name=$1 code begin=$EPOCHREALTIME
  shift
  echo "$name: $*"
  JAX_PLATFORMS=$platform timeout --kill-after=30 "$seconds" "$@" >"$results/$name.log" 2>&1
  code=$?
  printf '{"step": "%s", "exit": %d, "seconds": %.2f}\n' \
    "$name" "$code" "$(awk "BEGIN {print ${EPOCHREALTIME/,/.} - ${begin/,/.}}")" | tee -a "$results/steps.jsonl"
  if ((code)); then
    failed=$((failed + 1))
    tail -n 5 "$results/$name.log"
  fi
}

throughput() {   # throughput NAME CONFIG POPULATION [OPTION…]
  local folder=$results/$1
  step "$1" "$python" launch/bench/throughput.py --config "configs/$2.yaml" --populations "$3" --repeats "$repeats" \
    --results "$folder" "${@:4}"
}

# Stopped on the CPU after its first states, ended on the device: `on_cpu` has exit code 85.
resume() {
  local command=("$python" -m rtcd_jax optimize) words
  read -ra words <<<"$resumed"
  command+=("${words[@]}" --run "$scratch/resumed")
  JAX_PLATFORMS=cpu timeout --kill-after=30 "$seconds" "${command[@]}" >"$results/on_cpu.log" 2>&1 &
  local process=$! lines=0 code
  while kill -0 "$process" 2>/dev/null && ((lines < 3)); do
    sleep 1
    lines=$(cat "$scratch/resumed/generations.jsonl" 2>/dev/null | wc -l)
  done
  kill -TERM "$process" 2>/dev/null
  wait "$process"
  code=$?
  printf '{"step": "on_cpu", "exit": %d, "generations": %d}\n' "$code" "$lines" | tee -a "$results/steps.jsonl"
  step resumed "${command[@]}"
}

step device "$python" -c 'import jax; print(jax.devices(), jax.devices()[0].memory_stats())'
for population in $populations; do
  for config in $configs; do
    throughput "${config}_$population" "$config" "$population"
  done
done
middle=$(wc -w <<<"$populations")
middle=$(cut -d' ' -f$(((middle + 1) / 2)) <<<"$populations")
for rollouts in closed_form mjx; do
  throughput "rollouts_$rollouts" "${configs%% *}" "$middle" --rollouts "$rollouts"
done
read -ra words <<<"$run"
step optimize "$python" -m rtcd_jax optimize "${words[@]}" --run "$scratch/run"
cp "$scratch/run/generations.jsonl" "$results/optimize_generations.jsonl" 2>/dev/null
resume
echo "results: $results"
exit $((failed > 0))
