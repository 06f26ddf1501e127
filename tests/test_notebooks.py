"""Every notebook runs, and is the same as the script it is paired with, without what running it printed."""

from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"
SCRIPTS = sorted(FOLDER.glob("*.py"))
# Drags the first slider of the first notebook and tells what was drawn then.
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
    """Same cells in both; refresh with ``make notebooks``."""
    stored = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    cells = [(cell.cell_type, cell.source) for cell in stored.cells]
    assert cells == [(cell.cell_type, cell.source) for cell in jupytext.read(script).cells]
    for cell in stored.cells:
        assert not cell.get("outputs")
        assert not cell.get("execution_count")


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:(zmq|jupyter_client|tornado|traitlets|asyncio)")
def test_runs(script: Path, tmp_path: Path) -> None:
    notebook = jupytext.read(script)
    if script.stem == "01_first_filter":
        notebook.cells.append(nbformat.v4.new_code_cell(DRAG))
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    warned = [
        output.text
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if output.output_type == "stream" and output.name == "stderr"
    ]
    assert not warned
    pictures = [output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in str(output)]
    assert len(pictures) >= 3
    if script.stem == "01_first_filter":
        assert notebook.cells[-1].outputs[-1].text == "2 f(λ) for alpha = (0.5, 3, 4, 1.05)\n"
