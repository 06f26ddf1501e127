"""Run the quick tests with the oldest torch that pyproject.toml allows, in an environment of its own.

Only a build of torch for CPUs is installed, since others come with several gigabytes of libraries for CUDA. Where pip
finds none, the tests are skipped, and the reason is printed.
"""

import json
import subprocess
import sys
import tomllib
import venv
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]


def oldest_torch() -> str:
    """The oldest version of torch that the package can be installed with."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    torch = next(Requirement(line) for line in project["dependencies"] if Requirement(line).name == "torch")
    return next(specifier.version for specifier in torch.specifier if specifier.operator == ">=")


def offered(version: str) -> dict[str, Any] | str:
    """What pip would install for this version of torch, or its error."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"]
    command += ["--retries", "1", "--report", "-", f"torch=={version}"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        return next(line for line in result.stderr.splitlines() if line.startswith("ERROR"))
    download: dict[str, Any] = json.loads(result.stdout)["install"][0]
    return download


def needs_cuda(download: dict[str, Any]) -> bool:
    """Whether a build of torch depends on libraries for CUDA on this machine."""
    needed = [Requirement(line) for line in download["metadata"].get("requires_dist", [])]
    return any(
        package.name.startswith("nvidia") and (package.marker is None or package.marker.evaluate({"extra": ""}))
        for package in needed
    )


def build_for_cpus(version: str) -> tuple[str | None, str]:
    """Address of the build of torch for CPUs that pip finds, or None, and the reason if there is none."""
    download = offered(version)
    if isinstance(download, str):
        return None, f"pip finds no torch {version}: {download}"
    if needs_cuda(download):
        return (
            None,
            "pip finds only a build with libraries for CUDA; set PIP_INDEX_URL to an index with builds for CPUs",
        )
    return str(download["download_info"]["url"]), ""


def main(folder: Path) -> int:
    """Make the environment in a folder, and run the tests in it; returns the exit status."""
    version = oldest_torch()
    address, reason = build_for_cpus(version)
    if address is None:
        print(f"Skipped the tests with torch {version}: {reason}")
        return 0
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    pins = folder / "constraints.txt"  # without those of packages that follow the version of torch
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins.write_text("\n".join(line for line in lines if "torch" not in line), encoding="utf-8")
    install = [python, "-m", "pip", "install", "--quiet", "-c", pins]
    subprocess.run([*install, address], check=True)
    subprocess.run([*install, "hatchling", "editables"], check=True)
    extras = "cli,app,notebooks,bench,docs,test"
    subprocess.run([*install, "--no-build-isolation", "-e", f"{ROOT}[{extras}]", f"torch=={version}"], check=True)
    return subprocess.run([python, "-m", "pytest", "-n", "auto", "-m", "not slow"], cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]).resolve()))
