# Run `make` to list the targets. All targets use .venv, built from pinned constraints.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
BUDGET ?= full
SEEDS ?= 1
PART ?= all
FRESH ?=
PEERS := .venv-peers
WHEEL := .venv-wheel
# A small training: 16 s of processor time, most of them for the threshold of the alarm; ignore the scores. (What
# needs it, wheel-check, takes minutes: it installs the wheel with all that it requires.)
SMOKE := experiment=features simulator=naive data.gestures=400 device.test_gestures=200 evaluation.devices=0 evaluation.layouts=0
# Marked tests to run. Empty: all.
MARK ?= not slow
TEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist worksteal -rs $(if $(MARK),-m "$(MARK)")
# Settings that change floating-point rounding; the first is the default of the test suite.
ROUNDINGS := OMP_NUM_THREADS=1 OMP_NUM_THREADS=2 MKL_CBWR=COMPATIBLE MKL_CBWR=AVX2 \
	ATEN_CPU_CAPABILITY=default OPENBLAS_CORETYPE=Haswell
NUMERICAL := $(addprefix tests/,body design evaluation wire/test_segmentation.py wire/test_tare.py calibration record/test_session.py \
	learning mechanics studies/test_embeddings.py touch laws \
	$(addprefix device/test_,calibration.py imperfection.py resampling.py)) experiments/laws

# Hundreds of tests start a command of this project; without bytecode each of them would compile the modules again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install test roundings slow cluster check bench physics peers demo ui reproduce-table results wheel-check docs notice clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 18

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[dev,parallel,embeddings,docs,export,data,server,mujoco,robot]"
	touch $@

install: $(READY)  ## create .venv; run by the other targets if needed

test: $(READY)  ## run the tests that are not slow, in 15 minutes; MARK=slow: the others, MARK=: all
	$(TEST)

roundings: $(READY)  ## run the numerical tests (TESTS=tests: all) under several rounding settings
	@failed=; for setting in $(ROUNDINGS); do \
		echo "== $$setting"; env $$setting $(TEST) $(or $(TESTS),$(NUMERICAL)) || failed="$$failed $$setting"; \
	done; test -z "$$failed" || { echo "failed under$$failed"; exit 1; }

slow: $(PEERS)/.ready  ## run all tests under these settings, with the baseline libraries, a cluster and the documentation
	DAMAGED=500 $(MAKE) roundings TESTS="tests experiments/laws" MARK=
	$(MAKE) cluster
	$(MAKE) docs

cluster: $(READY)  ## check a job array with killed processes on real SLURM and PostgreSQL, where they are installed
	experiments/cluster/check.sh

check: $(READY)  ## check lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY)  ## measure speed and memory; write results/bench.json (BENCH="--only wire")
	$(BIN)/python -m experiments.benchmarks $(BENCH)

physics: $(READY)  ## check the laws of mechanics against independent solutions, write docs/physics.md (PHYSICS="-k hertz": some, write nothing)
	$(BIN)/python -m pytest experiments/laws --full --junitxml=results/physics.xml $(or $(PHYSICS),--page=docs)

$(PEERS)/.ready: experiments/peers/requirements.txt experiments/peers/constraints.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --upgrade pip
	$(PEERS)/bin/python -m pip install --constraint experiments/peers/constraints.txt \
		--requirement experiments/peers/requirements.txt
	touch $@

peers: $(READY) $(PEERS)/.ready  ## train aeon's ROCKETs with their defaults (SEEDS=3)
	$(BIN)/skin train --config-dir experiments/peers/conf -m 'seed=range($(SEEDS))' \
		experiment=minirocket,multirocket_hydra

demo: $(READY)  ## show the predictions of a pretrained model for an emulated skin on 127.0.0.1:8765; Ctrl-C stops
	@$(BIN)/skin live demo=true

ui: $(READY)  ## compare runs in the MLflow UI on 127.0.0.1:5000
	MLFLOW_DISABLE_TELEMETRY=true MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false $(BIN)/mlflow ui \
		--backend-store-uri sqlite:///mlflow.db --host 127.0.0.1 --port 5000 --workers 1

reproduce-table: $(READY)  ## train the models of the results table and print it (BUDGET=smoke, SEEDS=3, SIMULATORS=naive,fem,solid)
	$(BIN)/skin study study=table 'study.seeds=[$(shell seq -s , 0 $$(($(SEEDS) - 1)))]' \
		$(if $(filter smoke,$(BUDGET)),smoke=true) $(if $(SIMULATORS),'study.trainings.0.simulator=[$(SIMULATORS)]')

results: $(READY) $(if $(filter tuned,$(PART)),$(PEERS)/.ready)  ## publish all results in 6 h: PART=table 1.6 h, best_fresh 1.82 h, best_fresh_solid 1.05 h, sensors 0.15 h, any_skin 0.27 h, studies 0.46 h, design 0.48 h; not of all: tuned 0.85 h, gestures 0.3 h, networks 1.0 h, table_solid 1.1 h, devices 0.75 h, guarantee 2.0 h, graphs 1.9 h, other_skins 0.4 h, images 1.6 h (JOBS=2, FRESH=1)
	$(BIN)/skin results results.part=$(PART) $(if $(FRESH),tracking.uri=sqlite:///results/fresh.db tracking.artifacts=results/fresh) $(if $(JOBS),results.jobs=$(JOBS))

wheel-check: $(READY)  ## install the wheel in an empty environment; train and evaluate a small model and run the demo there
	rm -rf $(WHEEL) && mkdir -p $(WHEEL)/empty
	$(BIN)/python -m hatchling build --target wheel --directory $(WHEEL)/dist
	$(PYTHON) -m venv $(WHEEL)/env
	$(WHEEL)/env/bin/python -m pip install --quiet --constraint constraints.txt $(WHEEL)/dist/*.whl
	cd $(WHEEL)/empty && unset PYTHONPATH && ../env/bin/skin train $(SMOKE) && ../env/bin/skin evaluate run=latest && ../env/bin/skin live demo=true seconds=5 live.web_port=0
	rm -rf $(WHEEL)

docs: $(READY)  ## build the documentation site in site/, offline; run tutorials and gallery; warnings are errors
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going -b html docs site
	@echo "site/index.html"

notice: $(READY)  ## write NOTICE, the licences of dependencies, data and weights
	$(BIN)/python -m docs.notice

clean:  ## remove environments and caches; keep results and runs
	rm -rf $(VENV) $(PEERS) $(WHEEL) site docs/generated *.egg-info .pytest_cache .ruff_cache .mypy_cache outputs
