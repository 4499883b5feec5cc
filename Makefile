# quadid: every command that a developer or CI runs. `make` lists them.
# Needs Python >= 3.11, make, cmake and a C/C++ compiler; everything else goes into .venv.

VENV := .venv
BIN := $(VENV)/bin
# A Python that the ROS wheels know (to 3.13), else any that is new enough; `make PYTHON=/path/to/python` overrides.
try_python = for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= $(1))' 2>/dev/null && echo $$p && break; done
PYTHON ?= $(or $(shell $(call try_python,(3, 13))),$(shell $(call try_python,(3, 99))))
INSTALL := @tools/waiting.sh "Installing into $(VENV)" $(BIN)/python -m pip --disable-pip-version-check --quiet install

# What is installed, one stamp a step; a step runs again only when what it reads has changed.
RUNTIME := $(VENV)/.stamp-runtime
DEV := $(VENV)/.stamp-dev
ROS := $(VENV)/.stamp-ros
# Changes only when a wheel does, so that the messages are not rebuilt for nothing.
ROS_VERSIONS := $(VENV)/.ros-versions
MESSAGES := $(VENV)/.stamp-messages

export PIP_NO_INPUT := 1

.DEFAULT_GOAL := help
.PHONY: help
help: ## list the targets
	@grep -hE '^[a-z][a-z-]*:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

# --- the environment

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "No Python >= 3.11 with its venv module found: install one (Debian: python3-venv), or say make PYTHON=..." >&2; exit 1; }
	@tools/waiting.sh "Making $(VENV)" $(PYTHON) -m venv $(VENV)

$(RUNTIME): pyproject.toml | $(BIN)/python
	$(INSTALL) --no-compile --editable .
	@echo "Compiling the simulation for this processor: under a minute ..."
	$(BIN)/quadid warmup
	@touch $@

$(DEV): pyproject.toml $(RUNTIME)
	$(INSTALL) --editable ".[dev]"
	@touch $@

# These wheels make every start of this Python re-execute itself; beside `dev`, they come after it.
$(ROS): pyproject.toml $(RUNTIME) | $(if $(filter messages,$(MAKECMDGOALS)),,$(DEV))
	$(INSTALL) --editable ".[ros]"
	@$(BIN)/python -m pip freeze | grep -i '^ros-' >$@.new; cmp -s $@.new $(ROS_VERSIONS) || cp $@.new $(ROS_VERSIONS); rm $@.new
	@touch $@

$(ROS_VERSIONS): $(ROS)
	@:

$(MESSAGES): $(ROS_VERSIONS) tools/build_messages.sh tools/wheel_targets.cmake msgs/CMakeLists.txt msgs/package.xml $(wildcard msgs/msg/*.msg msgs/srv/*.srv tests/ros/bond/*/*)
	tools/build_messages.sh $(VENV) msgs tests/ros/bond
	@touch $@

.PHONY: venv dev messages node
node: ## the node alone: NumPy 1.26 as beside ROS 2 Jazzy, no plots, Dask or pyarrow; it must identify a played flight
	rm -rf build/node
	tools/node_alone.sh build/node $(PYTHON)

.PHONY: wheel
wheel: $(DEV) ## a wheel in dist/, installed alone into build/wheel, where it must identify a simulated flight
	rm -rf build/wheel dist/quadid-*.whl
	$(BIN)/python -m hatchling build --target wheel --directory dist
	$(PYTHON) -m venv build/wheel
	@tools/waiting.sh "Installing into build/wheel" build/wheel/bin/pip --quiet install dist/quadid-*.whl
	cd build/wheel && bin/quadid simulate flight.mcap --seconds 20 && bin/quadid identify flight.mcap --vehicle pelican

venv: $(RUNTIME) ## .venv with the quadid command
dev: $(DEV) ## ... and what developers use: linters, types, tests
messages: $(MESSAGES) ## .venv with the quadid command, ROS 2 Jazzy and quadid_msgs, without what developers use

# --- use

.PHONY: demo
demo: venv ## fly, identify and diagnose three flights, write the report
	$(BIN)/quadid demo --out demo-out

