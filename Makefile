# Plain entry points; each sets up .venv first (tools/setup), which takes no time when nothing changed.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help demo test bench lint clean firmware-codec firmware-test vcan-test
PYTHON := .venv/bin/python
# Of the firmware's receiver; longer where it runs unattended.
FUZZ_SECONDS ?= $(if $(filter true,$(CI)),60,5)

help:
	@echo "make demo    set up, then run a simulated drive and the companion side by side"
	@echo "make test    set up, then check style and types and run all tests"
	@echo "make lint    check style and types only"
	@echo "make bench   measure the hot paths"
	@echo "make vcan-test     the tests on a real CAN interface alone"
	@echo "make firmware-codec    write the firmware's C codec anew from dbc/ipmsm_can.dbc"
	@echo "make firmware-test     test the firmware's C library: sanitizers, mutants, fuzzing, Cortex-M4F"
	@echo "make clean   remove everything that was generated, .venv included"

demo:
	@tools/setup run
	.venv/bin/ipmsm-can demo

lint:
	@tools/setup test
	.venv/bin/ruff check .
	.venv/bin/mypy --strict

test: lint
	$(PYTHON) -m pytest -m "not vcan" -n 2 --dist loadfile
	$(MAKE) firmware-test
	$(MAKE) vcan-test

vcan-test:
	@tools/setup test
	@# Exit code 77 of tools/vcan/run: no CAN interface can be had here.
	@code=0; \
	tools/vcan/run --limit 1500 env IPMSM_CAN_REQUIRE_VCAN=1 $(PYTHON) -m pytest tests/vcan || code=$$?; \
	if [ $$code = 77 ] && [ "$$CI" = true ]; then \
		echo "make test: FAILED: the tests on a real CAN interface must run where CI=true"; exit 1; \
	elif [ $$code = 77 ]; then \
		echo "make test: SKIPPED: the tests on a real CAN interface (tests/vcan)"; \
	else exit $$code; fi

bench:
	@tools/setup test
	$(PYTHON) -m tools.bench

firmware-codec:
	@tools/setup test
	$(PYTHON) -m tools.firmware_codec
	$(PYTHON) -m tools.firmware_vectors

firmware-test:
	@tools/setup test
	$(MAKE) -s -C firmware_stub test coverage mutants PYTHON=$(abspath $(PYTHON))
	@if command -v clang >/dev/null || [ "$$CI" = true ]; then \
		$(MAKE) -s -C firmware_stub fuzz SECONDS=$(FUZZ_SECONDS); \
	else echo "make firmware-test: SKIPPED: fuzzing the receiver needs clang"; fi
	@if { command -v arm-none-eabi-gcc && command -v qemu-system-arm; } >/dev/null || [ "$$CI" = true ]; then \
		$(MAKE) -s -C firmware_stub cortex-m4; \
	else echo "make firmware-test: SKIPPED: the Cortex-M4F needs arm-none-eabi-gcc and qemu-system-arm"; fi

clean:
	$(MAKE) -s -C firmware_stub clean
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist out *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
