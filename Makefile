# A fresh machine needs CPython (3.11 or later) and make; each target makes .venv and installs what it lacks.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt
PINS := pyproject.toml constraints.txt
COMPILED := hatch_build.py $(wildcard nlfilter_torch/core/kernels/*.[ch])

AS_ROOT := $(if $(filter 0,$(shell id -u)),,sudo -n)
INSTALL_DEBIAN := $(AS_ROOT) apt-get update && $(AS_ROOT) apt-get install -y --no-install-recommends

# Modules are compiled once for all processes of tests and benchmarks, whatever the environment says.
export PYTHONDONTWRITEBYTECODE :=

.DELETE_ON_ERROR:
.PHONY: demo test lint types compiler chromium bench bench-quick train pictures figures notebooks wheels docs clean

# The stamps are older than the pins whenever an install is due; a second run finds nothing to do.
# torch comes first, by its exact pin, so that nothing else draws in another build of it.
$(VENV)/.installed: $(PINS) $(COMPILED) | compiler
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) "$$(grep '^torch==' constraints.txt)"
	$(PIP) hatchling editables
	$(PIP) --no-build-isolation -e '.[cli]'
	touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(PIP) --no-build-isolation -e '.[cli,app,notebooks,bench,docs,test]'
	touch $@

# Compiles the kernels in C.
compiler:
	@command -v cc >/dev/null || { $(INSTALL_DEBIAN) gcc libc6-dev; } >/dev/null 2>&1 \
	|| echo "No C compiler could be installed; torch does the work of the kernels in C, more slowly."

# The browser that the editor is tested in; without one those tests are skipped, and say so.
chromium:
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit; done; \
	{ $(INSTALL_DEBIAN) chromium; } >/dev/null 2>&1 \
	|| echo "No Chromium could be installed; the editor's tests in the browser will be skipped."

# A picture of every step, from a photograph that comes with scikit-image, in out/.
demo: $(VENV)/.installed
	$(BIN)/nlfilter-torch demo out

# Everything that has to hold; pytest comes last, so that its count closes the output. A process for every core, of one
# thread each: several threads in several processes would wait for each other. Tests of threads set their own number.
test: $(VENV)/.installed-test chromium
	$(MAKE) --no-print-directory -j2 lint types bench-quick
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

lint: $(VENV)/.installed-test
	$(BIN)/ruff format --check
	$(BIN)/ruff check

types: $(VENV)/.installed-test
	$(BIN)/mypy

# All figures of speed, in ten minutes; on a machine that does nothing else meanwhile.
bench: $(VENV)/.installed-test
	$(BIN)/python -m benchmarks.speed --out out/speed.json
	$(BIN)/python -m benchmarks.report out/speed.json

# Every benchmark once, on a size that takes seconds: that it runs, not how fast. One of one thread for every core.
bench-quick: export OMP_NUM_THREADS = 1
bench-quick: $(VENV)/.installed-test
	printf '%s\n' $(QUICK) | xargs -P "$$(getconf _NPROCESSORS_ONLN)" -I '{}' \
	sh -c 'told="$$($(BIN)/python -m benchmarks.{} 2>&1)"; failed=$$?; printf "%s\n" "{}" "$$told"; exit $$failed'
	$(BIN)/python -m benchmarks.report out/quick/speed.json

QUICK := \
	'speed --quick --out out/quick/speed.json' \
	'whole --quick' \
	'streaming --quick' \
	'streaming_strokes --quick' \
	'streaming_cpu --quick' \
	'streaming_busy --quick' \
	'app --side 96 --megapixels 0.05' \
	'looks --quick' \
	'detail --quick' \
	'detail --quick --scales' \
	'distributed --ranks 2 --widths 64 --landmarks 20' \
	'tables --long-side 32' \
	'masks --quick' \
	'recolor --quick' \
	'compilation --quick --only export' \
	'memory --side 128 --repeats 1' \
	'fuzz --cases 20'

# The weights of the denoiser, from nothing, with their figures and learning curve: about an hour on a processor with AMX.
# A training that was stopped goes on.
train: $(VENV)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.train_denoiser --half --out out/denoiser
	cp out/denoiser/denoiser.safetensors nlfilter_torch/nn/
	cp out/denoiser/denoiser.json docs/
	cp out/denoiser/curve.png docs/denoiser.png

# The pictures of the README and of the pages of docs.
pictures: $(VENV)/.installed
	$(BIN)/python -m benchmarks.detail_pictures docs
	$(BIN)/python -m benchmarks.gallery docs
	$(BIN)/python -m benchmarks.guide_pictures docs/pictures

# Counterparts of the paper's figures and Table I in out/figures, with their numbers, in a few minutes.
figures: $(VENV)/.installed-test
	$(BIN)/python -m benchmarks.figures --out out/figures

# A source distribution and wheels in out/wheels, checked; AArch64 by a cross compiler, where one can be installed.
wheels: $(VENV)/.installed
	@{ command -v aarch64-linux-gnu-gcc && command -v qemu-aarch64; } >/dev/null \
	|| { $(INSTALL_DEBIAN) gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user; } >/dev/null 2>&1 || true
	$(BIN)/python build_wheels.py out/wheels

# The documentation as a website in out/docs; whatever its generator would warn of is an error.
docs: $(VENV)/.installed-test
	$(BIN)/python -m sphinx -E -W --keep-going -b html -d out/doctrees docs out/docs

# Every notebook from the script it is paired with, run, with small pictures, in some minutes.
notebooks: $(VENV)/.installed-test
	$(BIN)/python -m benchmarks.notebooks notebooks

clean:
	rm -rf $(VENV) out dist build .mypy_cache .pytest_cache .ruff_cache .hypothesis
