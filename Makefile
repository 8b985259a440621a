# `make demo` and `make test` set up .venv first; only Python (3.11 or newer) and make need to be there.
BIN := .venv/bin
STAMP := .venv/.installed
DEMO_RUN := outputs/demo
LOGDIR := outputs
PYTEST_ARGS :=

# Prints a command as a user would type it, then runs it.
define run
@echo '$$ $(1)'
@$(BIN)/$(1)
endef

.PHONY: help setup demo test lint format bench tensorboard clean

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' Makefile

setup: $(STAMP)  ## Create .venv and install pnet (PYTHON=... names the interpreter)

# The stamp is written last, so an install that failed or was interrupted runs again.
$(STAMP): pyproject.toml constraints.txt
	@PYTHON='$(PYTHON)' sh .ci/setup
	@touch $@

demo: $(STAMP)  ## Generate scenes of TN34, train, evaluate and write the report (outputs/demo)
	$(call run,pnet-generate part=tn34 protocol=demo)
	$(call run,pnet-train part=tn34 protocol=demo run_dir=$(DEMO_RUN) ckpt=auto)
	$(call run,pnet-evaluate run=$(DEMO_RUN))
	$(call run,pnet-report run=$(DEMO_RUN))

# One thread a worker: two workers with a thread pool each would fight for the same cores.
test: export OMP_NUM_THREADS := 1
test: $(STAMP)  ## Run the tests (PYTEST_ARGS=... adds options)
	$(call run,$(strip pytest -n 2 --dist loadfile $(PYTEST_ARGS)))

lint: $(STAMP)  ## Check style, format, types and the direction of imports
	$(call run,ruff check)
	$(call run,ruff format --check)
	$(call run,mypy)
	$(call run,lint-imports)

format: $(STAMP)  ## Format the code and mend what ruff can mend
	$(call run,ruff format)
	$(call run,ruff check --fix)

bench: $(STAMP)  ## Run every benchmarks/bench_*.py
	@set -e; for bench in $(sort $(wildcard benchmarks/bench_*.py)); do \
		echo "$$ python $$bench"; $(BIN)/python $$bench; done

tensorboard: $(STAMP)  ## Show the curves of the runs under outputs/ (LOGDIR=... another folder)
	$(call run,tensorboard --logdir $(LOGDIR))

clean:  ## Remove caches and build products; .venv and outputs/ stay
	rm -rf build dist .coverage .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
