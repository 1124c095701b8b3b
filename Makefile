# Each command sets up what it needs in .venv (the first time only) and then runs.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
PYTHONS := python3 python3.14 python3.13 python3.12 python3.11
INSTALL := --editable '.[all]'
# The newest Pythons for which what is old was built; pyenv's count, too.
COMPAT_VENV := .venv-compat
COMPAT_PYTHONS := python3.12 $(wildcard $(HOME)/.pyenv/versions/3.12.*/bin/python3.12) python3.11
COMPAT_INSTALL := --constraint .ci/ubuntu-24.04.txt --editable '.[ros,test]'
say := @printf '%s\n'

# A ROS sourced in this shell, or another virtual environment's wheels, must not leak into ours.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH PYTHONHOME PYTHONPATH
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH ROS_DISTRO ROS_LOCALHOST_ONLY
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST

# The stamp holds this folder's path: one that was moved, or whose Python is gone, does not count.
ifneq ($(shell test -x $(BIN)/python && cat $(STAMP) 2>/dev/null),$(CURDIR))
.PHONY: $(STAMP)
endif

.PHONY: help
help:
	$(say) 'make demo   replay a sample bag to the detector over DDS; results in demo_output/, a page in demo_report/'
	$(say) 'make demo-guide  a simulated mount follows a satellite; results in demo_guide_output/'
	$(say) 'make test   run all tests, with the newest of everything'
	$(say) 'make test-compat  run them with the versions of Ubuntu 24.04, on which ROS 2 Jazzy is at home'
	$(say) 'make test-some TESTS=test/test_objects.py  run these; test-compat takes TESTS, too'
	$(say) 'make check-arm  whether pip would find all it needs for aarch64, as on a Raspberry Pi'
	$(say) 'make lint   check format, style and types'
	$(say) 'make audit  look for known vulnerabilities in what is installed'
	$(say) "make bench  the paper's scenes, detection beside its peers, and speed, as tables"
	$(say) 'make docs   the reference of the Python interface, as pages in docs_output/'
	$(say) 'make compare  detection and speed beside the previous version'
	$(say) 'make clean  remove everything that make and colcon made'

.PHONY: demo
demo: $(STAMP)
	$(say) 'demo: player -> detector -> recorder; results go to demo_output/'
	@$(BIN)/demo --output demo_output
	$(say) 'demo: the same bag without ROS, with a page on what was found: demo_report/report.html'
	@$(BIN)/ofsat process bags/geo -o demo_report --force

.PHONY: demo-guide
demo-guide: $(STAMP)
	$(say) 'demo-guide: simulator -> detector -> guide -> simulator; results go to demo_guide_output/'
	@$(BIN)/demo_guide --output demo_guide_output

.PHONY: test
test: $(STAMP)
	$(say) 'test: what needs no ROS, on several cores'
	@$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile -m 'not graph'
	$(say) 'test: nodes over DDS and a colcon build, two at a time'
	@$(BIN)/python -m pytest -n 2 --dist loadfile -m 'graph and not alone'
	$(say) 'test: what is of real time, one after the other'
	@$(BIN)/python -m pytest -m alone

.PHONY: test-some
test-some: $(STAMP)
	@$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile $(TESTS)

.PHONY: test-compat
test-compat:
	@$(MAKE) --no-print-directory VENV='$(COMPAT_VENV)' PYTHONS='$(COMPAT_PYTHONS)' \
	    INSTALL="$(COMPAT_INSTALL)" $(if $(TESTS),test-some,test)

.PHONY: check-arm
check-arm: $(STAMP)
	@$(BIN)/python .ci/arm.py

.PHONY: lint
lint: $(STAMP)
	$(say) 'lint: format'
	@$(BIN)/ruff format --check .
	$(say) 'lint: style'
	@$(BIN)/ruff check .
	$(say) 'lint: types'
	@$(BIN)/mypy

.PHONY: audit
audit: $(STAMP)
	$(say) 'audit: whether the packages fit each other'
	@$(BIN)/python -m pip check --disable-pip-version-check
	$(say) 'audit: known vulnerabilities'
	@$(BIN)/python .ci/audit.py

.PHONY: bench
bench: $(STAMP)
	$(say) "bench: the paper's scenes, both engines"
	@$(BIN)/python -m benchmarks.paper
	$(say) 'bench: how well each engine measures a motion'
	@$(BIN)/python -m benchmarks.engines
	$(say) 'bench: detection beside the published method and SExtractor'
	@$(BIN)/python -m benchmarks.detection
	$(say) 'bench: parameters for unusual optics'
	@$(BIN)/python -m benchmarks.optics
	$(say) 'bench: speed against SExtractor, and throughput over DDS'
	@$(BIN)/python -m benchmarks.speed
	@$(BIN)/python -m benchmarks.throughput
	$(say) 'bench: an orbit out of the angles of a pass'
	@$(BIN)/python -m benchmarks.orbit

.PHONY: docs
docs: $(STAMP)
	$(say) 'docs: the reference of the Python interface; open docs_output/index.html'
	@rm -rf docs_output
	@$(BIN)/python docs/reference.py docs_output

.PHONY: compare
compare: $(STAMP)
	$(say) 'compare: detection and speed beside the previous version'
	@$(BIN)/python -m benchmarks.compare

.PHONY: clean
clean:
	$(say) 'clean: $(VENV), $(COMPAT_VENV), demo outputs, build, install, log and caches'
	@rm -rf $(VENV) $(COMPAT_VENV) demo_output demo_report demo_guide_output docs_output build install log .hypothesis .mypy_cache .pytest_cache .ruff_cache
	@rm -rf *.egg-info
	@find . -name __pycache__ -prune -exec rm -rf {} +

# Without a valid stamp the environment is made anew, since an interrupted pip leaves it in pieces;
# with one that is merely older than setup.py, pip brings it up to date.
$(STAMP): setup.py .ci/ubuntu-24.04.txt
	$(say) 'setup: looking for one of $(PYTHONS)'
	@test "$$(uname -m)" = x86_64 || { \
	    echo 'make: the ROS 2 wheels exist for x86-64 only. Here, build with colcon on a ROS 2' \
	         'Jazzy from apt: see README.md.' >&2; exit 1; }
	@python=; for name in $(PYTHONS); do \
	    if $$name -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null; \
	    then python=$$name; break; fi; done; \
	if [ -z "$$python" ]; then \
	    echo 'make: found none of $(PYTHONS). On Debian 12, Ubuntu 24.04 and later:' \
	         'sudo apt install python3 python3-venv' >&2; exit 1; fi; \
	if ! $$python -c 'import ensurepip, venv' 2>/dev/null; then \
	    echo "make: $$python cannot make a virtual environment. On Debian or Ubuntu:" \
	         'sudo apt install python3-venv' >&2; exit 1; fi; \
	if [ "$$(test -x $(BIN)/python && cat $(STAMP) 2>/dev/null)" != '$(CURDIR)' ]; then \
	    echo "setup: making $(VENV) with $$($$python --version)"; \
	    $$python -m venv --clear $(VENV); fi
	@rm -f $(STAMP)
	$(say) 'setup: installing ROS 2 and tools into $(VENV), 0.7 GB; minutes, but only once'
	@$(BIN)/python -m pip install -qq --disable-pip-version-check $(INSTALL)
	@printf '%s\n' '$(CURDIR)' > $(STAMP)
	$(say) 'setup: done'
