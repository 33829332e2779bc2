# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3.11
PYTHON := $(shell command -v $(PYTHON) || command -v python3)
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: demo test test-slow test-gpu lint setup clean

demo: $(STAMP)
	$(BIN)/python -m jobs.demo

test: $(STAMP) lint
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow --timeout 3600

test-gpu: $(STAMP)
	$(BIN)/python -m pytest tests/gpu -m "gpu or not gpu"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

setup: $(STAMP)

# constraints.txt pins every version; torch==2.13.0 takes a CPU build where pip is told of one, CUDA's elsewhere
$(STAMP): pyproject.toml constraints.txt Makefile
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25"
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable ".[dev,deepspeed,onnx,rerank]"
	@touch $(STAMP)

clean:
	rm -rf .venv outputs data build *.egg-info .pytest_cache .mypy_cache .ruff_cache
