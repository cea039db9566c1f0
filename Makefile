# One-line fronts to the `twirl` command and the development tools; `make help` lists them.
# Every target first brings .venv up to date, so `make train TASK=biped` works on a fresh clone.

.DEFAULT_GOAL := help
TWIRL := .venv/bin/twirl
PYTEST := .venv/bin/pytest

# What these are given is data, of which neither make nor the shell runs a word. ARGS is shell.
GIVEN := TASK SHIFT SEED RUN GRID SOURCES MINUTES EXAMPLES WHEELS PYTHON ACCEL
$(foreach name,$(GIVEN),$(if $(value $(name)),$(eval override $(name) := $$(value $(name)))))
define NEWLINE


endef
quoted = '$(subst $(NEWLINE), ,$(subst ','\'',$(1)))'
option = $(if $($(2)),--$(1) $(call quoted,$($(2))))
RUNS = $(foreach run,$(RUN),$(call quoted,$(run)))
CASE = $(call option,task,TASK) $(call option,shift,SHIFT) $(call option,seed,SEED)

.PHONY: help setup bench-setup gpu-setup lint format test test-slow test-gpu test-jax-oldest \
	test-faults fuzz audit \
	gpu-counts gpu-proof train evaluate collect sweep figures report render view export runs \
	demo bench curriculum web docs dist clean

help: ## show this table
	@echo 'usage: make TARGET [TASK=..] [SHIFT=..] [SEED=..] [RUN=..] [GRID=..] [ARGS=".."]'
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo 'ARGS is a piece of a shell command: make train TASK=biped ARGS="--preset debug"'
	@echo 'All options of a command: .venv/bin/twirl COMMAND --help'

setup: ## make or refresh .venv (PYTHON=/path/to/python3.12, ACCEL=cpu|cuda12|cuda13|tpu)
	@.ci/setup

bench-setup: setup ## make or refresh .venv-bench, the environment of the SBX comparison
	@.ci/setup bench

gpu-setup: ## make or refresh .venv-gpu, jax for CUDA, with or without a GPU (WHEELS=folder: no network)
	@.ci/setup gpu

lint: setup ## ruff check, ruff format --check, pyright
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/pyright

format: setup ## rewrite the code with ruff
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

test: setup ## the default tests, on the CPU, a worker per core (ARGS="tests/droq -x")
	$(PYTEST) --numprocesses auto --dist worksteal $(ARGS)

test-slow: setup ## the learning curves and other long tests
	$(PYTEST) -m "slow and not gpu" $(ARGS)

test-gpu: gpu-setup ## the tests that need a GPU
	JAX_PLATFORMS=cuda,cpu TWIRL_TEST_PLATFORMS=cuda,cpu .venv-gpu/bin/pytest -m gpu $(ARGS)

test-jax-oldest: ## a part of the tests with the oldest jax that is allowed
	@.ci/setup oldest
	.venv-oldest/bin/pytest $(if $(ARGS),$(ARGS),tests/droq tests/replay tests/sim tests/tasks/test_vector.py tests/training)

gpu-counts: gpu-setup ## count GPU operations per update, without a GPU
	JAX_PLATFORMS=cpu .venv-gpu/bin/twirl bench gpu-compile $(ARGS)

gpu-proof: ## parity, timings and a real training on a GPU (MINUTES=9 WHEELS=folder: no network)
	@MINUTES=$(call quoted,$(or $(MINUTES),9)) WHEELS=$(call quoted,$(WHEELS)) .ci/gpu-proof $(ARGS)

test-faults: setup ## the break campaign: kills, full disks, damage, power cuts (under 30 minutes)
	$(PYTEST) -m "not gpu" tests/faults $(ARGS)

fuzz: setup ## the readers of files, fed by hypothesis for some ten minutes (EXAMPLES=4000)
	TWIRL_FUZZ=$(call quoted,$(or $(EXAMPLES),4000)) $(PYTEST) -m slow tests/faults/campaign/test_fuzz.py $(ARGS)

audit: ## look for known weaknesses of the locked packages (does nothing without a network)
	@.ci/setup audit
	@.ci/audit

train: setup ## train TASK= under SHIFT= with SEED= (ARGS="--preset debug --variant scratch")
	$(TWIRL) train $(CASE) $(ARGS)

evaluate: setup ## evaluate RUN=runs/NAME (several may be given; ARGS="--shifts icy")
	$(TWIRL) evaluate $(RUNS) $(ARGS)

collect: setup ## record a source policy in TASK= as a dataset
	$(TWIRL) collect $(CASE) $(ARGS)

sweep: setup ## run what is missing of GRID= (a module of experiments/)
	$(TWIRL) sweep $(if $(GRID),$(call quoted,$(GRID))) $(ARGS)

figures: setup ## rebuild all figures from the committed tables
	$(TWIRL) figures $(ARGS)

report: setup ## write the results as one HTML page
	$(TWIRL) report $(ARGS)

render: setup ## film RUN=runs/NAME as mp4 and a strip of frames
	$(TWIRL) render $(RUNS) $(ARGS)

view: setup ## watch RUN= (or the shipped biped) in a browser (ARGS="--html replay.html")
	$(TWIRL) view $(RUNS) $(ARGS)

export: setup ## write RUN= as an ONNX file, with a contract that says how it meets its robot
	$(TWIRL) export $(RUNS) $(ARGS)

runs: setup ## list runs (ARGS="compare A B", "show A", "prune")
	$(TWIRL) runs $(ARGS)

demo: setup ## render and evaluate the shipped policies; trains nothing
	$(TWIRL) demo $(ARGS)

web: setup ## build a page that simulates in the browser into build/web (needs npm)
	npm install --prefix build/npm --no-save --no-package-lock --silent @mujoco/mujoco@3.14.0
	.venv/bin/python -m twirl_mjx.view.web build/npm/node_modules/@mujoco/mujoco build/web
	@echo 'serve it: .venv/bin/python -m http.server -d build/web, then http://localhost:8000/'

bench: bench-setup ## measure this machine, beside SBX
	$(TWIRL) bench $(ARGS)

curriculum: setup ## train the chain of TASK= with SEED=; SOURCES="a b": let these compete instead
	$(TWIRL) curriculum $(call option,task,TASK) $(call option,seed,SEED) \
	  $(if $(SOURCES),--sources $(foreach each,$(SOURCES),$(call quoted,$(each)))) $(ARGS)

docs: ## build the pages and the API reference into build/site
	@.ci/setup docs
	.venv-docs/bin/python .ci/docs.py build/pages
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --strict -q -f .ci/mkdocs.yml
	@echo 'open build/site/index.html'

dist: setup ## build wheel and sdist into dist/, and try the wheel in an environment of its own
	rm -rf dist
	.venv/bin/python -m hatchling build -d dist
	$(PYTEST) -m slow tests/test_dist.py

clean: ## remove caches and build products (keeps .venv and runs/)
	rm -rf build dist .pytest_cache .ruff_cache
	find . -path ./.venv -prune -o -path ./.venv-bench -prune -o -path ./.venv-docs -prune \
		-o -path ./.venv-audit -prune -o -path ./runs -prune -o \
		-name __pycache__ -type d -prune -exec rm -rf {} +
