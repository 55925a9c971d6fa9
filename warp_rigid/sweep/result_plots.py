"""Plots of a sweep: lines over one axis, a heat map over two, or a scatter matrix over more."""

from pathlib import Path
from typing import Any

import numpy as np

from warp_rigid.checks import one_of
from warp_rigid.extras import need
from warp_rigid.files.atomic import atomic_file

KINDS = ("line", "heatmap", "scatter")
SUFFIXES = (".png", ".svg", ".pdf")
MAX_LINES = 12
FEW = 4
"""Values of a second axis up to which lines are drawn instead of a heat map."""


def check_plot(path: Any, kind: str | None = None) -> None:
    """Check the arguments of a plot before anything runs.

    Raises:
        ValueError: The suffix or the kind is unknown.
        ModuleNotFoundError: matplotlib is not installed.
    """
    need("matplotlib")
    if path is not None and Path(path).suffix not in SUFFIXES:
        raise ValueError(f"plot: must end in {', '.join(SUFFIXES)}, got {path}")
    if kind is not None:
        one_of("kind", kind, KINDS)


def plot(result: Any, path: Any = None, x: str | None = None, y: str | None = None, kind: str | None = None) -> Any:
    """Plot the rows of a SweepResult; see SweepResult.plot."""
    check_plot(path, kind)
    from warp_rigid.sweep.shown_figure import ShownFigure

    if not result.rows or not result.axes:
        raise ValueError("plot: requires at least one row and one axis")
    y = y or _first_number(result)
    numeric = [name for name in result.axes if _is_number(result.column(name))]
    x = x or max(numeric or result.axes, key=lambda name: len(set(result.column(name).tolist())))
    values = result.column(y)
    if not (_is_number(values) or values.dtype == bool):
        raise ValueError(f"plot: y must be a numeric column, got {y}")
    result.column(x)
    if y in result.axes:
        raise ValueError(f"plot: y must be a metric ({', '.join(result.metrics)}), got the axis {y}")
    others = [name for name in result.axes if name != x]
    kind = kind or _kind(result, x, [name for name in numeric if name != x])
    figure = ShownFigure()
    if kind == "line":
        _lines(figure, result, x, y, others)
    elif kind == "heatmap":
        along = next((name for name in others if name in numeric), None)
        if along is None or x not in numeric:
            raise ValueError("plot: a heat map requires two numeric axes")
        _heat_maps(figure, result, x, along, y, [name for name in others if name != along])
    else:
        _scatter_matrix(figure, result, [*numeric, y])
    if path is not None:
        with atomic_file(path) as temporary:
            figure.savefig(temporary)
    return figure


def _kind(result: Any, x: str, others: list[str]) -> str:
    """Lines for one axis, or if the other axes have no numbers or are one of few values; a heat map for a grid.

    Else a scatter matrix.
    """
    if not others:
        return "line"
    width, height = (len(set(result.column(name).tolist())) for name in (x, others[0]))
    if len(others) > 1 or width * height > 2 * len(result):
        return "scatter"
    return "line" if height <= FEW else "heatmap"


def _lines(figure: Any, result: Any, x: str, y: str, others: list[str]) -> None:
    """One line per combination of the other axes; repeats are drawn as their mean with a min-max band.

    Over words, which have no order, the means are points and the band is a bar.
    """
    axes = figure.subplots()
    table = _table(result, x, y, others)
    words = not _is_number(table["x"].to_numpy())
    if words:
        table["x"] = [str(value) for value in result.column(x).tolist()]
    groups = list(table.groupby("label", sort=False))
    for rank, (label, rows) in enumerate(groups[:MAX_LINES]):
        stops = rows.groupby("x")["y"].agg(["mean", "min", "max", "size"])
        ticks = np.arange(len(stops)) if words else stops.index.to_numpy(float)
        # Decreasing widths keep coincident lines visible.
        width = 1.5 + 1.5 * max(0, min(len(groups), 4) - 1 - rank)
        style: Any = {"linestyle": "none"} if words else {"linewidth": width}
        line = axes.plot(ticks, stops["mean"], **style, marker="o", markersize=2.0 * width, label=label)[0]
        color = line.get_color()
        if words:
            axes.vlines(ticks, stops["min"], stops["max"], color=color, alpha=0.3, linewidth=2.0 * width)
            axes.set_xticks(ticks, stops.index)
        elif (stops["size"] > 1).any():
            axes.fill_between(ticks, stops["min"], stops["max"], color=color, alpha=0.15, linewidth=0)
    axes.set(xlabel=_label(result, x), ylabel=_label(result, y), title=_title(result))
    axes.grid(alpha=0.3)
    if len(groups) > 1:
        axes.legend(title=", ".join(others), fontsize="small")


