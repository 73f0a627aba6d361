#!/usr/bin/env bash
# All runs behind docs/results.md, table by table. On two cores it takes six hours; finished runs are not repeated.
#
#     bash benchmarks/results.sh DATA OUTPUT [--task I --of N]
#
# DATA holds the captures: facade, screen, fox, showcase, corner, mirror and front. Scenes that it lacks are made there:
# the rooms, and with Mitsuba 3 the glossy ones (docs/scenes.md). Several of these commands may share one OUTPUT
# (benchmarks/compare.py). Each table is in OUTPUT/NAME/tables.md.
set -euo pipefail
data=$1 output=$2
shift 2
common=("$@")
rooms=(245 246 247 248 249 250 251 252 253 254)

compare() { # NAME SCENE... [--OPTION...]
    python -m benchmarks.compare "${@:2}" --output "$output/$1" "${common[@]}"
}

make_scenes() { # FOLDER OPTION...
    [[ -d $data/$1 ]] || python -m tools.make_scenes --output "$data/$1" "${@:2}"
}

small=(--size 128 --train 40 --test 8 --samples 64 --points 10000 --environment-height 256)
make_scenes far --scenes ball torus control
make_scenes near --scenes table car sheet "${small[@]}"
make_scenes drawn --seed 1 2 3 4 5 "${small[@]}"
for room in "${rooms[@]}"; do
    [[ -d $data/rooms/$room ]] ||
        python -m tools.make_pane_scene --output "$data/rooms/$room" --drawn "$room" --width 400 --noise 2
done

compare facade "$data/facade" --options "--downscale 2"
compare screen "$data/screen"
compare fox "$data/fox" --methods splat --options "--downscale 4"
for run in "$output"/{facade,screen,fox}/*/*-seed0; do
    [[ -f $run/aligned.json ]] && continue
    cp "$run/results.json" "$run/as-posed.json"
    python -m glassplat eval "$run" --align always
    mv "$run/results.json" "$run/aligned.json"
    mv "$run/as-posed.json" "$run/results.json"
done

compare scenes "$data"/{showcase,corner,mirror,front}
compare rooms "${rooms[@]/#/$data/rooms/}"
compare seeds "$data/showcase" --methods planar --iterations 3000 --seeds 0 1 2
compare parts "$data"/{showcase,corner} --iterations 3000 \
    --variant depth="--weights.depth 0" --variant conflict="--weights.conflict 0" \
    --variant perturbation="--perturbation.amplitude 0" \
    --variant mcmc="--strategy mcmc" --variant splat:mcmc="--strategy mcmc"

compare far "$data"/far/{ball,torus,control} --methods splat deferred
compare drawn "$data"/drawn/drawn-{1,2,3,4,5} --methods splat deferred traced
compare near "$data"/near/{table,car,sheet} --methods splat deferred traced
