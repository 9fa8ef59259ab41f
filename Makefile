# Everything a user or a developer does, in one place. Each target sets the project up first, once.
# make train ARCH=cnn_lstm PRESET=auto STEPS=... SEED=0 RUN=name ARGS="--env.scene.num-rocks 8"

PYTHON ?= python3
VENV ?= .venv
ARCH ?= cnn_lstm
PRESET ?= auto
SEED ?= 0
STEPS ?=
RUN ?=
ARGS ?=
EPISODES ?= 1000
WORKERS ?= 2
BENCH_DIR ?= docs/benchmarks
GPU_PRESET ?= gpu
GPU_BATCH ?= 4096
GPU_FRAMES ?= 64 512
GPU_TRACE ?= trace_gpu
NOTEBOOKS ?= quickstart bearings curves downsampling failures learning_curves trajectories

$(foreach name,arch preset seed steps run args episodes policy,$(if $(findstring command line,$(origin $(name))),\
  $(error $(name)=$($(name)): should be written in capitals)))

BIN := $(VENV)/bin
READY := $(VENV)/.ready
EXTRAS_READY := $(VENV)/.extras-ready
export JAX_PLATFORMS ?=
ifeq ($(JAX_PLATFORMS),)
unexport JAX_PLATFORMS
endif

.DEFAULT_GOAL := help
.PHONY: help setup extras sb3 train eval baselines demo sweep bench bench-gpu table test test-fast test-docs check format docs docs-serve notebooks lock clean

help: ## this list
	@echo "usage: make TARGET [ARCH=cnn_lstm|cnn|cnn_lstm_raw|mlp|mlp_rocks] [PRESET=auto|cpu|gpu|paper|smoke] [STEPS=] [SEED=] [RUN=] [ARGS=]"
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z0-9-]+):.*## (.*)/  \1\t\2/' | expand -t 14

setup: $(READY) ## create .venv from the pinned lock (every other target does it by itself)

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "segvisrl_jax needs Python 3.11 or newer; set PYTHON=/path/to/python3.11"; exit 2; }
	@echo "Setting up $(VENV) from requirements.lock (once)"
	@test ! -e $(VENV) || test -f $(VENV)/pyvenv.cfg || { echo "$(VENV) is there and is no virtual environment; set VENV=folder"; exit 2; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); \
	  echo "$(PYTHON) cannot make virtual environments (on Debian and Ubuntu: apt install python3-venv); see docs/troubleshooting.md"; exit 2; }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

extras: $(EXTRAS_READY) ## add what view, warp, sweeps on Ray, notebooks, docs, mlflow and wandb need to .venv (0.9 GB); their tests run from then on

$(EXTRAS_READY): requirements-extras.lock $(READY)
	@echo "Adding the extras to $(VENV) from requirements-extras.lock (once)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-extras.lock
	@touch $@

sb3: $(READY) ## add Stable-Baselines3 and PyTorch (0.9 GB for a CPU; PyPI's own build for Linux brings CUDA, several GB) to .venv; its tests run from then on
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check torch==2.13.0 stable-baselines3==2.9.2 sb3-contrib==2.9.2

train: $(READY) ## train ARCH with PRESET, evaluate it, write runs/<name>/
	@$(BIN)/segvisrl train $(if $(and $(RUN),$(findstring --resume,$(ARGS))),,--arch $(ARCH) --preset $(PRESET) --seed $(SEED)) $(if $(STEPS),--steps $(STEPS)) $(if $(RUN),--run $(RUN)) $(ARGS)

eval: $(READY) ## drive EPISODES held-out scenes with runs/RUN, or POLICY=name
	@$(BIN)/segvisrl eval $(if $(POLICY),--policy $(POLICY),--run $(if $(wildcard $(RUN)),$(RUN),runs/$(RUN))) --episodes $(EPISODES) --seed $(SEED) $(ARGS)