def _heat_maps(figure: Any, result: Any, x: str, along: str, y: str, others: list[str]) -> None:
    """One panel per combination of the other axes, with a common colour scale."""
    table = _table(result, x, y, others, along)
    groups = list(table.groupby("label", sort=False))
    across, up = np.unique(table["x"]), np.unique(table["along"])
    figure.set_size_inches(1.2 + 3.6 * len(groups), 3.6)
    image: Any = None
    panels = figure.subplots(1, len(groups), squeeze=False, sharex=True, sharey=True)[0]
    shades = {"vmin": table["y"].min(), "vmax": table["y"].max()} if table["y"].count() else {}
    for panel, (label, rows) in zip(panels, groups, strict=True):
        cells = rows.groupby(["along", "x"])["y"].mean().unstack().reindex(index=up, columns=across)
        image = panel.pcolormesh(_edges(across), _edges(up), cells.to_numpy(), **shades)
        panel.set(xlabel=_label(result, x), title=label)
    panels[0].set_ylabel(_label(result, along))
    figure.colorbar(image, ax=list(panels), label=_label(result, y))


def _scatter_matrix(figure: Any, result: Any, names: list[str]) -> None:
    """Scatter matrix coloured by the last column, with histograms on the diagonal."""
    columns = [result.column(name).astype(float) for name in names]
    size = len(names)
    figure.set_size_inches(1.0 + 2.0 * size, 2.0 * size)
    panels = figure.subplots(size, size, squeeze=False)
    for i, up in enumerate(columns):
        for j, across in enumerate(columns):
            panel = panels[i][j]
            if i == j:
                panel.hist(across[np.isfinite(across)], bins=24, color="0.6")
            else:
                panel.scatter(across, up, s=6, c=columns[-1])
            panel.set(
                xlabel=_label(result, names[j]) if i == size - 1 else "",
                ylabel=_label(result, names[i]) if j == 0 else "",
            )
            panel.tick_params(labelsize=7)


def _label(result: Any, name: str) -> str:
    """Text of an axis: the name of a column, and its unit."""
    unit = result.units.get(name)
    return f"{name} [{unit.replace('^2', '²').replace('^3', '³')}]" if unit else name


def _table(result: Any, x: str, y: str, others: list[str], along: str | None = None) -> Any:
    """A pandas.DataFrame of two axes and finite values of a metric, with a label by the values of the other axes."""
    values = result.column(y).astype(float)
    columns = {"x": result.column(x), "y": np.where(np.isfinite(values), values, np.nan)}
    columns |= {"along": result.column(along)} if along else {}
    words = [[f"{v:.4g}" if isinstance(v := row[name], float) else str(v) for name in others] for row in result.rows]
    return need("pandas").DataFrame({**columns, "label": [", ".join(row) for row in words]})


def _edges(centers: np.ndarray) -> np.ndarray:
    """Cell edges for sorted cell centres."""
    if len(centers) == 1:
        return np.array([centers[0] - 0.5, centers[0] + 0.5])
    between = 0.5 * (centers[1:] + centers[:-1])
    return np.concatenate([[1.5 * centers[0] - 0.5 * centers[1]], between, [1.5 * centers[-1] - 0.5 * centers[-2]]])


def _is_number(values: np.ndarray) -> bool:
    return values.dtype.kind in "iuf"


def _first_number(result: Any) -> str:
    """The first metric with one number per run."""
    for name in result.metrics:
        values = result.column(name)
        if _is_number(values) or values.dtype == bool:
            return name
    raise ValueError("plot: requires a metric with one number per run")


def _title(result: Any) -> str:
    failed = len(result.failed)
    scene = result.about.get("scene", "").partition(":")[0]
    return f"{scene}, {len(result)} runs" + (f", {failed} failed" if failed else "")
