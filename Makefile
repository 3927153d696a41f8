.PHONY: sync check test test-all docs

sync:      ## install the package and everything for development
	pip install -e '.[dev]'

check:     ## format, lint, types
	ruff format --check .
	ruff check .
	mypy

test:      ## everything that takes seconds
	pytest -n 2 --dist loadfile

test-all:  ## with the tests that train for minutes
	pytest -m ''

docs:      ## build the documentation; a broken link is an error
	mkdocs build --strict
