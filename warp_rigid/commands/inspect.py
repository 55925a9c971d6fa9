"""`warp-rigid inspect`: the collision representation of a mesh."""

import json
import os
from typing import Annotated, Any

import typer
from rich.table import Table

from warp_rigid.checks import suggestion
from warp_rigid.commands.options import AsJson
from warp_rigid.commands.terminal import check_outputs, console
from warp_rigid.diagnostics.mesh_report import inspect_mesh, parse_slice, save_slice
from warp_rigid.scene.shapes import Mesh
from warp_rigid.scenes.builders import meshes


def inspect_command(
    mesh: Annotated[str, typer.Argument(help="Mesh file, or built-in mesh such as bunny or torus.")],
    output: Annotated[str | None, typer.Option("-o", "--output", help="Image of a slice, .png.")] = None,
    cut: Annotated[
        str | None, typer.Option("--slice", help="Plane of the slice, such as z=0.05. Default: the middle in z.")
    ] = None,
    sdf_resolution: Annotated[int, typer.Option(help="Grid cells along the longest side.")] = 64,
    as_json: AsJson = False,
) -> None:
    """Report mass properties, repairs, surface samples and signed distance error of a mesh."""
    if cut and not output:
        raise ValueError("--slice: requires -o FILE.png")
    check_outputs(None, {output: (".png",)})
    solid = _find_mesh(mesh, sdf_resolution)
    if output:
        lower, upper = solid.bounds
        axis, place = parse_slice(cut) if cut else (2, float(lower[2] + upper[2]) / 2.0)
        save_slice(solid, output, axis, place)
    figures = inspect_mesh(solid)
    if as_json:
        print(json.dumps(figures))
    else:
        _print_mesh(mesh, figures)


def _find_mesh(name: str, sdf_resolution: int) -> Mesh:
    """Load a mesh file or a built-in mesh."""
    if _is_ready(name):
        made: Mesh = getattr(meshes, name)(sdf_resolution=sdf_resolution)
        return made
    if not os.path.isfile(name):
        known = suggestion(name, [other for other in vars(meshes) if _is_ready(other)])
        raise FileNotFoundError(f"{name}: no such file and no built-in mesh{known}")
    return Mesh.from_file(name, sdf_resolution=sdf_resolution)


def _is_ready(name: str) -> bool:
    """Whether a name is that of a built-in mesh."""
    return not name.startswith("_") and getattr(getattr(meshes, name, None), "__module__", None) == meshes.__name__


def _print_mesh(name: str, figures: dict[str, Any]) -> None:
    size = [upper - lower for lower, upper in zip(figures["lower"], figures["upper"], strict=True)]
    triple = "{:.4g} x {:.4g} x {:.4g}".format
    cell = figures["cell"]
    rows = {
        "mesh": f"{name}: {figures['vertices']} vertices, {figures['triangles']} triangles, "
        f"{'watertight' if figures['watertight'] else 'open'}",
        "repairs": "; ".join(figures["repairs"]) or "none",
        "contacts": _contacts(figures),
        "size": f"{triple(*size)} m",
        "volume": f"{figures['volume']:.5g} m^3",
        "center of mass": "({:.4g}, {:.4g}, {:.4g}) m".format(*figures["center_of_mass"]),
        "inertia": "{:.4g}, {:.4g}, {:.4g} m^5 at unit density".format(*figures["principal_inertia"]),
        "samples": ", ".join(f"{n} {kind}" for kind, n in figures["samples"].items() if n),
        "distance grid": f"{triple(*figures['grid'])} nodes, cell {1e3 * cell:.3g} mm, {figures['grid_seconds']:.2g} s",
        "distance error": f"mean {figures['distance_error_mean'] / cell:.2g}, "
        f"maximum {figures['distance_error_largest'] / cell:.2g} cells; "
        f"{figures['wrong_signs']} wrong signs",
    }
    table = Table(box=None, show_header=False, pad_edge=False)
    for label, text in rows.items():
        table.add_row(label, text)
    console().print(table, highlight=False)


def _contacts(figures: dict[str, Any]) -> str:
    """Where contacts take distances from, and what to do about thin walls."""
    if not figures["fault"]:
        return "from the triangles, so walls may be thinner than a cell"
    return (
        f"from the grid only, as {figures['fault']}: walls thinner than {1e3 * figures['thinnest_wall']:.3g} mm do not "
        "hold; repair the mesh or raise --sdf-resolution"
    )
