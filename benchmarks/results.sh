#!/usr/bin/env bash
# All runs behind docs/results.md, table by table. On two cores they take eight hours; finished ones are not repeated.
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

compare() { # NAME SCENE... [--OPTION...]
    python -m benchmarks.compare "${@:2}" --output "$output/$1" "${common[@]}"
}

glossy() { # FOLDER OPTION...
    [[ -d $data/$1 ]] || python -m tools.make_scenes --output "$data/$1" --samples 64 "${@:2}"
}

small=(--points 10000 --environment-height 256)
glossy far --scenes ball torus control --train 60
glossy near --scenes table car sheet --size 128 --train 40 --test 8 "${small[@]}"
glossy drawn --seed 1 2 3 4 5 21 22 23 24 25 --size 200 --train 60 --test 12 "${small[@]}"
for seed in {245..254}; do
    [[ -d $data/rooms/$seed ]] ||
        python -m tools.make_pane_scene --output "$data/rooms/$seed" --drawn "$seed" --width 400 --noise 2
done

compare facade "$data/facade" --options "--downscale 2"
compare screen "$data/screen"
compare fox "$data/fox" --methods splat --options "--downscale 4"
compare scenes "$data"/{showcase,corner,mirror,front}
compare rooms "$data"/rooms/{245..254}
compare chance "$data/showcase" --methods planar --iterations 3000 --seeds 1 2
compare parts "$data"/{showcase,corner} --iterations 3000 \
    --variant depth="--weights.depth 0" --variant conflict="--weights.conflict 0" \
    --variant perturbation="--perturbation.amplitude 0" \
    --variant mcmc="--strategy mcmc" --variant splat:mcmc="--strategy mcmc"
compare far "$data"/far/{ball,torus,control} --methods splat deferred
compare drawn "$data"/drawn/drawn-{1,2,3,4,5,21,22,23,24,25} --methods splat deferred
compare near "$data"/near/{table,car,sheet} --methods splat deferred traced
