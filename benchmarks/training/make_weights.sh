#!/bin/sh
# Make the weights that come with stickslip-training, and the table of docs/measurements.md, from nothing: about 4 CPU h.
#
#     benchmarks/training/make_weights.sh FOLDER
#
# Steps whose file is in FOLDER already are left out. The tests' clips are made and read last, and once.
# shellcheck disable=SC2046  # numbers of runs are words of their own
set -eu
out=$1
mkdir -p "$out"
python=.venv/bin/python
blender=.venv-blender/bin/python
runs=$out/runs.npz

if [ ! -e "$runs" ]; then
    $python benchmarks/training/cloth_runs.py "$out/runs" --seed 0 --runs 22 \
        --fabrics 11oz-black-denim gray-interlock tango-red-jet-set
    $python benchmarks/training/cloth_runs.py "$out/runs" --seed 1 --runs 26
    $python benchmarks/training/cloth_runs.py "$out/runs" --pack "$runs"
fi
[ -e "$out/between.npz" ] || $python benchmarks/training/between_runs.py "$runs" "$out/between.npz" --count 300 --seed 5

numbers() { # of the runs of a split: train, validation or test
    $python benchmarks/training/friction_tables.py numbers "$runs" --split "$1"
}
render() { # NAME RUNS options of blender_clips.py
    name=$1 && meshes=$2 && shift 2
    [ -e "$out/$name.npz" ] || $blender benchmarks/training/blender_clips.py "$meshes" "$out/$name.npz" "$@"
}

render train-a "$runs" --clips 207 --seed 11 --textures 8 --only $(numbers train)
render train-b "$runs" --clips 207 --seed 12 --textures 8 --only $(numbers train)
render train-between "$out/between.npz" --clips 300 --seed 31 --textures 8 --instants all
render validation "$runs" --clips 78 --seed 21 --textures 8 --only $(numbers validation)

[ -e "$out/rendered/friction.safetensors" ] ||
    .venv/bin/stickslip-train cloth train "$runs" --steps 7000 --threads 1 --out "$out/rendered"
[ -e "$out/tuned/friction.safetensors" ] ||
    .venv/bin/stickslip-train cloth train "$runs" --steps 4000 --threads 1 --rate 1e-3 --out "$out/tuned" \
        --start "$out/rendered/friction.safetensors" --clips "$out/train-a.npz" --clips "$out/train-b.npz" \
        --clips "$out/train-between.npz" --clips "$out/validation.npz"

render unseen-simulations "$runs" --clips 78 --seed 101 --textures 4 --only $(numbers test)
render unseen-textures "$runs" --clips 78 --seed 102 --textures 4 --held-out-textures --only $(numbers test)
render unseen-lights "$runs" --clips 78 --seed 103 --textures 4 --lighting held-out --only $(numbers test)
render unseen-views "$runs" --clips 108 --seed 104 --textures 6 --held-out-viewpoints --only $(numbers test)
$python benchmarks/training/friction_tables.py measure "$out/tuned/friction.safetensors" --records "$out/friction.jsonl" \
    "$out/unseen-simulations.npz" "$out/unseen-textures.npz" "$out/unseen-lights.npz" "$out/unseen-views.npz"
