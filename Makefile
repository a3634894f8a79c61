# Everything on a fresh machine with nothing but make and Python >= 3.11; `make help` lists the targets.
# pip takes its index, proxy and certificates from the environment.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO_BAG := bags/tpose_torso_twist
DEMO := demo_output
MARKERS_BAG := bags/markers_arm
DEMO_MARKERS := demo_markers_output
MESH_BAG := bags/mesh_reaching
DEMO_MESH := demo_mesh_output
SITE_VENV := .site_venv
CAMERA_BAG := bags/camera_reaching
DEMO_CAMERA := demo_camera_output
DEMO_IMUS := demo_imus_output

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
.PHONY: help setup demo demo-markers demo-mesh demo-camera demo-imus test test-all test-ros2 lint ros2-workspace bench docs site clean

help: ## list the targets
	@sed -n 's/^\([a-z0-9-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

setup: $(STAMP) ## create .venv with everything in it
	@echo "ready: . $(BIN)/activate, then body_tracking says what to do next"

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
	@echo "installing into $(VENV) (the first time it takes two or three minutes, and 1.6 GB)"
	@$(BIN)/python scripts/pip_install.py $(VENV)/pip.log --editable '.[ros,viewer,camera,test,bench]'
	@$(BIN)/body_tracking compile
	@$(BIN)/body_tracking camera model || echo "make: go on without it: cameras find nobody, and their tests are skipped" >&2
	@touch $@

demo: $(STAMP) ## play a shipped recording through the real graph; joint angles, a picture and a new recording
	@rm -rf $(DEMO) && mkdir $(DEMO)
	$(BIN)/body_tracking up --bag $(DEMO_BAG) --record $(DEMO)/recording --log-dir $(DEMO)/log
	$(BIN)/body_tracking show $(DEMO)/recording --truth $(DEMO_BAG) --output $(DEMO)/joint_angles.png
	@echo "recording: $(DEMO)/recording"
	@echo "next: . $(BIN)/activate, then body_tracking view"

demo-markers: $(STAMP) ## the same with images of infrared markers: from balls to joint angles, beside the truth
	@rm -rf $(DEMO_MARKERS) && mkdir $(DEMO_MARKERS)
	$(BIN)/body_tracking up --sensors none --bag $(MARKERS_BAG) --marker-setup config/marker_setup --record $(DEMO_MARKERS)/recording --log-dir $(DEMO_MARKERS)/log
	$(BIN)/body_tracking show $(DEMO_MARKERS)/recording --truth $(MARKERS_BAG) --output $(DEMO_MARKERS)/joint_angles.png
	@echo "recording: $(DEMO_MARKERS)/recording"

demo-mesh: $(STAMP) ## the same with depth images: from the mesh of a body to joint angles, and a picture of the mesh
	@rm -rf $(DEMO_MESH) && mkdir $(DEMO_MESH)
	$(BIN)/body_tracking mesh personalise $(MESH_BAG) -o $(DEMO_MESH)/person.yaml
	$(BIN)/body_tracking up --bag $(MESH_BAG) --depth kinect1 --person $(DEMO_MESH)/person.yaml --reliable --record $(DEMO_MESH)/recording --log-dir $(DEMO_MESH)/log
	$(BIN)/body_tracking show $(DEMO_MESH)/recording --truth $(MESH_BAG) --output $(DEMO_MESH)/joint_angles.png
	$(BIN)/body_tracking mesh show $(DEMO_MESH)/recording -o $(DEMO_MESH)/mesh.png
	@echo "recording: $(DEMO_MESH)/recording"

demo-camera: $(STAMP) ## the same with colour and depth images: from the people in them to joint angles
	@rm -rf $(DEMO_CAMERA) && mkdir $(DEMO_CAMERA)
	$(BIN)/body_tracking up --bag $(CAMERA_BAG) --camera camera1 --compressed colour --filter ekf --record $(DEMO_CAMERA)/recording --log-dir $(DEMO_CAMERA)/log
	$(BIN)/body_tracking show $(DEMO_CAMERA)/recording --truth $(CAMERA_BAG) --output $(DEMO_CAMERA)/joint_angles.png
	@echo "recording: $(DEMO_CAMERA)/recording"

