# Requires CPython (3.11 or later) and make; each target creates .venv and installs what is missing.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt
PINS := pyproject.toml constraints.txt
COMPILED := hatch_build.py $(wildcard nlfilter_torch/core/kernels/*.[ch])

AS_ROOT := $(if $(filter 0,$(shell id -u)),,sudo -n)
INSTALL_DEBIAN := $(AS_ROOT) apt-get update && $(AS_ROOT) apt-get install -y --no-install-recommends

# Write bytecode even if the environment disables it, so that the processes of tests and benchmarks share it.
export PYTHONDONTWRITEBYTECODE :=

.DELETE_ON_ERROR:
.PHONY: demo test test-oldest lint lint-page types compiler chromium bench bench-quick train pictures figures notebooks wheels docs clean

# The stamp files record the last install, which is repeated when a prerequisite changes.
# torch is installed first, by its exact pin, so that no other package pulls in another build of it.
$(VENV)/.installed: $(PINS) $(COMPILED) | compiler
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) "$$(grep '^torch==' constraints.txt)"
	$(PIP) hatchling editables
	$(PIP) --no-build-isolation -e '.[cli]'
	touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(PIP) --no-build-isolation -e '.[cli,app,notebooks,bench,docs,test]'
	touch $@

# Installs a C compiler for the kernels if there is none.
compiler:
	@command -v cc >/dev/null || { $(INSTALL_DEBIAN) gcc libc6-dev; } >/dev/null 2>&1 \
	|| echo "No C compiler could be installed; torch does the work of the kernels in C, more slowly."

# Installs a browser for the tests of the editor if there is none; without one they are skipped.
chromium:
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit; done; \
	{ $(INSTALL_DEBIAN) chromium; } >/dev/null 2>&1 \
	|| echo "No Chromium could be installed; the editor's tests in the browser will be skipped."

# Pictures of every step in out/, from a photograph that comes with scikit-image.
demo: $(VENV)/.installed
	$(BIN)/nlfilter-torch demo out

# All checks; pytest runs last, so that its summary ends the output. One single-threaded process per core, since several
# threads in several processes would wait for each other. Tests of threads set their own number.
test: $(VENV)/.installed-test chromium
	$(MAKE) --no-print-directory -j2 lint types bench-quick
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

# The quick tests with the oldest torch that pyproject.toml allows, in out/oldest; skipped where pip finds no build of it
# for CPUs.
test-oldest: $(VENV)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.oldest out/oldest

lint: $(VENV)/.installed-test
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	@$(MAKE) --no-print-directory lint-page

# The script and the style sheet of the editor's page; skipped where their linters cannot be installed.
# "make" is written out, as a line with $(MAKE) would run even under make -n.
lint-page:
	@if ! command -v npm >/dev/null; then echo "There is no node here; the editor's page is not linted."; \
	elif ! make --no-print-directory node_modules/.installed; then \
	echo "The linters of package.json could not be installed; the editor's page is not linted."; \
	else npm run --silent lint; fi

node_modules/.installed: package.json
	@npm install --engine-strict --no-package-lock --no-audit --no-fund --loglevel=error --fetch-retries=0 >/dev/null
	@touch $@

types: $(VENV)/.installed-test
	$(BIN)/mypy

# All speed measurements, in ten minutes, on an otherwise idle machine; then an edit in tiles beside busy processes.
bench: $(VENV)/.installed-test
	$(BIN)/python -m benchmarks.speed --out out/speed.json
	$(BIN)/python -m docs.speed out/speed.json
	$(BIN)/python -m benchmarks.busy "detail in tiles"

# Checks that every benchmark runs, on sizes that take seconds. One single-threaded benchmark per core.
bench-quick: export OMP_NUM_THREADS = 1
bench-quick: $(VENV)/.installed-test
	printf '%s\n' $(QUICK) | $(BIN)/python -m benchmarks.quick
	$(BIN)/python -m docs.speed out/quick/speed.json

QUICK := \
	'speed --quick --out out/quick/speed.json' \
	'commands whole --quick' \
	'streaming --quick' \
	'streaming strokes --quick' \
	'streaming memory --quick' \
	'busy --quick sharpen "recolor in tiles"' \
	'commands --quick' \
	'scribbles --quick' \
	'app --side 96 --megapixels 0.05 --repeats 3 --quick' \
	'denoising --quick --megapixel' \
	'denoising --quick --patterns --methods noisy ours' \
	'real_noise --quick' \
	'self_calibration --quick' \
	'error_bars --quick' \
	'coverage --quick' \
	'looks --quick' \
	'detail --quick' \
	'detail --quick --scales' \
	'distributed --ranks 2 --widths 64 --landmarks 20' \
	'docs.tables --long-side 32' \
	'masks --quick' \
	'outlines --quick' \
	'recolor --quick' \
	'colorize --quick' \
	'colorize --quick --lines' \
	'compilation --quick --only export' \
	'launches --quick' \
	'layers points block refinement clusters --quick' \
	'layers functions styles --quick' \
	'prior --quick' \
	'restoration --quick --methods prior' \
	'fits --quick' \
	'points --quick'

# Trains the denoiser further, from the weights of the package, on the pictures of scikit-image and on all of a folder:
# make train PICTURES=folder. A stopped training is resumed; out/denoiser holds its state, weights and curve.
PICTURES ?=
train: $(VENV)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.training --half $(if $(PICTURES),--pictures "$(PICTURES)")

# The pictures of the README and of docs/.
pictures: $(VENV)/.installed
	$(BIN)/python -m docs.detail_pictures docs
	$(BIN)/python -m docs.gallery docs
	$(BIN)/python -m docs.guide_pictures docs/pictures

# Counterparts of the paper's figures and Table I in out/figures, with their numbers, in a few minutes.
figures: $(VENV)/.installed-test
	$(BIN)/python -m docs.figures --out out/figures

# A source distribution and wheels in out/wheels, checked; AArch64 by a cross compiler if one can be installed.
wheels: $(VENV)/.installed
	@{ command -v aarch64-linux-gnu-gcc && command -v qemu-aarch64; } >/dev/null \
	|| { $(INSTALL_DEBIAN) gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user; } >/dev/null 2>&1 || true
	$(BIN)/python build_wheels.py out/wheels

# The documentation as a website in out/docs; warnings of Sphinx are errors.
docs: $(VENV)/.installed-test
	$(BIN)/python -m sphinx -E -W --keep-going -b html -d out/doctrees docs out/docs

# Executes every notebook from its paired script, with small pictures, in a few minutes.
notebooks: $(VENV)/.installed-test
	$(BIN)/python -m docs.notebooks notebooks

clean:
	rm -rf $(VENV) node_modules out dist build .mypy_cache .pytest_cache .ruff_cache .hypothesis
