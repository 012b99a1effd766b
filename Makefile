# make demo | test-fast | test | test-kernels | test-slow | check | docs | bench | wheels | constraints | clean.
# Every target sets up what it needs; a second call is quick.

PYTHON ?= python3.11
PY = .venv/bin/python
BLENDER_PY = .venv-blender/bin/python
PIP_FLAGS = --quiet --disable-pip-version-check
# Python keeps what it compiled, also where the environment says otherwise: tests would be compiled by every process.
export PYTHONDONTWRITEBYTECODE =

SOURCES = $(addsuffix /src,schemas measure services testing training workers workers/blender) sim_core/python examples benchmarks tools
# Modules of tests are named from here on: different components have some of the same name. The other tests are not typed.
TESTS = $(addsuffix /tests,schemas measure services sim_core) tests
PYPROJECTS = $(wildcard */pyproject.toml) workers/blender/pyproject.toml VERSION
CORE_SOURCES = $(shell find sim_core/src sim_core/cmake sim_core/tests/core -type f) sim_core/CMakeLists.txt sim_core/pyproject.toml
RASTER_SOURCES = $(wildcard workers/blender/raster/* workers/blender/cmake/*) \
  $(addprefix workers/blender/,CMakeLists.txt pyproject.toml)
# reconstruction.py calls render_rod_set.py with Blender's interpreter, reader.py needs a dataset, yarn.py centrelines, cloth_contact.py
# takes half an hour. render_cloth.py needs a trajectory, which render_trajectory.py simulates for a minute, and then renders for an hour.
BENCHMARKS = $(filter-out $(addprefix benchmarks/, render_rod_set.py cloth_contact.py render_cloth.py render_trajectory.py \
  reader.py yarn.py reality.py),$(wildcard benchmarks/*.py))
DISTRIBUTIONS = schemas sim_core measure services training workers workers/blender
CPP_FILES = $(shell find sim_core/src sim_core/tests/core workers/blender/raster -name "*.[ch]pp")

.PHONY: setup setup-dev demo test-fast test test-kernels test-slow test-main test-blender test-slow-main test-slow-blender test-without-blender test-core check complexity size density docs bench reality wheels release-wheels release-check constraints clean

# The environments that `make demo` and the service need. Tests and checks need more: setup-dev.
setup: .venv/core.stamp .venv-blender/raster.stamp

setup-dev: setup .venv/dev.stamp

.venv/setup.stamp: constraints.txt requirements.txt $(PYPROJECTS)
	@tools/check_system.sh $(PYTHON)
	@$(PYTHON) tools/setup_environment.py runtime
	@touch $@ .venv/core.stamp

.venv/dev.stamp: constraints.txt requirements-dev.txt $(PYPROJECTS) | .venv/setup.stamp
	@$(PYTHON) tools/setup_environment.py development
	@touch $@

# The editable install builds the C++ core once: a changed source builds it again. A wheel compiles everything anew, and so
# does the next editable install after it: scikit-build-core clears a build folder for each new environment of a build.
.venv/core.stamp: $(CORE_SOURCES) | .venv/setup.stamp
	@if [ -n "$$(find $(CORE_SOURCES) -newer $@ 2>&1)" ]; then \
	  echo "building sim_core (1 to 3 minutes)"; \
	  $(PY) -m pip install $(PIP_FLAGS) --no-deps --editable sim_core && touch $@; \
	fi

.venv-blender/setup.stamp: constraints-blender.txt requirements-blender.txt $(PYPROJECTS)
	@tools/check_system.sh $(PYTHON)
	@$(PYTHON) tools/setup_environment.py blender
	@touch $@ .venv-blender/raster.stamp

# As for the core: a changed source of the rasteriser builds it again.
.venv-blender/raster.stamp: $(RASTER_SOURCES) | .venv-blender/setup.stamp
	@if [ -n "$$(find $(RASTER_SOURCES) -newer $@ 2>&1)" ]; then \
	  echo "building the rasteriser"; \
	  $(BLENDER_PY) -m pip install $(PIP_FLAGS) --no-deps --editable workers/blender && touch $@; \
	fi

demo: setup
	$(PY) examples/demo.py

# Three tiers. Fast: no test over one CPU second, none that starts Ray, Blender, PostgreSQL or a server. The second is what
# a change must pass, with `check` beside the tests. Slow: the long, the random, and what repeats on another database.
# Slow tests mostly wait: twice as many run at once, with four times the time, and those with time limits of their own
# one after the other.
# A process of tests that dies ends the run: xdist waits for ever for the tests of one that it starts anew.
PYTEST = $(PY) -m pytest --quiet --numprocesses=auto --dist=loadgroup --no-loadscope-reorder --max-worker-restart=0

test-fast: setup-dev
	$(PYTEST) -m "not slow and not real and not physics" --cpu-limit=1

test: setup-dev
	@$(MAKE) --no-print-directory --jobs=3 --output-sync=target --keep-going test-main test-blender check

# Tests wait a quarter of their time: one more runs than there are cores.
test-main:
	$(PYTEST) --numprocesses=$$(($$(nproc) + 1))

test-blender:
	$(BLENDER_PY) -m pytest --quiet workers/blender

# All but Blender and the tests that start it, on any Python from 3.11.
test-without-blender: .venv/core.stamp .venv/dev.stamp
	$(PYTEST) -m "not slow and not real"

# The core alone, on any system that has a C++20 compiler: CI runs it on arm64 and on macOS.
test-core:
	$(PYTHON) -m venv .venv-core
	.venv-core/bin/python -m pip install $(PIP_FLAGS) "./sim_core[protocols]" pytest pytest-timeout hypothesis
	.venv-core/bin/python -m pytest --quiet -p no:cacheprovider --rootdir sim_core --confcutdir sim_core \
	  --import-mode importlib -m "not slow" sim_core/tests

# Cloth and what it does on every level of the kernels (STICKSLIP_CLOTH_KERNEL) that this processor runs, but for the one that
# `make test` takes. The rods give the same bits on all levels, which tests of theirs compare.
KERNEL_TESTS = $(addprefix sim_core/tests/,cloth scenes protocols/test_protocols_cloth.py protocols/test_protocols_contact.py) \
  tests/test_scenes_of_data.py tests/test_own_scene.py

test-kernels: setup-dev
	@for level in $$($(PY) tools/other_kernels.py); do \
	  echo "cloth on kernels of level $$level"; \
	  STICKSLIP_CLOTH_KERNEL=$$level $(PYTEST) $(KERNEL_TESTS) || exit 1; \
	done

# Cognitive complexity of the core by clang-tidy, which takes a CPU minute.
complexity: setup-dev
	$(PY) tools/complexity.py

# Slow tests of the service mostly wait, so the others and the complexity of the core run beside them.
test-slow: setup-dev
	@$(MAKE) --no-print-directory --jobs=3 --output-sync=target --keep-going test-slow-main test-slow-blender complexity

test-slow-main:
	$(PYTEST) --numprocesses=$$((2 * $$(nproc))) --timeout=1200 -m slow

test-slow-blender:
	$(BLENDER_PY) -m pytest --quiet -m slow workers/blender

check: setup-dev
	$(PY) -m ruff format --check .
	$(PY) -m ruff check .
	.venv/bin/clang-format --dry-run --Werror $(CPP_FILES)
	$(PY) -m codespell_lib
	$(PY) tools/prose.py
	PYTHONPATH=workers/blender/src .venv/bin/lint-imports --no-logo
	$(PY) tools/include_circles.py
	@for distribution in $(DISTRIBUTIONS); do (cd $$distribution && $(CURDIR)/$(PY) -m deptry --no-ansi .) || exit 1; done
	@$(MAKE) --no-print-directory size density
	$(PY) tools/names.py
	$(PY) -m mypy $(SOURCES)
	MYPYPATH=.:tests $(PY) -m mypy --explicit-package-bases $(TESTS)

# The lines of source, and files that are longer than they should be.
size:
	@$(PY) tools/size.py

# How dense the code is, beside the models. It warns and never fails.
density: .venv/setup.stamp
	@$(PY) tools/density.py

# A warning is an error; tests/test_docs_code.py does the same, and runs the code of the pages.
docs: setup-dev
	$(PY) -m sphinx -W --keep-going -q -b html docs build/docs
	@echo "build/docs/index.html"

bench: setup-dev
	@for script in $(BENCHMARKS); do \
	  echo "== $$script"; \
	  case $$script in */render_*) $(BLENDER_PY) $$script ;; *) $(PY) $$script ;; esac || exit 1; \
	done