demo-imus: $(STAMP) ## the same with inertial sensors on the left arm of a simulated person, beside two Kinects; offline
	@rm -rf $(DEMO_IMUS) && mkdir $(DEMO_IMUS)
	$(BIN)/body_tracking simulate -o $(DEMO_IMUS)/person --imus forearm_left,upper_arm_left
	$(BIN)/body_tracking replay $(DEMO_IMUS)/person -o $(DEMO_IMUS)/angles --filter ekf --convention isb --imus forearm_left:imu_forearm_left --imus upper_arm_left:imu_upper_arm_left
	$(BIN)/body_tracking show $(DEMO_IMUS)/angles --truth $(DEMO_IMUS)/person --output $(DEMO_IMUS)/joint_angles.png

# The tests that compute, and lint, take what is left of the processors by those that start processes. These wait more than
# they compute: four run at a time, and one at a time where they state how soon something happens (these first, since they
# leave most). All of it runs, whatever fails. What takes no workspace of ros2 goes on while that one is made, the first time.
test: $(STAMP) ## formatting, lint, types and the tests, in five minutes
	@$(call tests,not slow)

test-all: export TEST_DRAWS = all
test-all: $(STAMP) $(SITE_VENV)/.installed ## the same with the longer draws and recordings, in half an hour
	@$(call tests,slow or not slow)

test-ros2: export TEST_DRAWS = all
test-ros2: $(STAMP) ros2-workspace ## all that runs the real ros2, as CI does after `make test`: every node, ten Ctrl-Cs
	$(BIN)/python -m pytest -m "(slow or not slow) and ros2" --numprocesses 4 --dist loadscope --no-loadscope-reorder test/ros2

define tests
failed=; phase() { name="$$1"; shift; echo "== $$name"; $(BIN)/python -m pytest "$$@" || failed="$$failed, $$name"; }; \
nice -n 19 $(MAKE) --no-print-directory lint >$(VENV)/lint.txt 2>&1 & lint=$$!; \
nice -n 19 $(BIN)/python -m pytest -m "($(1)) and not processes" --numprocesses 2 --dist worksteal >$(VENV)/compute.txt 2>&1 & compute=$$!; \
$(MAKE) --no-print-directory ros2-workspace || { failed=", the workspace of ros2"; export TEST_ROS2=failed; }; \
phase "tests of time" -m "($(1)) and processes and alone"; \
phase "tests of processes" -m "($(1)) and processes and not alone" --numprocesses 4 --dist loadscope --no-loadscope-reorder; \
echo "== tests that compute"; wait $$compute || failed="$$failed, tests that compute"; cat $(VENV)/compute.txt; \
echo "== formatting, lint, types"; wait $$lint || failed="$$failed, formatting, lint, types"; cat $(VENV)/lint.txt; \
[ -z "$$failed" ] || { echo "make: failed:$${failed#,}" >&2; exit 1; }
endef

lint: $(STAMP) ## formatting, lint and types
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports

# Two minutes the first time; a step of its own, since it would count as time of the tests that need it.
ros2-workspace: ## the real ros2 for test/ros2, where its sources are present
	@test/ros2/workspace || [ $$? = 77 ]

bench: $(STAMP) ## every benchmark that can run here; fails at the end where one missed its bar (two hours)
	$(BIN)/python benchmarks/run.py --all

docs: $(STAMP) ## rewrite what the code defines: tables of docs/reference.md, config/
	$(BIN)/python docs/update.py

# Of its own, since only who builds the site needs it.
$(SITE_VENV)/.installed: docs/requirements.txt | $(STAMP)
	@$(BIN)/python -m venv $(SITE_VENV)
	@$(SITE_VENV)/bin/python -m pip install -qq --disable-pip-version-check -r docs/requirements.txt
	@touch $@

site: $(SITE_VENV)/.installed ## these pages as a site in build/site
	@NO_MKDOCS_2_WARNING=1 $(SITE_VENV)/bin/mkdocs build --quiet --strict
	@echo "site: build/site/index.html (its search needs a server: python3 -m http.server -d build/site)"

clean: ## remove everything that make and colcon made
	rm -rf $(VENV) $(SITE_VENV) $(DEMO) $(DEMO_MARKERS) $(DEMO_MESH) $(DEMO_CAMERA) $(DEMO_IMUS) .ros2_workspace build install log dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
