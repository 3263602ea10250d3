# `make` writes the site with the page of an interactive push, `make push` opens that page alone.
python = $(firstword $(wildcard .venv/bin/python) python3)

site:
	NO_MKDOCS_2_WARNING=1 $(python) -m mkdocs build -q --strict

push:
	$(python) docs/push/make.py --open

.PHONY: site push
