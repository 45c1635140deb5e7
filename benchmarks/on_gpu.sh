#!/bin/bash
# What a machine with a GPU should show. A step that fails or takes too long does not stop the next.
#
#   bash benchmarks/on_gpu.sh OUT [STEP ...]      with tsbench's packages on the path
#
# OUT gets log.txt, bench.json and each training's directory as STEP.tgz. The steps, in the order of the
# default; the seconds are those of an H100, where they were seen, or a guess (?):
#   versions    of driver and packages (20)
#   compile     mujoco-warp's kernels for all robots, in the background: `trotfast` plans meanwhile (90)
#   trotfast    laikago_trot with 5 M + 3.5 M steps, and its score (75 + 60?)
#   paper       laikago_trot with 10 M + 10 M steps, and its score (185 + 60?)
#   bench       rates of physics, environments and trainings (200?)
#   flips       verdicts of the kept entries in the second engine, ten at a time (120?)
#   check       graphs, waiting, resume (100?)
#   trot rocket obstacles walk      the trainings of `budget=fast` (140 + 60? for the trot)
# and agreement, speed and room of benchmarks/gpu_physics.py as `physics`, which is not among them.
set -u
out=${1:?the folder of the results is missing: bash benchmarks/on_gpu.sh OUT [STEP ...]}
shift
steps=${*:-versions compile trotfast paper bench flips check trot rocket obstacles walk}
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

train() { # NAME SECONDS BUDGET WORDS...: the seconds of the stages in score.json are without compiling
    run "$1" "$2" python3 -m tsbench run budget="$3" "${@:4}" device=cuda threads="$threads" \
        ++task.budgets."$3".audit=warn directory="$runs/$1"
    tar -czf "$out/$1.tgz" -C "$runs" "$1"
}

compile() { # of the robots, each in a process of its own
    for robot in laikago_trot rocket_navigation rocket_obstacles; do
        timeout 200 python3 benchmarks/gpu_physics.py --compile $robot >>"$out/compile.txt" 2>&1 &
    done
}

flips() {
    python3 -c 'from tsbench.leaderboard import kept; print(*kept.entries(), sep="\n")' |
        xargs -P 10 -I ENTRY python3 benchmarks/gpu_physics.py --only "flips, ENTRY"
}
export -f flips

for step in $steps; do
    case $step in
    versions)
        run versions 60 nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
        run versions 120 python3 -c 'import torch, warp, mujoco, mujoco_warp, rsl_rl, tensordict
print(torch.__version__, warp.__version__, mujoco.__version__, torch.cuda.get_device_name())'
        run versions 60 python3 -m tsbench list
        ;;
    compile) compile ;;
    physics) run physics 330 python3 benchmarks/gpu_physics.py --seconds 270 \
        --only versions agreement speed divergence room ;;
    flips) run flips 300 bash -c flips ;;
    check) run check 200 python3 benchmarks/gpu_check.py ;;
    trotfast) train trotfast 300 fast task=laikago_trot task.budgets.fast.plan=5_000_000 \
        task.budgets.fast.act=3_500_000 ;;
    paper) train paper 400 paper task=laikago_trot ;;
    trot) train trot 400 fast task=laikago_trot ;;
    walk) train walk 400 fast task=laikago_walk ;;
    rocket) train rocket 200 fast task=rocket_navigation ;;
    obstacles) train obstacles 200 fast task=rocket_obstacles ;;
    bench) run bench 300 python3 -m tsbench bench --only gpu --json "$out/bench.json" ;;
    *) echo "== $step: there is no such step" | tee -a "$out/log.txt" ;;
    esac
done
wait
