"""`warp-rigid warmup`: compile all kernels ahead of time."""

import time
from typing import Annotated

import typer
import warp as wp

from warp_rigid.commands.terminal import say
from warp_rigid.engine.loading import everything, load_kernels
from warp_rigid.engine.simulator import choose_device
from warp_rigid.engine.teams import sizes_of_teams
from warp_rigid.progress_bar import progress


def warmup_command(
    device: Annotated[str | None, typer.Option(help="Compile for this device only, such as cpu or cuda:0.")] = None,
) -> None:
    """Compile all kernels for each device into Warp's kernel cache."""
    for chosen in wp.get_devices() if device is None else [choose_device(device)]:
        start = time.perf_counter()
        with progress(f"compiling for {chosen}", 1) as advance:
            load_kernels(chosen, everything(), lanes=sizes_of_teams(chosen), on_module=advance)
        seconds = time.perf_counter() - start
        say(f"{chosen}: ready after {seconds:.2g} s")