baselines: $(READY) ## the P controller and the random one on 10,000 scenes
	@$(BIN)/segvisrl eval --controller p --episodes 10000 --seed $(SEED) $(ARGS)
	@$(BIN)/segvisrl eval --controller random --episodes 10000 --seed $(SEED) $(ARGS)

bench-gpu: $(READY) ## measure all parts with the gpu preset, in less than ten minutes: BENCH_DIR/*_gpu.json; a trace in GPU_TRACE
	@$(BIN)/segvisrl bench physics --engines mjx --batch $(GPU_BATCH) --repeats 3 --json $(BENCH_DIR)/physics_gpu.json $(ARGS)
	@$(BIN)/segvisrl bench render --renderers scanline --batches $(GPU_FRAMES) --repeats 3 --json $(BENCH_DIR)/render_gpu.json $(ARGS)
	@$(BIN)/segvisrl bench policy update --preset $(GPU_PRESET) --repeats 3 --json $(BENCH_DIR)/update_gpu.json $(ARGS)
	@$(BIN)/segvisrl bench train --preset $(GPU_PRESET) --repeats 3 --json $(BENCH_DIR)/train_gpu.json $(ARGS)
	@$(BIN)/segvisrl bench profile --preset $(GPU_PRESET) --repeats 3 --trace $(GPU_TRACE) --json $(BENCH_DIR)/profile_gpu.json $(ARGS)

table: $(READY) ## the evaluations in docs/results side by side: docs/results_table.md
	@$(BIN)/segvisrl table docs/results --output docs/results_table.md $(ARGS)

demo: $(READY) ## a trained policy drives one scene: demo.mp4
	@$(BIN)/segvisrl demo $(ARGS)

sweep: $(READY) ## train over scales, architectures and seeds: a table and a plot
	@$(BIN)/segvisrl sweep $(ARGS)

bench: $(READY) ## measure physics, rendering and learning on this machine
	@$(BIN)/segvisrl bench $(ARGS)

test: $(READY) ## the whole suite, on the CPU, in WORKERS processes
	@JAX_PLATFORMS=cpu $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-fast: $(READY) ## the edit loop: everything but the slow tests
	@JAX_PLATFORMS=cpu $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "not slow" $(ARGS)

test-docs: $(EXTRAS_READY) ## run every command of the README and the documentation, at a tiny size (an hour and a half)
	@JAX_PLATFORMS=cpu $(BIN)/python -m pytest -q -n $(WORKERS) tests/docs_commands.py $(ARGS)

check: $(READY) ## format, lint, types, fast tests (TESTED=1: without the tests)
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(if $(TESTED),,JAX_PLATFORMS=cpu $(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile -m "not slow")

format: $(READY) ## rewrite the code in the project's format
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

docs: $(EXTRAS_READY) ## build the documentation site: site/index.html
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo site/index.html

docs-serve: $(EXTRAS_READY) ## show the documentation site on http://127.0.0.1:8000, and follow changes
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

notebooks: $(EXTRAS_READY) ## run NOTEBOOKS of experiments/ and write them with their outputs: notebooks/*.ipynb
	@mkdir -p notebooks
	@for name in $(NOTEBOOKS); do \
	  $(BIN)/jupytext --quiet --to ipynb --set-kernel python3 --execute --run-path . --output notebooks/$$name.ipynb experiments/$$name.py && \
	  echo notebooks/$$name.ipynb || exit 1; done

RESOLVE := uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate --no-header

lock: $(READY) ## resolve pyproject.toml anew into the two locks (needs uv on the path)
	$(RESOLVE) --upgrade --extra dev --extra warp --extra view --extra ray --extra notebooks --extra docs --extra mlflow --extra wandb pyproject.toml -o requirements-extras.lock
	$(RESOLVE) --extra dev --constraints requirements-extras.lock pyproject.toml -o requirements.lock

clean: ## remove the environment and caches; runs stay
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist site notebooks *.egg-info