.PHONY: reproduce
reproduce: venv ## the paper's tables and figures, into docs/results
	$(BIN)/quadid reproduce --out reproduce-out
	mkdir -p docs/results/paper
	cp reproduce-out/paper.md docs/results/
	cp reproduce-out/paper/*.png docs/results/paper/

# --- studies: figures of docs/results; QUADID_DATA says where the recorded flights are

STUDY = OPENBLAS_NUM_THREADS=1 $(BIN)/python -m

.PHONY: findings mpc gains alarms autopilot peers health health-hours truth filter-error bands cases campaign ablation foreign paper-scale excite optimisers subspace control kernel-speed bench
truth: venv ## errors against their bound, coverage, bias with noise, status (an hour)
	$(STUDY) quadid_evaluation.studies.truth --out docs/results

filter-error: venv ## the estimator: coverage, guesses, recorded vehicles, a fast loop, hidden lag, speed (an hour)
	$(STUDY) quadid_evaluation.studies.filter_error --out docs/results

bands: venv ## coverage of predicted bands on recorded flights that were not fitted (ten minutes)
	$(STUDY) quadid_evaluation.studies.foreign --bands --out docs/results

cases: venv ## the independent simulated cases, diagnosed
	$(STUDY) quadid_evaluation.studies.campaign --groups cases:12,cases_hub:12

foreign: venv ## vehicles and logs of others: truth, answers, predictions beside regression (half an hour)
	$(STUDY) quadid_evaluation.studies.foreign --out docs/results

DATA ?= $(or $(QUADID_DATA),../shared/data)
findings: venv ## every input on which the product failed once: answers now, right or wrong (ten minutes; DATA=DIR)
	$(STUDY) quadid_evaluation.studies.findings --data $(DATA)

.PHONY: judging
judging: venv ## one mistake at a time on right logs of many vehicles: the first line that each is answered with (5 min)
	$(STUDY) quadid_evaluation.studies.judging --data $(DATA)

peers: dev ## other programs beside ours on the same data (mujoco.sysid, sysid.tools' recipe, Kalman filters; hours)
	$(STUDY) quadid_evaluation.studies.peers --out docs/results
autopilot: venv ## ArduCopter's and others' flights through the online session, replayed and live in real time (half an hour)
	$(STUDY) quadid_evaluation.studies.autopilot --out docs/results
	$(STUDY) quadid_evaluation.studies.autopilot --live --out docs/results

mpc: dev ## a predictive controller with guesses and with the identified file, on a fast circle (two minutes)
	$(BIN)/python examples/casadi_mpc.py

gains: venv ## proposed gains, flown by each autopilot's own law around the truth, beside their promise (five minutes)
	$(STUDY) quadid_evaluation.studies.gains --out docs/results

alarms: venv ## false alarms on healthy flights in wind, payloads and weak rotors named (half an hour)
	$(STUDY) quadid_evaluation.studies.alarms --out docs/results

campaign: venv ## blinded campaign of hidden effects (hours)
	$(STUDY) quadid_evaluation.studies.campaign --out docs/results

ablation: venv ## the diagnosis without each rule and number, with half and twice each number (hours; goes on where it stopped)
	$(STUDY) quadid_evaluation.studies.ablation --records ablation.jsonl --out docs/results

health-hours: venv ## online rotor health: alarms in 100 h of healthy hover, seconds to name a loss (accelerated)
	$(STUDY) quadid_evaluation.studies.health.hours --out docs/results

health: venv ## damaged and loaded Crazyflies, recorded; hidden damage, simulated; what their spread allows
	$(STUDY) quadid_evaluation.studies.health --out docs/results

paper-scale: dev ## three 500 s sets: error, time and memory of the fit
	$(STUDY) quadid_evaluation.benchmarks.speed --parts identification memory

excite: venv ## intervals that a proposed manoeuvre promises and obtains
	$(STUDY) quadid_evaluation.studies.excite --out docs/results

optimisers: venv ## every optimiser on smooth and non-smooth problems, narrow and wide bounds (half an hour)
	$(STUDY) quadid_evaluation.studies.optimisers --out docs/results

subspace: venv ## CVA and MOESP: poles of known systems, prediction of flights
	$(STUDY) quadid_evaluation.studies.subspace --out docs/results

control: venv ## tracking in wind and gusts with guessed, identified, extended and true parameters (ten minutes)
	$(STUDY) quadid_evaluation.studies.control --out docs/results

kernel-speed: dev ## nanoseconds per particle and step of the kernel; a step of `quadid.Simulator`, RotorPy, crazyflow, gym-pybullet-drones
	SCIPY_ARRAY_API=1 $(STUDY) quadid_evaluation.benchmarks.speed --parts kernel step

bench: dev ## every speed beside its peers, in one run: docs/results/speed.md (half an hour on an idle machine)
	$(STUDY) quadid_evaluation.benchmarks.speed --out docs/results

# --- check

# One process a group of files, in the order of tests/conftest.py: long ones first.
XDIST := --dist loadgroup --no-loadscope-reorder
# Four workers for two cores: tests of the service wait for processes and clocks. Kernels are compiled once before.
.PHONY: test pytest test-browser test-slow lint typecheck format
test: $(MESSAGES) ## lint, types, and all tests but the slow and the browser's
	+$(MAKE) --no-print-directory -j 3 lint typecheck pytest

pytest: $(MESSAGES)
	$(BIN)/quadid warmup
	MAKEFLAGS= $(BIN)/pytest -n 4 $(XDIST) -m "not browser and not slow"

.PHONY: pictures
pictures: test-browser ## reports as pictures at several widths, dark and light, in browser-out/, to be looked at

test-browser: $(DEV) ## the report in headless Chromium (Debian: apt-get install chromium); screenshots in browser-out/
	$(BIN)/pytest -m browser tests/browser

.PHONY: faults
faults: $(MESSAGES) ## every fault of the list, and what happened, into docs/results/faults.md
	rm -f docs/results/faults.json
	$(BIN)/pytest -n 2 $(XDIST) -m "not browser" --faults-page docs/results/faults.md tests

.PHONY: poisoning
poisoning: venv ## every sensor wrong by a factor, at once or slowly: what is published, into docs/results/poisoning.md (half an hour)
	$(STUDY) quadid_evaluation.studies.poisoning --fresh --out docs/results

.PHONY: fuzz
fuzz: $(DEV) ## mutated logs of seven formats through their readers for an hour; goes on where it stopped, into docs/results/fuzz.md
	OPENBLAS_NUM_THREADS=1 nice -n 19 $(BIN)/python -m tests.fuzz

.PHONY: ros-load
ros-load: $(MESSAGES) ## the ROS node at load 10: backlog and errors with the streams of three presets (half an hour; MINUTES=10)
	$(STUDY) quadid_evaluation.studies.ros_load --minutes $(or $(MINUTES),10) --out docs/results

.PHONY: soak
soak: $(MESSAGES) ## a day of flight at accelerated time, an hour in real time, into docs/results/soak.md (hours)
	$(STUDY) quadid_evaluation.studies.soak --out docs/results

.PHONY: chaos
chaos: $(MESSAGES) ## random faults at the running service for 20 min, into docs/results/chaos.md
	$(STUDY) quadid_evaluation.studies.chaos --minutes 20 --out docs/results

# Allows a reader less memory than coverage itself needs in it.
TOO_NARROW := tests/replay/test_reading.py::test_more_memory_than_allowed_is_refused
# What holds quadid/: the node's tests are waited for by clocks, and bring little to it.
COVERED_BY := $(filter-out tests/node tests/ros tests/fuzz tests/browser tests/packaging tests/examples tests/documents,$(patsubst %/,%,$(wildcard tests/*/)))

