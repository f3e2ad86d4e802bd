# `make demo` and `make test` need python3 (3.11 or newer) and make; everything else goes into $(VENV).
PYTHON ?= python3
VENV ?= .venv
EXTRAS ?= test,lint,plot

BIN := $(VENV)/bin
READY := $(VENV)/.installed

.PHONY: demo test lint bench tune pictures clean

demo: $(READY)
	$(BIN)/sat-intervals demo demo-out --overwrite

test: $(READY)
	$(BIN)/python -m pytest

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/python -m pytest --quiet tests/test_architecture.py

# The tables of docs/speed.md: this project beside its peers; about thirteen minutes.
bench: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	$(BIN)/python tests/benchmarks/table.py

# The tables of docs/presets.md, on the pairs of SAT_INTERVALS_SHARED; about ten minutes.
tune: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[mccnn]'
	$(BIN)/python -W ignore::rasterio.errors.NotGeoreferencedWarning tests/benchmarks/tune.py

# The pictures of README.md and docs; 256 colours keep them small.
pictures: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dsm,plot]'
	$(BIN)/sat-intervals demo demo-out --overwrite --quiet
	$(BIN)/python docs/pictures/demo_cameras.py demo-out
	$(BIN)/sat-intervals triangulate demo-out --left-model demo-out/left_model.tif --right-model demo-out/right_model.tif --left-grid demo-out/left_grid.tif --right-grid demo-out/right_grid.tif --quiet
	$(BIN)/sat-intervals dsm demo-out --resolution 1 --quiet
	$(BIN)/sat-intervals plot demo-out --row 640 --columns 300 700 --dpi 72
	mkdir -p .github/pictures
	for name in overview profile dsm; do $(BIN)/python -c 'import sys; from PIL import Image; Image.open(sys.argv[1]).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(sys.argv[2], optimize=True)' demo-out/$$name.png .github/pictures/$$name.png; done

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "sat-intervals needs Python 3.11 or newer, $(PYTHON) is %d.%d: name another one with make PYTHON=..." % sys.version_info[:2])'
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$(EXTRAS)]'
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info demo-out
