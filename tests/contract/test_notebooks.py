"""Notebooks of the documentation run, and are committed with small outputs."""

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
pytest.importorskip("matplotlib")

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
LARGEST = 400_000  #: size of a notebook with its outputs [bytes]


@pytest.mark.parametrize(
    "name", ["state_estimation", pytest.param("train", marks=pytest.mark.slow)]
)
def test_notebook_runs(name, tmp_path):
    if name == "train":
        pytest.importorskip("stable_baselines3")
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", 4)
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=where).execute()


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.ipynb")), ids=lambda file: file.stem)
def test_notebook_has_small_outputs_and_no_error(file):
    assert file.stat().st_size < LARGEST
    cells = [cell for cell in nbformat.read(file, 4).cells if cell.cell_type == "code"]
    outputs = [output for cell in cells for output in cell.outputs]
    assert {output.output_type for output in outputs} <= {
        "stream",
        "execute_result",
        "display_data",
    }
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.ipynb")), ids=lambda file: file.stem)
def test_notebook_imports_names_that_exist(file):
    """In the quick run, too, which leaves out the training."""
    cells = [cell for cell in nbformat.read(file, 4).cells if cell.cell_type == "code"]
    lines = [line for cell in cells for line in cell.source.splitlines()]
    ours = [line for line in lines if line.startswith(("from quad_gym", "from baselines"))]
    assert ours
    for line in ours:
        exec(line, {})
