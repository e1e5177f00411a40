"""Files are whole images, the same run gives the same bytes, and matplotlib is left as it was."""

import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from PIL import Image

from rtcd_jax.analysis.report.funnels import draw_funnels
from rtcd_jax.analysis.report.page import draw_figures
from rtcd_jax.analysis.report.reading import read_run
from tests.analysis.report.runs import finished
from tests.paths import ROOT


@pytest.fixture
def run(tmp_path):
    return finished(tmp_path / "run")


@pytest.mark.thorough
def test_the_files_are_whole_images(run):
    paths = draw_figures(read_run(run))
    for path in paths[::2]:
        with Image.open(path) as image:
            assert image.size[0] == 1440
            assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 10
    for path in paths[1::2]:
        assert path.read_bytes().startswith(b"%PDF-")
        assert path.read_bytes().rstrip().endswith(b"%%EOF")


@pytest.mark.thorough
def test_the_same_run_gives_the_same_bytes_whatever_the_user_s_style_which_is_left_as_it_was(run):
    before = [path.read_bytes() for path in draw_funnels(read_run(run))]
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "red", "figure.dpi": 30}):
        mine = dict(matplotlib.rcParams)
        assert [path.read_bytes() for path in draw_funnels(read_run(run))] == before
        assert dict(matplotlib.rcParams) == mine


@pytest.mark.thorough
def test_a_report_needs_neither_jax_nor_a_display(run):
    script = (
        "import sys; from pathlib import Path; from rtcd_jax.analysis.report import report\n"
        "assert 'matplotlib' not in sys.modules\n"
        "report([Path(sys.argv[1])])\n"
        "print(*({'jax', 'matplotlib.pyplot', 'orbax'} & sys.modules.keys()))"
    )
    root = ROOT
    done = subprocess.run([sys.executable, "-c", script, run], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
