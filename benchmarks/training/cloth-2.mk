# Makes the test set cloth-2 and scores a reader of friction on it, both once:
#
#     make -f benchmarks/training/cloth-2.mk -j2 [OUT=cloth-2] [MODEL=friction.safetensors] [SET=131]
#
# SET 131 is cloth-2. SET 121 was cloth-2 until 27 November 2026; it has validated the weights of the package since.
# It has 60 simulations of ten fabrics and 600 clips over five floors, a fifth of them in the light of a room. It takes
# about an hour of CPU. Never train on these seeds. OUT keeps everything, so a second call goes on where the first
# stopped. Before that, remove each .claim file in OUT/runs that has no .npz file of the same name.
PY ?= .venv/bin/python
BLENDER_PY ?= .venv-blender/bin/python
OUT ?= cloth-2
MODEL ?= training/src/stickslip_training/cloth/friction.safetensors
SET ?= 131
HERE := benchmarks/training
RUNS := $(PY) $(HERE)/cloth_runs.py $(OUT)/runs --runs 6 --seed $(SET)01 --vertices 41 --preset certified \
  --self-friction 0.5 --density 0.9 1.1 --bending 0.9 1.1 --frames 221
matt := --seed $(SET)11
patterned := --seed $(SET)12 --albedo 0.3 0.7 --grain 0.4
bright := --seed $(SET)13 --albedo 0.5 0.85 --grain 0.1
oak := --seed $(SET)14 --substrate light-oak
room := --seed $(SET)15 --substrate white-table --lighting room
CLIPS := $(patsubst %,$(OUT)/%.npz,matt patterned bright oak room)
export OMP_NUM_THREADS := 1
.DELETE_ON_ERROR:

$(OUT)/scores.json: $(MODEL) $(OUT)/runs.npz $(CLIPS)
	$(PY) $(HERE)/world_set.py $^ --record $@
$(OUT)/runs.npz: $(OUT)/first $(OUT)/second
	$(PY) $(HERE)/cloth_runs.py $(OUT)/runs --pack $@
$(OUT)/first $(OUT)/second: # two processes share a folder
	mkdir -p $(OUT)
	$(RUNS) > $@.log && mv $@.log $@
$(CLIPS): $(OUT)/%.npz: $(OUT)/runs.npz
	$(BLENDER_PY) $(HERE)/blender_clips.py $< $@ --textures 2 --clips 60 --segmentation $($*)
