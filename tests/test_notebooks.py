"""The notebooks of the tutorials run, and end in a figure that can be published: units on the axes, and a legend."""

import json
import re

import numpy as np
import pytest

from tests.pages import NOTEBOOKS, notebook_tool


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_ends_in_a_figure_with_units_and_a_legend(path, tmp_path, monkeypatch):
    """A sweep twice in one folder: the table that the first run has written is replaced, and the result is the same."""
    monkeypatch.chdir(tmp_path)
    notebook = json.loads(path.read_text())
    figures = notebook_tool().run_cells(notebook)
    if path.stem == "sweep":
        first, figures = figures, notebook_tool().run_cells(notebook)
        for one, other in zip(first[-1].axes[0].get_lines(), figures[-1].axes[0].get_lines(), strict=True):
            np.testing.assert_array_equal(one.get_xydata(), other.get_xydata())
    (axes,) = figures[-1].axes
    for label in (axes.get_xlabel(), axes.get_ylabel()):
        assert re.search(r"\w \[[^\]]+\]$", label), label
    assert axes.get_legend() is not None and len(axes.get_lines()) >= 3
