#!/bin/bash
# Everything that a machine with a GPU should show. A step that fails or takes too long does not stop
# the next.
#
#   bash benchmarks/on_gpu.sh OUT [STEP ...]      with tsbench's packages on the path
#
# OUT gets log.txt, bench.json and each training's directory as STEP.tgz. The steps, in the order of the default:
#   versions check trot rocket bench obstacles walk
# and physics, which is not among them.
set -u
out=$1
shift
steps=${*:-versions check trot rocket bench obstacles walk}
threads=$(nproc --all)  # plain nproc heeds OMP_NUM_THREADS
runs=$(mktemp -d)
export PYTHONPATH=${PYTHONPATH:+$PYTHONPATH:}$PWD PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1
mkdir -p "$out"

run() { # NAME SECONDS COMMAND...
    echo "== $1: ${*:3}" | tee -a "$out/log.txt"
    local began=$SECONDS
    timeout --kill-after=10 "$2" "${@:3}" 2>&1 | tee -a "$out/log.txt"
    echo "== $1: exit ${PIPESTATUS[0]} after $((SECONDS - began)) s" | tee -a "$out/log.txt"
}

train() { # NAME SECONDS WORDS...
    run "$1" "$2" python3 -m tsbench run "${@:3}" device=cuda threads="$threads" \
        ++task.budgets.fast.audit=warn directory="$runs/$1"
    tar -czf "$out/$1.tgz" -C "$runs" "$1"
}

for step in $steps; do
    case $step in
    versions)
        run versions 60 nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
        run versions 120 python3 -c 'import torch, warp, mujoco, mujoco_warp, rsl_rl, tensordict
print(torch.__version__, warp.__version__, mujoco.__version__, torch.cuda.get_device_name())'
        run versions 60 python3 -m tsbench list
        ;;
    physics) run physics 330 python3 benchmarks/gpu_physics.py --seconds 270 ;;
    check) run check 240 python3 benchmarks/gpu_check.py ;;
    trot) train trot 300 task=laikago_trot ;;
    walk) train walk 300 task=laikago_walk ;;
    rocket) train rocket 200 task=rocket_navigation ;;
    obstacles) train obstacles 200 task=rocket_obstacles ;;
    bench) run bench 300 python3 -m tsbench bench --only gpu --json "$out/bench.json" ;;
    esac
done
