"""`warp-rigid usd`: check and convert USD files."""

import json
from typing import Annotated

import typer

from warp_rigid.commands.options import AsJson
from warp_rigid.commands.terminal import note, say

BAD_FILE = 2

usd_app = typer.Typer(help="Check and convert USD files.", no_args_is_help=True)


@usd_app.command("check")
def check_command(
    file: Annotated[str, typer.Argument(help="USD file: .usd, .usda, .usdc or .usdz.")],
    as_json: AsJson = False,
) -> int:
    """Run the validators of the USD library and of this package. Exit status 2 if they report a problem."""
    from warp_rigid.usd.check import check_usd

    problems = check_usd(file)
    if as_json:
        print(json.dumps({"file": file, "problems": [vars(problem) for problem in problems]}))
    else:
        say(*map(str, problems))
        note(f"{file}: {len(problems)} problem(s)")
    return BAD_FILE if problems else 0


@usd_app.command("flatten")
def flatten_command(
    source: Annotated[str, typer.Argument(help="File to read.")],
    target: Annotated[str, typer.Argument(help="File to write: .usdc, .usda or .usd.")],
) -> int:
    """Expand each PointInstancer into one prim per instance, for programs that do not support instancers."""
    from warp_rigid.usd.instancing import flatten_usd

    count = flatten_usd(source, target)
    say(f"wrote {target}: {count} instances")
    return 0
