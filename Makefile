# Everything on a fresh machine with nothing but make and Python >= 3.11; `make help` lists the targets.
# pip takes its index, proxy and certificates from the environment.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO_BAG := bags/tpose_torso_twist
DEMO := demo_output

# Nothing of a sourced ROS install or of another virtual environment may leak into this one. The ROS wheels re-execute
# Python once to find their libraries and mark that in the environment; with another environment's mark set they
# would not look, and with its libraries on the path they might load the wrong ones.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE VIRTUAL_ENV PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH
unexport ROS_LOCALHOST_ONLY ROS_STATIC_PEERS ROS_DISCOVERY_SERVER FASTRTPS_DEFAULT_PROFILES_FILE FASTDDS_DEFAULT_PROFILES_FILE
# Every node and test process would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE
ifdef LD_LIBRARY_PATH
export LD_LIBRARY_PATH := $(shell printf %s "$$LD_LIBRARY_PATH" | tr : '\n' | grep -v -e '/ros_[^/]*\.libs/*$$' -e '^/opt/ros/' | paste -s -d : -)
endif

# The graph stays on this machine, and two runs at the same time do not hear each other.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export ROS_DOMAIN_ID := $(shell echo $$(( $$(od -An -N2 -tu2 /dev/urandom) % 100 + 1 )))
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export MPLBACKEND := Agg
export PYTHONUNBUFFERED := 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all lint ros2-workspace bench docs clean

help: ## list the targets
	@sed -n 's/^\([a-z0-9-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

setup: $(STAMP) ## create .venv with everything in it

# The first Python that is new enough; `make PYTHON=/path/to/python3` chooses another.
$(STAMP): setup.py setup.cfg
	@python=; for candidate in $(or $(PYTHON),python3 python3.12 python3.13 python3.11 python3.14); do \
	  if $$candidate -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "make: no Python >= 3.11 found; install one, or say which: make PYTHON=/path/to/python3" >&2; exit 1; \
	fi; \
	if ! "$$python" -c 'import venv, ensurepip' 2>/dev/null; then \
	  echo "make: $$python has no venv module; on Debian or Ubuntu: apt install python3-venv" >&2; exit 1; \
	fi; \
	[ -x $(BIN)/python ] && $(BIN)/python -m pip --version >/dev/null 2>&1 || "$$python" -m venv --clear $(VENV)
	@echo "installing into $(VENV) (the first time it takes a minute or two, and 700 MB)"
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --editable '.[ros,viewer,test,bench]'
	@touch $@

demo: $(STAMP) ## play a shipped recording through the real graph; joint angles, a picture and a new recording
	@rm -rf $(DEMO) && mkdir $(DEMO)
	$(BIN)/body_tracking up --bag $(DEMO_BAG) --record $(DEMO)/recording --log-dir $(DEMO)/log
	$(BIN)/body_tracking show $(DEMO)/recording --truth $(DEMO_BAG) --output $(DEMO)/joint_angles.png
	@echo "recording: $(DEMO)/recording"

# The tests that compute, and lint, take what is left of the processors by those that start processes and mostly wait; the
# latter run several at a time, and one at a time where they state how soon something happens. All of it runs, whatever
# fails. The workspace for test/ros2 is made before, and does not count as time of the tests.
test: $(STAMP) ## formatting, lint, types and the tests, in five minutes
	@$(call tests,not slow)

test-all: export TEST_DRAWS = all
test-all: $(STAMP) ## the same with the longer draws and recordings, in half an hour
	@$(call tests,slow or not slow)