.PHONY: coverage mutation audit sbom pins
coverage: $(MESSAGES) ## lines and branches of quadid/ that the tests run, into docs/results/coverage.md (10 min)
	$(BIN)/coverage erase
	$(BIN)/coverage run -m pytest -q -n 2 $(XDIST) -m "not browser and not slow" \
		--deselect $(TOO_NARROW) $(COVERED_BY)
	$(BIN)/coverage combine --quiet
	$(STUDY) quadid_evaluation.studies.coverage --out docs/results

QUALITY := $(VENV)/.stamp-quality
$(QUALITY): pyproject.toml $(DEV)
	$(INSTALL) --editable ".[quality]"
	@touch $@

mutation: $(MESSAGES) $(QUALITY) ## gate, ledger and session spoilt line by line: which tests notice? into docs/results/mutation.md (40 min)
	OPENBLAS_NUM_THREADS=1 $(BIN)/mutmut run --max-children 2
	$(STUDY) quadid_evaluation.studies.mutation --out docs/results

audit: $(QUALITY) ## known holes in what the container installs; fails where the advisories cannot be reached
	$(BIN)/pip-audit --requirement docker/requirements.txt --strict --require-hashes --disable-pip \
		--progress-spinner off --timeout 20

sbom: venv ## NOTICE with the licences of what is installed with quadid, and dist/sbom.json (CycloneDX)
	mkdir -p dist
	$(BIN)/python tools/sbom.py dist
	cp dist/NOTICE NOTICE

pins: $(QUALITY) ## exact versions with hashes of what the container installs, into docker/requirements.txt
	$(BIN)/uv pip compile --quiet --no-config --upgrade --generate-hashes --python-version 3.12 \
		--python-platform x86_64-unknown-linux-gnu --no-emit-index-url --no-emit-find-links \
		--custom-compile-command "make pins" --output-file docker/requirements.txt quadid_node/requirements.txt docker/build.in

test-slow: $(MESSAGES) ## the tests that take minutes each
	$(BIN)/pytest -m slow

lint: $(DEV) ## style, format, which room may import which, shell, container
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/shellcheck .ci/run $(wildcard tools/*.sh docker/*.sh)
	$(BIN)/hadolint --config docker/hadolint.yaml docker/Dockerfile
	$(BIN)/check-jsonschema --quiet --builtin-schema vendor.compose-spec docker/compose.yaml

typecheck: $(DEV) ## mypy --strict
	$(BIN)/mypy

.PHONY: house
house: venv ## lines, named numbers and files that data cross; fails where a figure rose (WHY='...' records it with the reason)
	$(STUDY) quadid_evaluation.studies.house $(if $(WHY),--record '$(WHY)')

format: $(DEV) ## let ruff put files into the common form
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# --- documentation

DOCS := $(VENV)/.stamp-docs
$(DOCS): pyproject.toml $(RUNTIME)
	$(INSTALL) --editable ".[docs]"
	@touch $@

.PHONY: docs
docs: $(DOCS) ## the documentation as pages in site/, every link checked
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "Written: $(CURDIR)/site/index.html"

# --- tidy

.PHONY: clean
clean: ## remove the environment, caches and what commands wrote
	rm -rf $(VENV) build install log dist site .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache demo-out reproduce-out mutants
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
