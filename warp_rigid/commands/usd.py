"""`warp-rigid usd`: what can be done to USD files without simulating."""

import json
from typing import Annotated

import typer

from warp_rigid.commands.terminal import console, note

BAD_FILE = 2

usd_app = typer.Typer(help="Check and convert USD files.", no_args_is_help=True)


@usd_app.command("check")
def check_command(
    file: Annotated[str, typer.Argument(help="A .usd, .usda, .usdc or .usdz file.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Run the USD library's validators and some of our own; status 2 where they find something."""
    from warp_rigid.usd.check import check_usd

    problems = check_usd(file)
    if as_json:
        print(json.dumps({"file": file, "problems": [vars(problem) for problem in problems]}))
    else:
        for problem in problems:
            console().print(str(problem), highlight=False, markup=False)
        note(f"{file}: {len(problems)} problem(s)")
    return BAD_FILE if problems else 0


@usd_app.command("flatten")
def flatten_command(
    source: Annotated[str, typer.Argument(help="The file to read.")],
    target: Annotated[str, typer.Argument(help="The file to write: .usdc, .usda or .usd.")],
) -> int:
    """Write each instance of a PointInstancer as a prim of its own, for programs that read no instancers."""
    from warp_rigid.usd.flatten import flatten_usd

    count = flatten_usd(source, target)
    console().print(f"wrote {target}: {count} instances", highlight=False, markup=False)
    return 0
