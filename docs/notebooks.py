"""Runs the notebooks, and shrinks their outputs for the repository: ``python -m docs.notebooks notebooks``.

Each ``.py`` in the folder is run in its own kernel and written as ``.ipynb`` beside it, with pictures as JPEG. Prints
CPU seconds over all cores, elapsed seconds, and the size of the file.
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

WIDEST = 1000  # largest width of a picture in pixels
QUALITY = 82
WIDGET = "application/vnd.jupyter.widget-view+json"


def run(notebook: Any, folder: Path) -> None:
    """Run all cells with ``folder`` as working directory, and shrink their outputs."""
    client = NotebookClient(
        notebook,
        timeout=600,
        kernel_name="python3",
        record_timing=False,
        coalesce_streams=True,  # else text is split by when it was printed
        resources={"metadata": {"path": folder}},
    )
    client.execute()
    tidy(notebook)


def tidy(notebook: Any) -> None:
    """Shrink the outputs of a notebook that was run; widgets are replaced by their first outputs."""
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
    """Convert the picture of an output to JPEG, and drop its text representation."""
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
    """CPU seconds of child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Run all scripts of a folder, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="names of scripts, without .py; default: all")
    options = parser.parse_args()
    for script in sorted(options.folder.glob("*.py")):
        if options.names and script.stem not in options.names:
            continue
        notebook, before, started = jupytext.read(script), processor(), time.perf_counter()
        run(notebook, options.folder)
        target = script.with_suffix(".ipynb")
        nbformat.write(notebook, target)
        print(
            f"{target}: {processor() - before:.0f} s of CPU time, {time.perf_counter() - started:.0f} s, "
            f"{target.stat().st_size / 1e3:.0f} kB",
            flush=True,
        )


if __name__ == "__main__":
    main()
