"""The notebook runs from its first cell to its last, away from the sources, and is stored with its outputs."""

import json
import os
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT

NOTEBOOK = ROOT / "docs" / "first_codesign.ipynb"


def test_every_cell_of_code_is_stored_with_an_output_and_none_with_an_error():
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert len(cells) >= 6
    assert all(cell["outputs"] for cell in cells)
    assert not [output for cell in cells for output in cell["outputs"] if output["output_type"] == "error"]


@pytest.mark.slow
def test_the_notebook_runs(tmp_path, monkeypatch):
    nbformat = pytest.importorskip("nbformat", reason="pip install -e '.[notebook]'")
    client = pytest.importorskip("nbclient", reason="pip install -e '.[notebook]'")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    book = nbformat.read(NOTEBOOK, as_version=4)
    client.NotebookClient(book, timeout=1800, resources={"metadata": {"path": str(tmp_path)}}).execute()
    said = "".join(output.get("text", "") for cell in book.cells for output in cell.get("outputs", []))
    for sentence in ("2 elites in runs/smoke", "proved", "demo.svg", "sampled sum", "wide to each side"):
        assert sentence in said
    assert (tmp_path / "runs" / "smoke" / "report.html").is_file()