define tests
failed=; $(MAKE) --no-print-directory ros2-workspace || { failed=", the workspace of ros2"; export TEST_ROS2=failed; }; \
phase() { name="$$1"; shift; echo "== $$name"; $(BIN)/python -m pytest "$$@" || failed="$$failed, $$name"; }; \
nice -n 19 $(MAKE) --no-print-directory lint >$(VENV)/lint.txt 2>&1 & lint=$$!; \
nice -n 19 $(BIN)/python -m pytest -m "($(1)) and not processes" --numprocesses 2 --dist worksteal >$(VENV)/compute.txt 2>&1 & compute=$$!; \
phase "tests of processes" -m "($(1)) and processes and not alone" --numprocesses 3 --dist loadscope; \
phase "tests of time" -m "($(1)) and processes and alone"; \
echo "== tests that compute"; wait $$compute || failed="$$failed, tests that compute"; cat $(VENV)/compute.txt; \
echo "== formatting, lint, types"; wait $$lint || failed="$$failed, formatting, lint, types"; cat $(VENV)/lint.txt; \
[ -z "$$failed" ] || { echo "make: failed:$${failed#,}" >&2; exit 1; }
endef

lint: $(STAMP) ## formatting, lint and types
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy

# Two minutes the first time; a step of its own, since it would count as time of the tests that need it.
ros2-workspace: ## the real ros2 for test/ros2, where its sources are present
	@test/ros2/workspace || [ $$? = 77 ]

bench: $(STAMP) ## every benchmark, one after the other; fails at the end where one missed its bar (two hours)
	@data=$${BODY_TRACKING_DATA:-../shared/data}; missed=; \
	run() { echo; echo "== $$*"; $(BIN)/python "$$@" || missed="$$missed $$1"; }; \
	with() { folder=$$1; shift; if [ -d "$$data/$$folder" ]; then run "$$@"; \
	  else echo; echo "== $$1 is left out: no $$data/$$folder (BODY_TRACKING_DATA names the folder of real recordings)"; fi; }; \
	run benchmarks/latency.py; \
	run benchmarks/four_sensors.py; \
	run benchmarks/soak.py --minutes 10; \
	echo; echo "== benchmarks/two_hosts.py"; $(BIN)/python benchmarks/two_hosts.py || [ $$? = 77 ] || missed="$$missed benchmarks/two_hosts.py"; \
	if command -v chromium >/dev/null; then run benchmarks/viewer.py; \
	else echo; echo "== benchmarks/viewer.py is left out: no chromium"; fi; \
	run benchmarks/thesis.py; \
	run benchmarks/honesty.py --runs 40; \
	run benchmarks/robustness.py --runs 100; \
	run benchmarks/ablation.py --seeds 1 --layouts 2,4; \
	with kinect_pairs benchmarks/real_pairs.py; \
	with kinect_pairs benchmarks/real_people.py; \
	with kinect_pairs benchmarks/simulated_pairs.py; \
	with plug_in_gait benchmarks/plug_in_gait.py; \
	with imu benchmarks/imu_pendulum.py; \
	with imu benchmarks/imu_recordings.py; \
	run benchmarks/calibrate_simulator.py; \
	run benchmarks/imu_and_camera.py --seeds 1; \
	run benchmarks/imu_live.py; \
	run benchmarks/imu_only.py --motions reaching,punching; \
	run benchmarks/imu_faults.py --seeds 1; \
	run benchmarks/accuracy.py --seeds 2 --layout-seeds 1 --sensitivity-seeds 1; \
	with kinect_vs_vicon benchmarks/kinect_vs_vicon.py; \
	if $(BIN)/python -c 'import biorbd, opensim' 2>/dev/null; then run benchmarks/estimators.py; \
	else echo; echo "== benchmarks/estimators.py is left out: its peers come with: $(BIN)/pip install -e '.[peers]'"; fi; \
	[ -z "$$missed" ] || { echo; echo "make bench: missed:$$missed" >&2; exit 1; }

docs: $(STAMP) ## rewrite what the code defines: tables of README.md, config/
	$(BIN)/python docs/update.py

clean: ## remove everything that make and colcon made
	rm -rf $(VENV) $(DEMO) .ros2_workspace build install log dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