# Drape and bending of the built-in fabrics, beside published measurements: docs/reality.md. Remove the record to measure all.
reality: setup-dev
	$(PY) benchmarks/reality.py

# Everything that PyPI gets: source distributions, and wheels of this machine. Release wheels come from cibuildwheel.
wheels: setup-dev
	@for distribution in $(DISTRIBUTIONS); do $(PY) -m build --outdir dist $$distribution || exit 1; done

# In CI, with Docker: manylinux wheels of the two compiled distributions; their pyproject.toml configures cibuildwheel.
release-wheels: setup-dev
	@for distribution in schemas measure services training workers; do $(PY) -m build --outdir dist $$distribution || exit 1; done
	@for distribution in sim_core workers/blender; do \
	  $(PY) -m build --sdist --outdir dist $$distribution || exit 1; \
	  .venv/bin/pip install $(PIP_FLAGS) "cibuildwheel>=4.3,<5"; \
	  $(PY) -m cibuildwheel --platform linux --output-dir dist $$distribution || exit 1; \
	done

# What a stranger meets: pins that the index has, and a fresh clone whose set-up and demo are measured for README.md.
release-check: setup-dev
	$(PY) tools/release_check.py --python $(PYTHON) --with-tests

# Newest versions that the ranges of the components allow, tried in fresh environments.
constraints:
	tools/update_constraints.sh $(PYTHON)

clean:
	rm -rf .venv .venv-blender .venv-core demo-out
