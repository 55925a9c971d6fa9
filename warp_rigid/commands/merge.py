"""`warp-rigid merge`: the tables of a sweep's shards, put together."""

from pathlib import Path
from typing import Annotated

import typer

from warp_rigid.commands.sweep import FAILED_RUNS, tell


def merge_command(
    tables: Annotated[list[str], typer.Argument(help="Tables of the shards, .parquet.")],
    output: Annotated[str, typer.Option("-o", "--output", help="The whole table, .parquet.")],
    plot: Annotated[str | None, typer.Option(help="Picture, .png or .svg.")] = None,
    plot_x: Annotated[str | None, typer.Option(help="Axis along which to draw.")] = None,
    plot_y: Annotated[str | None, typer.Option(help="Metric to draw.")] = None,
    plot_kind: Annotated[str | None, typer.Option(help="line, heatmap or scatter.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Put the tables of a sweep's shards together; runs that are missing count as failed."""
    from warp_rigid.sweep import merge
    from warp_rigid.sweep.plots import check_plot

    if plot:
        check_plot(plot, plot_kind)
    if not output.endswith(".parquet"):
        raise ValueError(f"-o: must end in .parquet, got {output}")
    if Path(output).exists() and Path(output).resolve() not in [Path(table).resolve() for table in tables]:
        raise ValueError(f"{output}: exists already and is none of the tables; choose another name")
    result = merge(tables)
    result.to_parquet(output)
    if plot:
        result.plot(plot, plot_x, plot_y, plot_kind)
    tell(result, [path for path in (output, plot) if path], as_json)
    missing = result.about["runs"] - len(result)
    if missing:
        from warp_rigid.commands.terminal import note

        note(f"{missing} of {result.about['runs']} runs are in none of the tables")
    return FAILED_RUNS if missing or result.failed else 0
