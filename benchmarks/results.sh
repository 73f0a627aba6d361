#!/usr/bin/env bash
# All runs of docs/results.md, table by table. They take eight hours on two cores; finished runs are skipped.
#
#     bash benchmarks/results.sh DATA OUTPUT [--task I --of N]
# DATA holds the captures: facade, screen, fox, showcase, corner, mirror and front. Missing scenes are generated there:
# the rooms, and the glossy ones with Mitsuba 3 (docs/scenes.md). Afterwards, several of these commands may share one
# OUTPUT (benchmarks/compare.py). Each table is written to OUTPUT/NAME/tables.md.
set -euo pipefail
data=$1 output=$2
shift 2
common=("$@")

compare() { # NAME SCENE... [--OPTION...]
    python -m benchmarks.compare "${@:2}" --output "$output/$1" "${common[@]}"
}

make_once() { # FOLDER TOOL [--OPTION...]
    [[ -d $data/$1 ]] && return
    rm -rf "$data/$1.part" # left by an interrupted command
    python -m "tools.$2" --output "$data/$1.part" "${@:3}"
    mv "$data/$1.part" "$data/$1"
}

glossy=(--samples 64 --points 10000 --environment-height 256)
make_once far make_scenes --scenes ball torus control --train 60 --samples 64
make_once near make_scenes --scenes table car sheet --size 128 --train 40 --test 8 "${glossy[@]}"
make_once near-normals make_scenes --scenes table car sheet --size 128 --train 40 --test 8 "${glossy[@]}" --estimated-normals 10
make_once drawn make_scenes --seed 1 2 3 4 5 21 22 23 24 25 --size 200 --train 60 --test 12 "${glossy[@]}"
for seed in {245..254}; do
    make_once "rooms/$seed" make_pane_scene --drawn "$seed" --width 400 --noise 2
done

compare facade "$data/facade" --options "--downscale 2"
compare facade-seed1 "$data/facade" --methods splat --seeds 1 --options "--downscale 2"
compare screen "$data/screen"
compare fox "$data/fox" --methods splat --options "--downscale 4"
compare scenes "$data"/{showcase,corner,mirror,front}
compare rooms "$data"/rooms/{245..254}
# Seed 0 is part of `parts`.
compare chance "$data/showcase" --methods planar --iterations 3000 --seeds 1 2
compare parts "$data"/{showcase,corner} --iterations 3000 \
    --variant depth="--weights.depth 0" --variant conflict="--weights.conflict 0" \
    --variant perturbation="--perturbation.amplitude 0" \
    --variant mcmc="--strategy mcmc" --variant splat:mcmc="--strategy mcmc"
compare far "$data"/far/{ball,torus,control} --methods splat deferred
compare drawn "$data"/drawn/drawn-{1,2,3,4,5,21,22,23,24,25} --methods splat deferred
compare near "$data"/near/{table,car,sheet} --methods splat deferred traced
compare near-normals "$data"/near-normals/{table,car,sheet} --methods traced
