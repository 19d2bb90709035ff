# `make run` and `make test` are all a newcomer needs; both build .venv from the lock files first.
PYTHON ?= python3
# On a Raspberry Pi: make VENV_FLAGS=--system-site-packages, so that the system's picamera2 is seen.
VENV_FLAGS ?=
VENV := .venv
PIP := $(VENV)/bin/python -m pip --disable-pip-version-check --quiet

.PHONY: run test test-long lint lock clean

run: $(VENV)/.runtime
	@exec $(VENV)/bin/steadfix run $(CONFIG)

test: lint
	$(VENV)/bin/python -m pytest -m "not long"

test-long: $(VENV)/.development
	$(VENV)/bin/python -m pytest -m long --timeout=3600

lint: $(VENV)/.development
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Steadfix needs Python 3.11 or newer; \`$(PYTHON)\` is older. Name another: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV_FLAGS) $(VENV) || \
	  { rm -rf $(VENV); echo "No virtual environment could be made; on Debian: apt install python3-venv" >&2; exit 1; }

$(VENV)/.runtime: requirements.lock pyproject.toml | $(VENV)/bin/python
	@echo "Installing Steadfix into $(VENV) (once)"
	@$(PIP) install --no-deps -r requirements.lock
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.development: requirements-dev.lock $(VENV)/.runtime
	@echo "Installing the test tools into $(VENV) (once)"
	@$(PIP) install --no-deps -r requirements-dev.lock
	@touch $@

# Universal locks: one file for every Python >= 3.11 and platform, versions only. No hashes, because
# Raspberry Pi OS installs from wheels of its own build. They are complete, hence --no-deps above: what
# pyproject.toml says a package does not need must not come after all.
LOCK := $(VENV)/bin/uv pip compile --quiet --universal --python-version 3.11 --no-emit-index-url --no-emit-find-links \
  --no-annotate --no-header --upgrade pyproject.toml
lock:
	$(LOCK) --extra build --output-file requirements.lock
	$(LOCK) --extra build --extra dev --constraint requirements.lock --output-file requirements-dev.lock

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache
