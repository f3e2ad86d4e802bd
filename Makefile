# `make demo` and `make test` need python3 (3.11 or newer) and make; everything else goes into $(VENV).
PYTHON ?= python3
VENV ?= .venv
EXTRAS ?= test,plot

BIN := $(VENV)/bin
READY := $(VENV)/.has-$(EXTRAS)

# One worker runs a whole file, so that its fixtures are prepared once. Files go in their own order: by default those
# with few tests come last, and the slowest have few.
PYTEST := $(BIN)/python -m pytest $(OPTIONS)
PARALLEL := -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder

# Python keeps the bytecode of what it imports: each process would otherwise compile it again, in seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-marked test-all lint bench bench-seams surface-bounds change-bench many-bench voids-bench ablation tune calibration coverage comparison pictures notebook docs dist clean

demo: $(VENV)/.has-plot
	$(BIN)/sat-intervals demo demo-out --overwrite --size 800 800
	$(BIN)/sat-intervals plot demo-out & $(BIN)/sat-intervals report demo-out && wait $$!
	@echo 'Open demo-out/overview.png and demo-out/report.html'

# Tests that need no services, no other extras and no real pairs; at most three minutes on two cores.
test: $(READY)
	$(PYTEST) $(PARALLEL) -m 'not process and not peer and not ported'

# The other tests. With OPTIONS=--skip-nothing a skipped test fails.
test-marked: $(READY) $(VENV)/.has-services
	$(PYTEST) $(PARALLEL) -m 'process or peer or ported'

test-all: test test-marked

lint: $(READY) $(VENV)/.has-lint
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(PYTEST) --quiet tests/test_architecture.py

# The tables of docs/speed.md, and stages in docs/clusters.md: this project beside its peers; about half an hour.
bench: $(VENV)/.has-bench,dsm
	$(BIN)/python tests/benchmarks/table.py

# The tables of docs/speed.md on exact seams; about seven minutes.
bench-seams: $(VENV)/.has-bench
	$(BIN)/python tests/benchmarks/seams.py

# The paper's table 2, on the Middlebury pairs of SAT_INTERVALS_SHARED; a minute.
ablation: $(VENV)/.has-test
	PYTHONPATH=tests $(BIN)/python -W ignore tests/benchmarks/ablation.py

# The tables of README.md and docs/presets.md, on the pairs of SAT_INTERVALS_SHARED; after `make calibration` minutes.
# NAMES: presets, or penalties to compare them with.
tune: $(VENV)/.has-mccnn
	$(BIN)/python -W ignore tests/benchmarks/tune.py $(NAMES)

# The built-in calibrations, on the pairs of SAT_INTERVALS_SHARED; a quarter of an hour of processor time.
calibration: $(VENV)/.has-mccnn
	$(BIN)/python tests/benchmarks/calibrations.py

# The table of docs/heights.md: coverage and width of the bounds of a surface's cells, on exact scenes; minutes.
surface-bounds: $(VENV)/.has-dsm
	$(BIN)/python -W ignore tests/benchmarks/surface_bounds.py

# The tables of docs/change.md, on the images of SAT_INTERVALS_SHARED and exact scenes; half an hour.
change-bench: $(VENV)/.has-dsm
	$(BIN)/python -W ignore tests/benchmarks/change.py

# The table of docs/many.md, on the images of SAT_INTERVALS_SHARED and exact scenes; five minutes.
many-bench: $(VENV)/.has-dsm
	$(BIN)/python -W ignore tests/benchmarks/many.py

# The table of docs/heights.md on voids, on the images of SAT_INTERVALS_SHARED and exact scenes; a quarter of an hour.
voids-bench: $(VENV)/.has-dsm
	$(BIN)/python -W ignore tests/benchmarks/voids.py

# The tables of docs/coverage.md, on the same pairs; about five minutes after `make calibration`, else half an hour more.
coverage: $(VENV)/.has-mccnn
	$(BIN)/python -W ignore tests/benchmarks/coverage_tables.py

# The tables of docs/comparison.md, with the commands cars and s2p that are on PATH; twenty minutes, most of it CARS.
comparison: $(VENV)/.has-dsm,test
	$(BIN)/python -W ignore docs/comparison.py $(MANY) build/comparison

