PYTHON ?= python3
ARGS ?= setup=feed tau=noisy

.PHONY: install train test lint

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install -c constraints.txt -e ".[dev]"
	touch $@

train: install
	.venv/bin/python train.py $(ARGS)

test: install
	.venv/bin/python -m pytest -n auto

lint: install
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
