"""`warp-rigid merge`: merge the tables of the shards of a sweep."""

from pathlib import Path
from typing import Annotated

import typer

from warp_rigid.commands.options import AsJson
from warp_rigid.commands.sweep import FAILED_RUNS, print_result
from warp_rigid.commands.terminal import note
from warp_rigid.sweep import merge
from warp_rigid.sweep.result_plots import check_plot
from warp_rigid.sweep.table import check_ending


def merge_command(
    tables: Annotated[list[str], typer.Argument(help="Shard tables, .parquet.")],
    output: Annotated[str, typer.Option("-o", "--output", help="Merged table, .parquet.")],
    plot: Annotated[str | None, typer.Option(help="Plot, .png or .svg.")] = None,
    plot_x: Annotated[str | None, typer.Option(help="Axis on the x axis of the plot.")] = None,
    plot_y: Annotated[str | None, typer.Option(help="Metric on the y axis of the plot.")] = None,
    plot_kind: Annotated[str | None, typer.Option(help="Kind of plot: line, heatmap or scatter.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing table.")] = False,
    as_json: AsJson = False,
) -> int:
    """Merge the tables of the shards of a sweep. Missing runs count as failed."""
    if plot:
        check_plot(plot, plot_kind)
    check_ending("-o", output)
    own = Path(output).resolve() in [Path(table).resolve() for table in tables]
    if Path(output).exists() and not own and not overwrite:
        raise ValueError(f"{output}: already exists and is not one of the tables; --overwrite replaces it")
    result = merge(tables)
    result.to_parquet(output)
    if plot:
        result.plot(plot, plot_x, plot_y, plot_kind)
    print_result(result, [path for path in (output, plot) if path], as_json)
    missing = result.about["runs"] - len(result)
    if missing:
        note(f"{missing} of {result.about['runs']} runs are missing from the tables")
    return FAILED_RUNS if missing or result.failed else 0
