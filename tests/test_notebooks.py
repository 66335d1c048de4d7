"""The notebooks: each one runs from top to bottom, is short, and stores small outputs."""

import re
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)


def test_the_notebooks_are_numbered_from_one():
    assert [file.stem[:3] for file in NOTEBOOKS] == [f"{number:02d}_" for number in range(1, len(NOTEBOOKS) + 1)]
    assert NOTEBOOKS


@each_notebook
def test_it_is_short_and_says_x64_first(file):
    notebook = nbformat.read(file, as_version=4)
    nbformat.validate(notebook)
    assert len(notebook.cells) <= 15
    assert notebook.cells[0].cell_type == "markdown"
    first = next(cell for cell in notebook.cells if cell.cell_type == "code")
    assert 'jax.config.update("jax_enable_x64", True)' in first.source


@each_notebook
def test_its_outputs_are_stored_and_small(file):
    notebook = nbformat.read(file, as_version=4)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any(output.output_type == "display_data" for output in outputs)
    assert not any(output.output_type == "error" for output in outputs)
    assert file.stat().st_size < 250_000


@each_notebook
def test_it_ends_with_what_was_learnt_and_a_link_to_the_documentation(file):
    last = nbformat.read(file, as_version=4).cells[-1]
    assert last.cell_type == "markdown" and last.source.startswith("## What was learnt\n")
    links = re.findall(r"\]\((\.\./docs/pages/\S+?)\)", last.source)
    assert links
    for page in links:
        assert (FOLDER / page).exists(), page


@pytest.mark.slow
@each_notebook
def test_it_runs_from_top_to_bottom(file):
    notebook = nbformat.read(file, as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}})
    client.execute()  # a cell that fails raises
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
