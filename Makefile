# Start with `make demo` or `make test`; either creates .venv once. docs/install.md has the same steps in plain pip.
PYTHON ?= python3
OUT ?= outputs/demo

VENV := .venv
RUN := $(VENV)/bin/python
STAMP := $(VENV)/.installed
LAB := my_notebooks
NOTEBOOKS := $(sort $(wildcard notebooks/*.ipynb))

.PHONY: help demo test check lint format lab notebooks site browser hostile gpu exercises doctor clean

help:
	@echo "make demo       the method end to end on data_samples/; writes $(OUT)/report.html"
	@echo "make test       ruff, unit tests, and every notebook re-executed and checked (nbval)"
	@echo "make check      the unit tests that are not slow"
	@echo "make lint       ruff: format and lint of all code, notebooks included"
	@echo "make format     let ruff format all code, notebooks included"
	@echo "make lab        JupyterLab on your own copy of the notebooks, $(LAB)/, made once"
	@echo "make notebooks  re-execute all notebooks in place, outputs kept"
	@echo "make site       the course as a web site, in outputs/site/; no notebook is executed"
	@echo "make browser    every notebook in JupyterLab in Chromium; keeps a picture of each in outputs/browser/"
	@echo "make hostile    damaged, oversized and malicious inputs, each in a process with limits (Linux; minutes)"
	@echo "make gpu        poses, notebooks and speed on a CUDA GPU; writes outputs/gpu/"
	@echo "make exercises  student versions of the exercises, in notebooks/exercises/release/"
	@echo "make doctor     what is installed, what is missing, and what to do about it"
	@echo "make clean      remove .venv, caches and outputs/"
	@echo "PYTHON=/path/to/python3.12 make demo   chooses the interpreter (3.11 or newer)"

$(STAMP): environment.txt pyproject.toml
	@command -v "$(PYTHON)" >/dev/null || \
	  { echo "zsp-lite needs Python 3.11 or newer; '$(PYTHON)' was not found (set PYTHON=/path/to/python3)" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "zsp-lite needs Python 3.11 or newer; '$(PYTHON)' is $$("$(PYTHON)" -V 2>&1) (set PYTHON=/path/to/python3)" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "'$(PYTHON)' comes without venv and ensurepip; install them or set PYTHON=/path/to/python3" >&2; exit 1; }
	@echo "Installing the pinned environment into $(VENV) (once)"
	"$(PYTHON)" -m venv $(VENV)
	$(RUN) -m pip install --disable-pip-version-check -r environment.txt
	$(RUN) -m pip install --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(STAMP)
	OMP_NUM_THREADS=1 $(RUN) -m zsp_lite demo --out "$(OUT)"

# One pytest run: the cells with the tag `nbval-check-output` must reproduce their stored output, the others must run.
# Two processes of one thread each; a file, and so a notebook, stays in one process. The notebooks take longest, so
# they start first.
test: lint
	OMP_NUM_THREADS=1 $(RUN) -m pytest -n 2 --dist loadfile --no-loadscope-reorder --nbval-lax --nbval-current-env \
	  --nbval-cell-timeout=600 --durations=10 $(wildcard notebooks) tests

# Quick: without the checks of annotations.
check: $(STAMP)
	OMP_NUM_THREADS=1 ZSP_LITE_CHECK_ANNOTATIONS=0 $(RUN) -m pytest -n 2 --dist loadfile -p no:nbval -m "not slow" tests

lint: $(STAMP)
	$(RUN) -m ruff format --check .
	$(RUN) -m ruff check .

format: $(STAMP)
	$(RUN) -m ruff format .
	$(RUN) -m ruff check --fix .

# On a copy, so that the tracked notebooks stay as they are, without the outputs that answer a prediction and the
# solutions of the exercises. The root is this folder, as the notebooks link to docs/.
# Open3D brings dash along, whose JupyterLab extension would ask for a build that nothing here needs. Without its
# announcements, JupyterLab does not ask whether to fetch news.
lab: $(STAMP)
	@[ -d $(LAB) ] || { rm -rf $(LAB).new && cp -R notebooks $(LAB).new && $(RUN) -m tools.lab $(LAB).new && \
	  rm -rf $(LAB).new/exercises/source $(LAB).new/exercises/*.db && mv $(LAB).new $(LAB) && \
	  echo "Made $(LAB)/, a copy of notebooks/ that is yours"; }
	@echo "Changes are saved in $(LAB)/. For a fresh copy, move that folder away and run make lab again."
	@[ "$$(id -u)" != 0 ] || echo "You are root, as in most containers. JupyterLab refuses to run as root without --allow-root, so it is given."
	@$(RUN) -m jupyter labextension disable @jupyterlab/apputils-extension:announcements
	$(RUN) -m jupyter lab $$([ "$$(id -u)" != 0 ] || echo --allow-root) \
	  --ServerApp.tornado_settings="{'page_config_data': {'buildCheck': False}}" \
	  --ServerApp.root_dir=. --LabApp.default_url=/lab/tree/$(LAB)

notebooks: $(STAMP)
	$(RUN) -m jupyter nbconvert --to notebook --execute --ExecutePreprocessor.record_timing=False --inplace $(NOTEBOOKS)

# From the stored outputs of the notebooks. A warning, such as a broken link, is an error. What the playground loads is
# written meanwhile, on the other core.
site: $(STAMP)
	OMP_NUM_THREADS=1 $(RUN) -m docs.playground.build outputs/site/docs/playground & playground=$$!; \
	  $(RUN) -m sphinx -q -W --keep-going -c docs/site -d outputs/site-doctrees . outputs/site && \
	  wait $$playground
	@echo "the course site is outputs/site/index.html"

# Skipped where there is no Chromium.
browser: $(STAMP)
	$(RUN) -m pytest -v tests/browser

hostile: $(STAMP)
	$(RUN) -m tests.hostile

# Skipped where there is no CUDA GPU.
gpu: $(STAMP)
	$(RUN) -m tests.gpu

# nbgrader starts the program `alembic`, which is in the environment's bin folder.
exercises: $(STAMP)
	cd notebooks/exercises && PATH="$(CURDIR)/$(VENV)/bin:$$PATH" && \
	  for folder in source/*; do nbgrader generate_assignment --force "$${folder#source/}" || exit 1; done

doctor: $(STAMP)
	$(RUN) -m zsp_lite doctor

clean:
	rm -rf $(VENV) outputs build dist .pytest_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
