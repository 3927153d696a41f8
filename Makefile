.PHONY: sync check test test-all coverage mutants docs bench

sync:      ## install the package and everything for development
	pip install -e '.[dev]'

check:     ## format, lint, types
	ruff format --check .
	ruff check .
	mypy

test:      ## at least one test of everything, in minutes
	pytest -n 2 --dist loadfile --no-loadscope-reorder

test-all:  ## all tests but the slow ones (pytest -m slow)
	pytest -n 2 --dist loadfile --no-loadscope-reorder -m 'not slow'

coverage:  ## test-all, and which lines it does not run
	pytest -n 2 --dist loadfile --no-loadscope-reorder -m 'not slow' --cov --cov-report=term

mutants:   ## small mistakes in the code that the tests must notice; MUTANTS='--only agents-sac' chooses
	python benchmarks/mutants/run.py $(MUTANTS)

docs:      ## build the documentation; a broken link is an error
	mkdocs build --strict

# peers are measured where they are: benchmarks/speed/README.md
PEERS = $(if $(wildcard peers/VDPO),--vdpo peers/VDPO) $(if $(wildcard peers/cleanrl),--cleanrl peers/cleanrl) \
	$(if $(wildcard .venv-torch),--torch-python .venv-torch/bin/python) \
	$(if $(wildcard .venv-sbx),--jax-python .venv-sbx/bin/python)

bench:     ## speed beside the peers, alternating; BENCH='vdpo-64 --threads 1' chooses
	python benchmarks/speed/run.py $(PEERS) $(BENCH)
	python benchmarks/figures.py
