"""Every notebook runs from top to bottom, its sliders do what they say, and what is kept of it is source alone."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
PATHS = sorted(NOTEBOOKS.glob("*.ipynb"))
# A kernel that starts on a busy machine and compiles the filter for the first time.
TIMEOUT = 300
pytestmark = pytest.mark.timeout(2 * TIMEOUT)

# Run after the last cell: is a slider's move seen in the replay?
FURTHER = {
    "01_noise.ipynb": """
understated = explain_nis(result.outcomes)
assert "understated" in understated.splitlines()[0], understated
gyro.value, accel.value = 3e-3, 6e-2
fitting = explain_nis(result.outcomes)
assert all(line.endswith("this noise fits.") for line in fitting.splitlines()), fitting
fix.value = 4.0
overstated = explain_nis(result.outcomes)
assert all("overstated" in line for line in overstated.splitlines()), overstated
assert len(result.poses) == len(recording.fixes) - 1
"""
}


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.name)
def test_only_the_source_is_kept(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert f".venv/bin/jupyter lab notebooks/{path.name}" in notebook.cells[0].source
    assert "widgets" not in notebook.metadata
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert (cell.outputs, cell.execution_count) == ([], None)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.name)
def test_it_runs_and_its_sliders_work(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    if path.name in FURTHER:
        notebook.cells.append(nbformat.v4.new_code_cell(FURTHER[path.name]))
    resources = {"metadata": {"path": str(NOTEBOOKS)}}
    NotebookClient(notebook, timeout=TIMEOUT, startup_timeout=TIMEOUT, resources=resources).execute()
    # What a slider's move draws goes into an output widget, with the error if it fails.
    widgets = notebook.metadata.widgets["application/vnd.jupyter.widget-state+json"].state
    shown = [output for widget in widgets.values() if "outputs" in widget.state for output in widget.state.outputs]
    assert any("image/png" in output.get("data", {}) for output in shown)
    assert not any(output.output_type == "error" for output in shown)
