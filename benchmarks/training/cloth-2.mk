# Makes the test set cloth-2 and scores a reader of friction on it, both once:
#
#     make -f benchmarks/training/cloth-2.mk -j2 [OUT=cloth-2] [MODEL=friction.safetensors]
#
# 60 simulations of ten fabrics, and 600 clips over five floors, a fifth of them in the light of a room. Never train on
# these seeds. OUT keeps all of it; a call goes on where another stopped, after `rm OUT/runs/*.claim`. About an hour of CPU.
PY ?= .venv/bin/python
BLENDER_PY ?= .venv-blender/bin/python
OUT ?= cloth-2
MODEL ?= training/src/stickslip_training/cloth/friction.safetensors
HERE := benchmarks/training
RUNS := $(PY) $(HERE)/cloth_runs.py $(OUT)/runs --runs 6 --seed 12101 --vertices 41 --preset certified \
  --self-friction 0.5 --density 0.9 1.1 --bending 0.9 1.1 --frames 221
FLOORS := matt patterned bright oak room
SHADE = $(BLENDER_PY) $(HERE)/blender_clips.py $< $@ --textures 2 --clips 60 --segmentation
export OMP_NUM_THREADS := 1
.DELETE_ON_ERROR:

$(OUT)/scores.json: $(MODEL) $(OUT)/runs.npz $(FLOORS:%=$(OUT)/%.npz)
	$(PY) $(HERE)/world_set.py $^ --record $@
$(OUT)/runs.npz: $(OUT)/first $(OUT)/second
	$(PY) $(HERE)/cloth_runs.py $(OUT)/runs --pack $@
$(OUT)/first $(OUT)/second: # two processes share a folder
	mkdir -p $(OUT)/runs
	$(RUNS) > $@.log && mv $@.log $@
$(OUT)/matt.npz: $(OUT)/runs.npz
	$(SHADE) --seed 12111
$(OUT)/patterned.npz: $(OUT)/runs.npz
	$(SHADE) --seed 12112 --albedo 0.3 0.7 --grain 0.4
$(OUT)/bright.npz: $(OUT)/runs.npz
	$(SHADE) --seed 12113 --albedo 0.5 0.85 --grain 0.1
$(OUT)/oak.npz: $(OUT)/runs.npz
	$(SHADE) --seed 12114 --substrate light-oak
$(OUT)/room.npz: $(OUT)/runs.npz
	$(SHADE) --seed 12115 --substrate white-table --lighting room
