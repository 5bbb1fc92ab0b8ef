# Every target sets up what it needs: a virtual environment in .venv, with the tested versions.
PYTHON ?= python3
JOBS ?= 2
VENV := .venv
OLDEST := .venv-oldest
BIN := $(VENV)/bin
# Python compiles to bytecode what is imported; pip would compile all files, one after the other
unexport PYTHONDONTWRITEBYTECODE
INSTALL := $(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable

.PHONY: setup demo circle results test test-oldest test-clients test-arm test-single test-slow soak golden lint benchmark docs reference kernels wheel wheel-arm clean

setup: $(VENV)/.developer

$(BIN)/python:
	@# by the pip of PYTHON, if it has one: that of a new environment is slow to make, and half as fast
	$(PYTHON) -m venv --without-pip $(VENV)
	$(PYTHON) -m pip --python $@ install --quiet --no-compile "pip>=25" 2>/dev/null \
		|| { $(PYTHON) -m venv $(VENV) && $@ -m pip install --quiet "pip>=25"; }

$(VENV)/.user: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) ".[plot]"
	touch $@

$(VENV)/.viewer: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) ".[plot]" pygame-ce  # draws films; the extra `render` has 165 MB of ffmpeg, too
	touch $(VENV)/.user $@  # which it holds

$(VENV)/.trainer: $(VENV)/.user
	$(INSTALL) ".[train,plot,render]"
	touch $@

$(VENV)/.developer: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) ".[train,plot,render,pandas,ulog,ardupilot,ros,rerun,export,dev]"
	touch $(VENV)/.user $(VENV)/.viewer $(VENV)/.trainer $@

$(VENV)/.writer: $(VENV)/.user
	$(INSTALL) ".[train,plot,render,docs]"
	touch $@

demo: $(VENV)/.viewer  ## LookAround on truth and estimate, then the circle as the control: about two minutes
	@echo "1. LookAround: the only markers are on one wall, and there is no GNSS. Three controllers"
	@echo "   are evaluated on the true state and on the filter's estimate: PD control, a policy"
	@echo "   trained on the true state, and one with estimate + standard deviation, reward for certainty."
	@$(BIN)/quad-gym evaluate look_around --policy pd pretrained:truth pretrained --episodes 60 \
		--video webp --overwrite --output results/demo/look_around
	@echo
	@echo "2. The control experiment: on the circle, good sensors determine the state, so training on the"
	@echo "   estimate is expected to make no difference. Five seeds are trained on each, until the policies"
	@echo "   are at least as good as PD control with tuned gains. Expect a 95 % interval of about 4 mm on"
	@echo "   both sides of zero. One in twenty such intervals misses zero by chance: docs/when-to-train.md"
	@echo "   draws the conclusion from ten seeds with more steps."
	@$(BIN)/quad-gym compare circle --engine compiled --train-on truth estimate --seeds 5 \
		--steps 1000000 --evaluations 10 --episodes 100 --jobs 2 --output results/demo/control
	@echo
	@echo "Open:"
	@echo "  results/demo/look_around/video.webp   one episode; the policy on the right looks at the markers"
	@echo "  results/demo/look_around/errors.png   errors and crashes over time"
	@echo "  results/demo/control/report.html      the control experiment"
	@echo "Next:"
	@echo "  $(BIN)/quad-gym evaluate look_around --policy pd:features_when_uncertain pretrained"
	@echo "  $(BIN)/quad-gym fly look_around --policy pretrained --output results/flight.webp"
	@echo "  $(BIN)/quad-gym compare --quick --engine compiled"

circle: $(VENV)/.user  ## fly the report's experiment over 1,000 seeds; figures and numbers in results/circle
	$(BIN)/quad-gym circle --output results/circle

results: $(VENV)/.trainer  ## renew the numbers, tables and figures of README and docs that are out of date
	$(BIN)/python -m docs.renewal

test: setup  ## the tests, without the slow statistical and soak ones, in JOBS processes
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder -m "not slow" --durations=30

test-oldest: $(OLDEST)/.tester  ## golden flights and interfaces with the oldest versions admitted
	$(OLDEST)/bin/python -m pytest -q tests/contract/test_golden.py tests/contract/test_checkers.py \
		tests/contract/test_sb3_env.py tests/unit/test_ukf.py -m "not slow"