# The pictures of README.md and docs; 256 colours keep them small. RAW is the folder of a raw pair, MANY of raw images.
RAW ?= $(SAT_INTERVALS_SHARED)/data/raw_picanteo_pre
MANY ?= $(SAT_INTERVALS_SHARED)/data/jax_068
pictures: $(VENV)/.has-dsm,plot
	$(BIN)/sat-intervals demo demo-out --overwrite --quiet
	$(BIN)/python docs/pictures/demo_cameras.py demo-out
	$(BIN)/sat-intervals dsm demo-out --resolution 1 --left-model demo-out/left_model.tif --right-model demo-out/right_model.tif --left-grid demo-out/left_grid.tif --right-grid demo-out/right_grid.tif --quiet
	$(BIN)/sat-intervals plot demo-out --row 640 --columns 300 700 --dpi 72
	mkdir -p .github/pictures
	$(BIN)/python docs/pictures/wavefronts.py demo-out/wavefronts.png
	$(BIN)/python docs/pictures/staircase.py demo-out/staircase.png
	$(BIN)/python docs/pictures/rows.py demo-out/rows.png
	$(BIN)/sat-intervals surface $(RAW)/left.tif $(RAW)/right.tif demo-out/raw --resolution 1 --overwrite --quiet
	$(BIN)/python docs/pictures/surface.py demo-out/raw demo-out/surface.png
	$(BIN)/sat-intervals surface $(MANY)/003.tif $(MANY)/004.tif demo-out/two --resolution 0.5 --band 2 --overwrite --quiet
	$(BIN)/sat-intervals surface $(sort $(wildcard $(MANY)/0*.tif)) demo-out/many --resolution 0.5 --band 2 --overwrite --quiet
	$(BIN)/python docs/pictures/many.py $(MANY)/lidar_west.tif demo-out/two demo-out/many demo-out/many.png
	$(BIN)/sat-intervals surface $(MANY)/005.tif $(MANY)/006.tif demo-out/later --resolution 0.5 --band 2 --overwrite --quiet
	$(BIN)/python docs/pictures/change.py demo-out/two demo-out/later demo-out/change demo-out/change.png
	for name in overview profile wavefronts staircase rows surface many change; do $(BIN)/python -c 'import sys; from PIL import Image; Image.open(sys.argv[1]).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(sys.argv[2], optimize=True)' demo-out/$$name.png .github/pictures/$$name.png; done

# docs/notebook.ipynb with what its cells print and draw; a minute.
notebook: $(VENV)/.has-dsm,plot
	rm -rf build/notebook && mkdir -p build/notebook
	cd build/notebook && $(abspath $(BIN))/python -W error $(CURDIR)/docs/run_notebook.py

# The documentation site, in site/; a warning is an error. Pictures of the gallery are made by running the commands.
docs: $(VENV)/.has-docs,dsm,plot
	$(BIN)/python docs/site.py

# Wheel and sdist in dist/, checked, whose README has whole addresses; the wheel is installed and run in an empty environment.
dist:
	rm -rf dist build/source && mkdir -p build/source
	git ls-files -z | xargs -0 cp --parents -t build/source
	$(PYTHON) docs/pypi_readme.py build/source
	$(PYTHON) -m venv --clear build/tools
	build/tools/bin/python -m pip install --quiet --disable-pip-version-check build cffconvert twine
	build/tools/bin/python -m build --outdir dist build/source
	build/tools/bin/twine check --strict dist/*
	build/tools/bin/cffconvert --validate
	$(PYTHON) -m venv --clear build/wheel
	build/wheel/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	cd build && wheel/bin/sat-intervals demo demo --size 300 300 --overwrite

# --no-compile saves time: Python compiles a module when it is first imported, and most never are. What tests import is
# compiled by one process here, not by each worker of `make test` at once. The newest pip prints that setuptools warns
# of editable installations: that is what is wanted here.
$(VENV)/.has-%: pyproject.toml $(VENV)/.made
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable '.[$*]'
	$(if $(findstring test,$*),$(BIN)/python -m pytest --collect-only --quiet > /dev/null || true)
	touch $@

# The newest pip finds the versions to install in half the time that an old one takes. Without a pip of its own, or one
# before 22.3, $(PYTHON) installs the one that it brings: that is compiled, for five seconds.
$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "sat-intervals needs Python 3.11 or newer, $(PYTHON) is %d.%d: name another one with make PYTHON=..." % sys.version_info[:2])'
	$(PYTHON) -m venv --clear --without-pip $(VENV)
	$(PYTHON) -m pip --python $(BIN)/python install --quiet --disable-pip-version-check --no-compile pip 2> /dev/null || $(BIN)/python -m ensurepip --default-pip > /dev/null
	touch $@

clean:
	rm -rf $(VENV) build dist site *.egg-info demo-out
