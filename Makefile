# The verbs of this project; `make` alone lists them. What needs Python sets up .venv by itself.
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

PYTHON ?= python3
ifndef CLOUD
tune: CLOUD := data/surveys/barolo/barolo.laz
tune: BOUNDARY := data/surveys/barolo/parcels.gpkg
tune: PARCEL := $(or $(PARCEL),F)
endif
SIZES ?=
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
READY_BENCH := $(VENV)/.ready-bench
LOG := $(VENV)/install.log

.PHONY: help parcel survey nightly test test-qgis test-installed check accuracy fuzz odometry bench picture tune web clean

help: ## List the verbs
	@echo "make VERB, where VERB is one of"
	@sed -nE 's/^([a-z-]+):[^#]*## (.*)$$/\1 \2/p' $(firstword $(MAKEFILE_LIST)) | \
	  while read -r verb does; do printf '  %-14s %s\n' "$$verb" "$$does"; done

parcel: export CONFIG ?= configs/barolo.yaml
parcel: export PARCEL := $(PARCEL)
parcel: $(if $(strip $(PARCEL)),$(READY)) ## Map one parcel: make parcel PARCEL=F [CONFIG=configs/barolo.yaml]
ifeq ($(strip $(PARCEL)),)
	@echo "Name the parcel, for example: make parcel PARCEL=F" >&2; exit 2
else
	@$(BIN)/vinemap parcel --config "$$CONFIG" -- "$$PARCEL"
endif

survey: export SURVEY := $(SURVEY)
survey: $(if $(strip $(SURVEY)),$(READY)) ## Map all parcels of a survey that need it: make survey SURVEY=barolo [AGAIN=1]
ifeq ($(strip $(SURVEY)),)
	@echo "Name the survey, for example: make survey SURVEY=barolo" >&2; exit 2
else
	@$(BIN)/vinemap survey $(if $(AGAIN),--again) -- "$$SURVEY"
endif

nightly: export CONFIG ?= configs/nightly.yaml
nightly: $(READY) ## Map what needs it, every night: make nightly [CONFIG=configs/nightly.yaml]
	@exec $(BIN)/vinemap nightly --config "$$CONFIG"

test: $(READY) ## Run the tests, two files at once
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test-qgis: $(READY) ## Open products in the QGIS that is installed, pictures in build/qgis, and call vinemap from it
	@$(BIN)/python -m pytest -n 0 tests/product/test_qgis.py tests/plugin/test_qgis.py

test-installed: $(READY) ## Install vinemap by pip, and by the container's steps, and map with it (needs a package index)
	@VINEMAP_TEST_INSTALLED=1 $(BIN)/python -m pytest -n 0 tests/test_installed.py tests/test_container.py

check: $(READY) ## Check style, format and types
	@$(BIN)/python -m ruff check
	@$(BIN)/python -m ruff format --check
	@$(BIN)/python -m mypy

accuracy: $(READY) ## Measure rows and canopies on simulated vineyards, fill docs/accuracy.md: make accuracy [FAMILY="curved fan"]
	@$(BIN)/python -m vinemap.measure.accuracy $(FAMILY) --out build/accuracy $(if $(FAMILY),,--docs docs/accuracy.md)

fuzz: $(READY) ## Damage small clouds in 2,000 ways: each must end in a right product or in a line: make fuzz [CASES=200]
	@$(BIN)/python -m vinemap.measure.fuzz $(if $(CASES),--cases $(CASES))

odometry: $(READY) ## Measure visual odometry on simulated frames, fill docs/accuracy.md: make odometry [PART="lost paths"] [PAIRS=500]
	@OMP_NUM_THREADS=1 $(BIN)/python -m vinemap.measure.odometry $(PART) $(if $(PAIRS),--pairs $(PAIRS)) --docs docs/accuracy.md

bench: $(READY_BENCH) ## Measure seconds and memory, fill docs/speed.md: make bench [SIZES="1 2"]
	@$(BIN)/python -m vinemap.measure.bench $(if $(SIZES),--sizes "$(SIZES)" --dense "$(SIZES)",--docs docs/speed.md)

picture: $(READY) ## Draw README's picture of a product: make parcel PARCEL=curved picture
	@$(BIN)/python -m vinemap.measure.picture data/products/barolo/$(or $(PARCEL),curved) $(or $(PARCEL),curved) docs/picture.png

tune: $(READY) ## Search the [a, b, c] that models canopies best: make tune [CLOUD=FILE BOUNDARY=FILE PARCEL=F]
	@$(BIN)/python -m vinemap.measure.tune "$(CLOUD)" $(if $(BOUNDARY),--boundary "$(BOUNDARY)") $(if $(PARCEL),--parcel "$(PARCEL)")

web: ## Bundle the pages' scripts and style anew, after a change in vinemap/product/pages/web (needs node and npm)
	@cd vinemap/product/pages/web && npm ci --silent && npm run --silent build

clean: ## Remove .venv and the tools' caches; surveys and products stay
	@rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist vinemap/product/pages/web/node_modules
	@find flows tests vinemap -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): pyproject.toml configs/constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "vinemap needs Python 3.11 or newer, $(PYTHON) is $$($(PYTHON) -V 2>&1 | tail -n 1): try make PYTHON=python3.11" >&2; \
	  exit 2; \
	}
	@if [ -e $@ ]; then echo "Bringing $(VENV) up to date…"; else echo "Setting up $(VENV) (about 1.6 GB, a minute or two)…"; fi
	@rm -f $@; mkdir -p $(VENV)
	@{ $(PYTHON) -m venv $(VENV) && \
	  $(BIN)/python -m pip install -q --disable-pip-version-check -c configs/constraints.txt -e '.[all,dev]'; \
	} >$(LOG) 2>&1 || { \
	  grep -v 'is ignored: it is neither' $(LOG) | tail -n 15 >&2; \
	  echo "Setting up $(VENV) failed; all that was said stands in $(LOG)" >&2; \
	  exit 1; \
	}
	@$(BIN)/python -m vinemap warm >>$(LOG) 2>&1 || true  # else the first run does
	@touch $@

$(READY_BENCH): $(READY)
	@echo "Adding to $(VENV) what make bench compares with…"
	@$(BIN)/python -m pip install -q --disable-pip-version-check -c configs/constraints.txt -e '.[all,dev,bench]' >$(LOG) 2>&1 || { \
	  grep -v 'is ignored: it is neither' $(LOG) | tail -n 15 >&2; \
	  echo "Adding to $(VENV) failed; all that was said stands in $(LOG)" >&2; \
	  exit 1; \
	}
	@touch $@
