# make demo   install into .venv and train two objects: a real one with the exact prior, and a shape with a small network
# make test   ruff, pyright and the whole test suite: everything that must hold before a merge
# make check  ruff, pyright and the tests of what has changed since the last commit on main; less than a minute
# make gpu    check, time and explain the CUDA kernels on the NVIDIA GPU of this machine, in at most 35 minutes and
#             the time of installing; PART=checks and so on (docs/notes/performance.md) do it in parts of less than ten
# make docs   build the documentation as a site into the folder site, strictly: no warning, no broken link
# make clean  remove .venv and caches; outputs stay
# PYTHON=python3.12 chooses the interpreter; JOBS=2 sets the number of test processes, else one more than cores.

SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
CANDIDATES := python3 python3.13 python3.12 python3.11
PYTHON ?= $(firstword $(foreach name,$(CANDIDATES),$(shell $(name) -c '$(SUPPORTED)' 2>/dev/null && echo $(name))))
JOBS ?= auto
BASE ?= main
BIN := .venv/bin
INSTALL := $(BIN)/python -m pip install --constraint constraints.txt --editable
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --maxprocesses 8 --dist loadfile --no-loadscope-reorder

.PHONY: demo test check gpu docs clean

demo: .venv/.installed
	$(BIN)/cadam3d train prompt="a teddy bear"
	$(BIN)/cadam3d train prior=shapes_mvdream prompt="a red mushroom" truth=shapes
	@echo "Both objects are in outputs. The second is in outputs/latest (asset.ply, turntable.mp4, preview.png, report.html)"

test: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(PYTEST)

check: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	@tests="$$($(BIN)/python scripts/changed_tests.py $(BASE))"; \
	if [ -z "$$tests" ]; then echo "No tests belong to what has changed since $(BASE)."; \
	else echo "Tests of what has changed since $(BASE): $$tests"; $(PYTEST) -m "not slow" $$tests; fi

# Nothing is installed on a machine without a GPU. The newest torch does not run with every driver, so the one that
# does is installed first.
gpu:
	@$(or $(wildcard $(BIN)/python),$(PYTHON),python3) scripts/gpu.py --look
	@$(MAKE) --no-print-directory $(BIN)/python
	@torch="$$($(BIN)/python scripts/gpu.py --torch)"; \
	if [ -n "$$torch" ]; then $(BIN)/python -m pip install --constraint constraints.txt "$$torch"; fi
	@[ -e .venv/.installed-dev ] || $(MAKE) --no-print-directory .venv/.installed-gpu
	$(BIN)/python scripts/gpu.py $(if $(PART),--part $(PART))

docs: .venv/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build
	@echo "Open site/index.html. To search it too, type: $(BIN)/python -m http.server --bind 127.0.0.1 --directory site"

clean:
	rm -rf .venv build dist site .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The installs are editable: a changed source needs no new install; changed dependencies do. The largest download is
# torch with 2 to 3 GB on Linux, so pip shows its progress.
.venv/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing cadam3d, torch and diffusers into .venv. With torch's CUDA libraries, which Linux gets by default, this is a"
	@echo "download of 2 to 3 GB; with torch's build for the CPU, .venv takes 1.7 GB. It takes some minutes, and pip shows its progress."
	$(INSTALL) ".[diffusers]"
	@touch $@

.venv/.installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) ".[dev]"
	@touch $@ .venv/.installed .venv/.installed-docs

.venv/.installed-gpu: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) ".[gpu]"
	@touch $@ .venv/.installed

.venv/.installed-docs: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) ".[docs]"
	@touch $@

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "cadam3d needs Python 3.11, 3.12 or 3.13. Try: uv python install 3.12, or conda create -p python3.12 python=3.12, and then make $(MAKECMDGOALS) PYTHON=/path/to/python3.12"; exit 1; }
	@$(PYTHON) -c '$(SUPPORTED)' || { echo "$(PYTHON) is not Python 3.11, 3.12 or 3.13. Try: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "$(PYTHON) cannot make a virtual environment. Try: apt install python3-venv"; exit 1; }