$(OLDEST)/.tester: pyproject.toml constraints-oldest.txt
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip install --quiet --no-compile --constraint constraints-oldest.txt \
		--editable ".[train,plot,render]" pytest hypothesis
	touch $@

test-clients:  ## each client of docs/libraries.md in an environment of its own; CLIENTS="torchrl minari": these
	$(PYTHON) tests/clients/run.py $(CLIENTS)

test-arm: setup  ## golden flights on AArch64, emulated, in both precisions: needs gcc-aarch64-linux-gnu and qemu-user-static
	$(BIN)/python -m tests.golden.aarch64
	QUAD_GYM_PRECISION=single $(BIN)/python -m tests.golden.aarch64

test-single: setup  ## golden flights and exported filters in single precision, with each number of lanes
	for lanes in 16 8 4 2; do QUAD_GYM_PRECISION=single QUAD_GYM_LANES=$$lanes \
		$(BIN)/python -m tests.golden.flights || exit 1; done
	$(BIN)/python -m pytest tests/statistical/test_single_precision.py -k exported

test-slow: setup  ## the slow tests: statistics, soak, many processes
	$(BIN)/python -m pytest -m slow

soak: setup  ## MINUTES=10 of random cases, 10^8 random-action steps over all tasks, 10^7 filter updates over all suites and faults
	$(BIN)/python -m tests.soak --minutes $(or $(MINUTES),10)
	QUAD_GYM_SOAK_STEPS=100000000 QUAD_GYM_SOAK_UPDATES=10000000 $(BIN)/python -m pytest -s -m slow tests/soak

golden: setup  ## after flights have changed on purpose: compute their digests again
	$(BIN)/python -m tests.golden.flights --renew
	QUAD_GYM_PRECISION=single $(BIN)/python -m tests.golden.flights --renew

lint: setup  ## style, types, import rules and words
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.dialect

benchmark: setup  ## steps per second of every interface and with each suite
	$(BIN)/quad-gym benchmark --output results/benchmark

docs: $(VENV)/.writer  ## the site in docs/_build/html/index.html; runs the tutorials, some minutes
	$(BIN)/quad-gym compile --stages all # here, so that no tutorial says that it compiles
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

reference: setup  ## the tables of docs/reference, from the code
	$(BIN)/python -m docs.extensions.environment_pages

kernels: $(VENV)/.user  ## libraries of compiled kernels for this checkout, which then needs no Numba
	$(BIN)/quad-gym compile --library

$(VENV)/.builder: $(VENV)/.user
	$(BIN)/python -m pip install --quiet --constraint constraints.txt build twine check-wheel-contents auditwheel
	touch $@

define check-dist
	$(BIN)/twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl
	for wheel in dist/*.whl; do found=$$($(BIN)/auditwheel show $$wheel) && echo "$$found" \
		&& echo "$$found" | grep -q '"manylinux_2_' || exit 1; done
	ls -l dist
endef

wheel: kernels $(VENV)/.builder  ## build sdist and a wheel with the libraries into dist, and check what they hold; needs gcc and cmake
	$(BIN)/quad-gym compile --ptx
	rm -rf dist
	$(BIN)/python -m build --installer pip --sdist
	QUAD_GYM_WHEEL=$$(uname -m) $(BIN)/python -m build --installer pip --wheel
	$(check-dist)
	$(BIN)/python -m tests.wheel dist/*$$(uname -m).whl

wheel-arm: $(VENV)/.builder  ## add a wheel for AArch64 to dist, cross-linked: needs gcc-aarch64-linux-gnu
	CC=aarch64-linux-gnu-gcc $(BIN)/quad-gym compile --library --family aarch64
	QUAD_GYM_WHEEL=aarch64 $(BIN)/python -m build --installer pip --wheel
	$(check-dist)

clean:
	rm -rf quad_gym/kernels/libraries
	rm -rf $(VENV) $(OLDEST) .venv-clients build dist results docs/_build docs/generated docs/tutorials .mypy_cache .pytest_cache .ruff_cache .hypothesis
