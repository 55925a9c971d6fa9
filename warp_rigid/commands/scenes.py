"""`warp-rigid scenes`: list the built-in scenes."""

import json

from rich.table import Table

from warp_rigid import scenes
from warp_rigid.commands.options import AsJson
from warp_rigid.commands.terminal import console


def scenes_command(as_json: AsJson = False) -> None:
    """List the built-in scenes with their parameters and the variants used by --compare."""
    demos = [scenes.get(name) for name in scenes.names()]
    if as_json:
        shown = ("summary", "parameters", "duration")
        told = {demo.name: {name: getattr(demo, name) for name in shown} for demo in demos}
        print(json.dumps({demo.name: {**told[demo.name], "variants": list(demo.variants)} for demo in demos}))
        return
    table = Table("scene", "shows", "parameters", "variants", box=None, pad_edge=False)
    for demo in demos:
        parameters = "\n".join(f"{name}={value}" for name, value in demo.parameters.items())
        table.add_row(demo.name, demo.summary, parameters, "\n".join(demo.variants))
    console().print(table)
