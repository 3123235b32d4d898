PYTHON ?= python3

.PHONY: install train ask test lint docs-figures

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install -c constraints.txt -e ".[dev]"
	touch $@

train: ARGS ?= setup=feed tau=noisy
train: install
	.venv/bin/python train.py $(ARGS)

# Options of ask.py: make ask ARGS="task=driver"
ask: install
	.venv/bin/python ask.py $(ARGS)

test: install
	.venv/bin/python -m pytest -n auto --dist worksteal

lint: install
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

# All of it takes hours; it says how long first. A part: make docs-figures ARGS="--only heldout"
docs-figures: install
	.venv/bin/python benchmarks/docs_figures.py $(ARGS)
