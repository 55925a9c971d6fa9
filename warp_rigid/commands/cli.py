"""Command line `warp-rigid COMMAND`; each command has its own module in this package.

Results go to stdout, everything else to stderr. Exit status: 0 success, 1 device failure or failed check, 2 usage or
bad input, 3 capacity exceeded, 4 non-finite state, 5 sweep with failed runs, 130 interrupted.
"""

import sys
from typing import Annotated, Any

import typer

from warp_rigid import interruption
from warp_rigid.commands.bench import bench_command
from warp_rigid.commands.doctor import doctor_command
from warp_rigid.commands.inspect import inspect_command
from warp_rigid.commands.merge import merge_command
from warp_rigid.commands.run import run_command
from warp_rigid.commands.scenes import scenes_command
from warp_rigid.commands.sweep import sweep_command
from warp_rigid.commands.terminal import explain, is_device_error, messages_on_stderr, note
from warp_rigid.commands.usd import usd_app
from warp_rigid.commands.validate import validate_command
from warp_rigid.commands.view import view_command
from warp_rigid.commands.warmup import warmup_command
from warp_rigid.errors import CapacityError, NonFiniteError
from warp_rigid.progress_bar import lines_if_redirected
from warp_rigid.version import __version__
from warp_rigid.warp_start import start_warp

DEVICE, USAGE, CAPACITY, NON_FINITE = 1, 2, 3, 4
UsageError: Any = typer.BadParameter.__bases__[0]

app = typer.Typer(
    help="Batched simulation of nonconvex rigid bodies with stacking.",
    pretty_exceptions_enable=False,
    invoke_without_command=True,
)


def main(argv: list[str] | None = None) -> int:
    """Run a command line and return its exit status.

    Args:
        argv: the arguments; None uses those of the process.
    """
    with interruption.watched():
        status = _run(argv)
        # Typer turns KeyboardInterrupt into a status.
        return interruption.received() if status == interruption.STATUS else status


def _run(argv: list[str] | None) -> int:
    try:
        with messages_on_stderr(), lines_if_redirected():
            start_warp()
            given = sys.argv[1:] if argv is None else argv
            _refuse_empty(given)
            return app(args=argv, prog_name="warp-rigid", standalone_mode=False, obj=["warp-rigid", *given]) or 0
    except KeyboardInterrupt:
        return interruption.received()
    except UsageError as error:
        return _fail(USAGE, error.format_message())
    except CapacityError as error:
        return _fail(CAPACITY, explain(error))
    except NonFiniteError as error:
        return _fail(NON_FINITE, explain(error))
    except (ValueError, FileNotFoundError, ModuleNotFoundError, OSError) as error:
        return _fail(USAGE, explain(error))
    except RuntimeError as error:
        if not is_device_error(error):
            raise
        return _fail(DEVICE, f"{explain(error)}; run `warp-rigid doctor` to test this machine")


@app.callback()
def common(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Handle the options that need no command."""
    if version:
        print(f"warp-rigid {__version__}")
    elif context.invoked_subcommand is None:
        print(context.get_help())


app.command("run")(run_command)
app.command("scenes")(scenes_command)
app.command("inspect")(inspect_command)
app.command("view")(view_command)
app.command("doctor")(doctor_command)
app.command("warmup")(warmup_command)
app.command("sweep")(sweep_command)
app.command("merge")(merge_command)
app.add_typer(usd_app, name="usd")
app.command("validate")(validate_command)
app.command("bench")(bench_command)


def _refuse_empty(given: list[str]) -> None:
    """Reject empty arguments, such as the name of a file from a variable that is not set."""
    for before, argument in zip(["", *given], given, strict=False):
        if not argument or (argument.startswith("--") and argument.endswith("=")):
            name = argument[:-1] or (before if before.startswith("-") else "argument")
            raise ValueError(f"{name}: must not be empty")


def _fail(status: int, text: str) -> int:
    note(f"warp-rigid: {text}")
    return status
