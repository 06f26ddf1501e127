"""Every notebook runs, has the cells of its paired script, and stores small results of the kinds that it produces."""

import base64
import io
from collections.abc import Iterator
from pathlib import Path

import jupytext
import nbformat
import pytest
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.util import run_sync
from PIL import Image

from docs.notebooks import WIDEST, tidy

FOLDER = Path(__file__).parents[2] / "notebooks"
SCRIPTS = sorted(FOLDER.glob("*.py"))
# Drags the first slider of the first notebook and prints what was drawn.
DRAG = """
drawn = []
display = drawn.append
sliders.widget.children[0].value = 0.5
print(len(drawn), drawn[1].axes[0].get_legend().get_texts()[1].get_text())
"""


def test_there_are_notebooks() -> None:
    assert len(SCRIPTS) == 5
    assert {script.stem for script in SCRIPTS} == {notebook.stem for notebook in FOLDER.glob("*.ipynb")}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_paired(script: Path) -> None:
    """The cells are the same; ``make notebooks`` updates them."""
    stored = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    cells = [(cell.cell_type, cell.source) for cell in stored.cells]
    assert cells == [(cell.cell_type, cell.source) for cell in jupytext.read(script).cells]


def kinds(notebook: nbformat.NotebookNode) -> list[list[str]]:
    """Kinds of output of each cell, without their text, which differs between machines."""
    return [
        [min(output.data) if "data" in output else output.output_type for output in cell.get("outputs", [])]
        for cell in notebook.cells
    ]


def test_results_are_small_pictures_and_text() -> None:
    """Readable without running them: no widgets, no errors, and two megabytes in total."""
    notebooks = sorted(FOLDER.glob("*.ipynb"))
    assert sum(path.stat().st_size for path in notebooks) < 2_000_000
    for path in notebooks:
        notebook = nbformat.read(path, as_version=4)
        counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
        assert counts == list(range(1, len(counts) + 1))
        shown = [kind for cell in kinds(notebook) for kind in cell]
        assert set(shown) <= {"image/jpeg", "stream", "text/plain", "text/html", "text/markdown"}
        assert shown.count("image/jpeg") >= 3
        for cell in notebook.cells:
            for output in cell.get("outputs", []):
                if "image/jpeg" in output.get("data", {}):
                    picture = Image.open(io.BytesIO(base64.b64decode(output.data["image/jpeg"])))
                    assert 100 < picture.width <= WIDEST


@pytest.fixture(scope="module")
def kernel() -> Iterator[AsyncKernelManager]:
    """One kernel for all notebooks, since its start and the imports take longer than most notebooks."""
    manager = AsyncKernelManager(kernel_name="python3")
    yield manager
    run_sync(manager.shutdown_kernel)(now=True)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:(zmq|jupyter_client|tornado|traitlets|asyncio)")
def test_runs(script: Path, tmp_path: Path, kernel: AsyncKernelManager) -> None:
    notebook = jupytext.read(script)
    if script.stem == "01_first_filter":
        notebook.cells.append(nbformat.v4.new_code_cell(DRAG))
    forget = nbformat.v4.new_code_cell(f"%reset -f\n%cd -q {tmp_path}")  # as in a new kernel
    notebook.cells.insert(0, forget)
    resources = {"metadata": {"path": tmp_path}}
    client = NotebookClient(notebook, km=kernel, timeout=300, coalesce_streams=True, resources=resources)
    client.execute()
    assert client.kc is not None
    client.kc.stop_channels()
    notebook.cells.pop(0)
    warned = [
        output.text
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if output.output_type == "stream" and output.name == "stderr"
    ]
    assert not warned
    if script.stem == "01_first_filter":
        assert notebook.cells.pop().outputs[-1].text == "2 f(λ) for alpha = (0.5, 3, 4, 1.05)\n"
    tidy(notebook)
    assert kinds(notebook) == kinds(nbformat.read(script.with_suffix(".ipynb"), as_version=4))  # else: make notebooks
