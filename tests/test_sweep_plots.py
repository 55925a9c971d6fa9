"""Plots of sweeps: the kind that suits the axes, and what they show."""

import pickle

import matplotlib.figure
import numpy as np
import pytest
from PIL import Image

from warp_rigid.sweep.result_plots import plot
from warp_rigid.sweep.table import SweepResult


def table(axes, points):
    """Rows whose metric is the sum of the numbers, and a second one that is text."""
    rows = [
        {"run": i, "id": str(i), "seed": 0, **dict(zip(axes, point, strict=True)), "status": "ok"}
        | {"total": sum(v for v in point if not isinstance(v, str)) if i != 1 else None, "word": "x"}
        for i, point in enumerate(points)
    ]
    return SweepResult(rows, {"scene": "s", "axes": axes, "parameters": axes})


@pytest.fixture
def figures(monkeypatch):
    """The figures that were saved."""
    saved, inner = [], matplotlib.figure.Figure.savefig
    monkeypatch.setattr(
        matplotlib.figure.Figure, "savefig", lambda self, *a, **k: saved.append(self) or inner(self, *a, **k)
    )
    return saved


def test_one_axis_of_numbers_makes_lines(tmp_path, figures):
    result = table(["a", "mode"], [(a, mode) for a in (0.0, 1.0, 2.0) for mode in ("u", "v")])
    result.plot(tmp_path / "new" / "p.png")
    lines = figures[0].axes[0].lines
    assert [line.get_label() for line in lines] == ["u", "v"]
    np.testing.assert_allclose(lines[0].get_ydata(), [0, 1, 2])
    np.testing.assert_allclose(lines[1].get_ydata(), [np.nan, 1, 2])
    assert Image.open(tmp_path / "new" / "p.png").size[0] > 300


def test_quantities_with_a_unit_show_it(tmp_path, figures):
    result = table(["mass", "friction"], [(m, f) for m in (1.0, 2.0) for f in (0.1, 0.2)])
    for row in result.rows:
        row["drift"] = row.pop("total")
    result.plot(tmp_path / "p.png", kind="line", x="mass", y="drift")
    assert (figures[0].axes[0].get_xlabel(), figures[0].axes[0].get_ylabel()) == ("mass [kg]", "drift [m]")
    result.plot(tmp_path / "p.png", kind="line", x="friction", y="drift")
    assert figures[1].axes[0].get_xlabel() == "friction"


def test_repeats_make_a_mean_and_a_band(tmp_path, figures):
    result = table(["a"], [(0,), (9,), (0,), (2,)])
    result.rows[2]["total"] = 4
    result.plot(tmp_path / "p.svg")
    np.testing.assert_allclose(figures[0].axes[0].lines[0].get_ydata(), [2, 2, np.nan])
    assert len(figures[0].axes[0].collections) == 1
    assert (tmp_path / "p.svg").read_text().lstrip().startswith("<?xml")


def test_two_axes_of_numbers_make_heat_maps(tmp_path, figures):
    points = [(a, b, m) for m in ("u", "v") for a in (0, 1, 2) for b in (0.0, 0.5)]
    plot(table(["a", "b", "mode"], points), tmp_path / "p.png", kind="heatmap", y="total")
    first, second, bar = figures[0].axes
    assert (first.get_title(), second.get_title(), bar.get_ylabel()) == ("u", "v", "total")
    np.testing.assert_allclose(
        np.ma.filled(first.collections[0].get_array().astype(float), np.nan), [[0, 1, 2], [np.nan, 1.5, 2.5]]
    )
    plot(table(["a", "b"], [(a, b) for a in range(6) for b in range(5)]), tmp_path / "p.png")
    assert len(figures[1].axes) == 2


def test_second_axis_of_few_numbers_makes_one_line_for_each(tmp_path, figures):
    table(["a", "b"], [(a, b) for a in range(9) for b in (4, 6)]).plot(tmp_path / "p.png")
    (axes,) = figures[0].axes
    assert [line.get_label() for line in axes.lines] == ["4", "6"] and axes.get_legend().get_title().get_text() == "b"


def test_scattered_points_make_a_matrix(tmp_path, figures):
    rng = np.random.default_rng(0)
    plot(table(["a", "b"], rng.random((20, 2)).tolist()), tmp_path / "p.png")
    assert len(figures[0].axes) == 9


def test_words_are_an_axis_too(tmp_path, figures):
    plot(table(["mode"], [("u",), ("w",), ("v",)]), tmp_path / "p.png")
    panel = figures[0].axes[0]
    assert [tick.get_text() for tick in panel.get_xticklabels()] == ["u", "v", "w"]
    # Words have no order, so no line joins them.
    assert panel.lines[0].get_linestyle() == "None"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"y": "totl"}, "column: must be a column, got"),
        ({"x": "b"}, "column: must be a column, got"),
        ({"y": "word"}, "y must be a numeric column"),
        ({"kind": "pie"}, "kind: must be one of"),
        ({"kind": "heatmap"}, "requires two numeric axes"),
        ({"path": "p.bmp"}, "plot: must end in"),
    ],
)
def test_mistakes_are_named(arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        plot(table(["a"], [(1,), (2,)]), **{"path": tmp_path / "p.png"} | arguments)
    with pytest.raises(ValueError, match="requires at least one row and one axis"):
        plot(table(["a"], []), tmp_path / "p.png")


def test_an_axis_is_refused_as_the_metric(tmp_path):
    with pytest.raises(ValueError, match=r"y must be a metric \(total"):
        table(["a", "b"], [(a, b) for a in range(6) for b in range(5)]).plot(tmp_path / "p.png", x="a", y="b")


def test_a_figure_can_be_stored():
    """Its class must be one that pickle finds by its name."""
    figure = plot(table(["x"], [(1,), (2,), (3,)]))
    again = pickle.loads(pickle.dumps(figure))
    assert len(again.axes) == len(figure.axes) and again._repr_png_()[1:4] == b"PNG"
