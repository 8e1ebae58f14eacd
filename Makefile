# make demo   install into .venv and make a first object       make test   everything that must hold before a merge
# make clean  remove .venv and caches (outputs stay)
# PYTHON=python3.12 chooses the interpreter; JOBS=2 the number of test processes.

SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
CANDIDATES := python3 python3.13 python3.12 python3.11
PYTHON ?= $(firstword $(foreach name,$(CANDIDATES),$(shell $(name) -c '$(SUPPORTED)' 2>/dev/null && echo $(name))))
JOBS ?= auto
BIN := .venv/bin

.PHONY: demo test clean

demo: .venv/.installed
	$(BIN)/cadam3d train prompt="a red and yellow checkered torus"
	@echo "The run: outputs/latest (asset.ply, turntable.mp4, preview.png, report.html)"

test: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --maxprocesses 8 --dist loadfile --no-loadscope-reorder

clean:
	rm -rf .venv build dist .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The installs are editable: a changed source needs no second one, only a changed pyproject.toml does.
.venv/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

.venv/.installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	@touch $@ .venv/.installed

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "cadam3d needs Python 3.11, 3.12 or 3.13. Try: make $(MAKECMDGOALS) PYTHON=/path/to/python3.12"; exit 1; }
	@$(PYTHON) -c '$(SUPPORTED)' || { echo "$(PYTHON) is not Python 3.11, 3.12 or 3.13. Try: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "$(PYTHON) cannot make a virtual environment. Try: apt install python3-venv"; exit 1; }
