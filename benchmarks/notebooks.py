"""The notebooks, run, with outputs small enough for a repository: ``python -m benchmarks.notebooks notebooks``.

Each ``.py`` in the folder is run in a kernel of its own, and written as ``.ipynb`` beside it, with pictures as JPEG.
What it took is printed: seconds of processor, on all cores together, and of waiting, and bytes of the file.
"""

import argparse
import base64
import io
import resource
import time
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient
from PIL import Image

WIDEST = 1000  # pixels of a picture
QUALITY = 82
WIDGET = "application/vnd.jupyter.widget-view+json"


def run(notebook: Any, folder: Path) -> None:
    """Run all cells in a folder, and shrink what they print and show."""
    client = NotebookClient(
        notebook, timeout=600, kernel_name="python3", record_timing=False, resources={"metadata": {"path": folder}}
    )
    client.execute()
    tidy(notebook)


def tidy(notebook: Any) -> None:
    """Shrink the outputs of a notebook that was run; in place of sliders stands what they showed first."""
    states = notebook.metadata.get("widgets", {}).get("application/vnd.jupyter.widget-state+json", {}).get("state", {})
    first = [output for state in states.values() for output in state.get("state", {}).get("outputs", ())]
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
        cell.metadata = {}
        if cell.cell_type == "code":
            shown = [
                new for output in cell.outputs for new in (first if WIDGET in output.get("data", {}) else [output])
            ]
            cell.outputs = [nbformat.from_dict(smaller(output)) for output in shown]
    notebook.metadata = {"jupytext": {"formats": "ipynb,py:percent"}, "kernelspec": notebook.metadata["kernelspec"]}


def smaller(output: dict[str, Any]) -> dict[str, Any]:
    """An output with its picture as JPEG, and without the text that stands for it."""
    data = output.get("data", {})
    if "image/png" not in data:
        return output
    picture = Image.open(io.BytesIO(base64.b64decode(data["image/png"]))).convert("RGB")
    picture.thumbnail((WIDEST, WIDEST * WIDEST), Image.Resampling.LANCZOS)
    stored = io.BytesIO()
    picture.save(stored, "JPEG", quality=QUALITY, optimize=True)
    return {
        "output_type": "display_data",
        "data": {"image/jpeg": base64.b64encode(stored.getvalue()).decode()},
        "metadata": {},
    }


def processor() -> float:
    """Seconds that processes that have ended took."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Run the scripts of a folder, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="of scripts, without .py; all if none is given")
    given = parser.parse_args()
    for script in sorted(given.folder.glob("*.py")):
        if given.names and script.stem not in given.names:
            continue
        notebook, before, started = jupytext.read(script), processor(), time.perf_counter()
        run(notebook, given.folder)
        target = script.with_suffix(".ipynb")
        nbformat.write(notebook, target)
        print(
            f"{target}: {processor() - before:.0f} s of processor, {time.perf_counter() - started:.0f} s, "
            f"{target.stat().st_size / 1e3:.0f} kB",
            flush=True,
        )


if __name__ == "__main__":
    main()
