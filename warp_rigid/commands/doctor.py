"""`warp-rigid doctor`: test the installation and the devices of this machine."""

import json
from typing import Annotated

import typer

from warp_rigid.commands.options import AsJson
from warp_rigid.commands.terminal import console
from warp_rigid.diagnostics.machine import examine
from warp_rigid.engine.simulator import choose_device

FAULTY = 1


def doctor_command(
    device: Annotated[str | None, typer.Option(help="Test only this device, such as cpu or cuda:0.")] = None,
    as_json: AsJson = False,
) -> int:
    """Show versions, devices and caches, test each device, and suggest a fix for each failure."""
    report = examine(None if device is None else [str(choose_device(device))])
    if as_json:
        print(json.dumps(report))
    else:
        _print(report)
    return 0 if report["ok"] else FAULTY


def _print(report: dict) -> None:
    out = console()
    lines = [f"{name} {version}" for name, version in report["versions"].items() if version]
    lines += [
        f"{d['name']}: {d['model']}, {d['free'] / 1e9:.3g} of {d['memory'] / 1e9:.3g} GB free"
        for d in report["devices"]
    ]
    for check in report["checks"]:
        lines.append(f"{'ok  ' if check['passed'] else 'FAIL'} {check['name']}: {check['found']}")
        if check["advice"]:
            lines.append(f"     {check['advice']}")
    for line in lines:
        out.print(line, highlight=False, markup=False, soft_wrap=True)
