"""`warp-rigid validate`: compare the engine with closed forms and published references."""

import itertools
import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
import warp as wp
from rich.markup import escape
from rich.table import Table

from warp_rigid.commands.options import AsJson
from warp_rigid.commands.terminal import check_outputs, console, say, say_written
from warp_rigid.engine.simulator import choose_device
from warp_rigid.files.atomic import atomic_file
from warp_rigid.progress_bar import progress


def validate_command(
    names: Annotated[str | None, typer.Option("--cases", help="Case families, such as V10,V22. Default: all.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes and short times only.")] = False,
    device: Annotated[
        list[str] | None, typer.Option(help="Device, such as cpu or cuda:0; repeatable. Default: all devices.")
    ] = None,
    output: Annotated[
        str | None, typer.Option("-o", "--output", help="Folder for plots, results.json and table.md.")
    ] = None,
    as_json: AsJson = False,
    compare_shock: Annotated[
        bool, typer.Option("--compare-shock", help="Compare shock propagation with its alternatives instead.")
    ] = False,
) -> int:
    """Compare the engine with closed forms and published references, in one table.

    Exit status 0: every check is within its tolerance, or is a known miss within its limit (MISS).
    1: a check failed (FAIL) or could not be evaluated (ERROR). 2: invalid input.
    6: a check that is listed as a known miss is within its tolerance (MET).
    """
    from warp_rigid.validation import report, suite

    devices = [str(choose_device(name)) for name in device] if device else [str(d) for d in wp.get_devices()]
    if compare_shock:
        if names or output:
            raise ValueError("--compare-shock: can only be combined with --device, --quick and --json")
        return _compare_shock(devices, quick, as_json)
    cases = suite.all_cases(quick)
    if names:
        cases = suite.choose(cases, [name.strip() for name in names.split(",")])
    writer = _Writer(output) if output else None
    with progress("validate", len(cases) * len(devices)) as advance:
        findings = suite.run_suite(cases, devices, _Watcher(writer, advance))
    files = writer.finish(findings, devices) if writer else []
    if as_json:
        print(json.dumps({**report.as_json(findings, devices), "files": files}))
    else:
        report.print_table(findings, console())
        say(report.summary(findings), *report.agreement(report.as_json(findings, devices)["checks"]))
        say_written(files)
    return report.exit_status(findings)


def _compare_shock(devices: list[str], quick: bool, as_json: bool) -> int:
    """Print one table per device: results of all schemes on all structures, with ms per step of 1/240 s in brackets."""
    from warp_rigid.validation import shock_comparison as shock

    total = len(devices) * len(shock.SCHEMES) * len(shock.structures(quick))
    with progress("validate", total) as advance:
        count = itertools.count(1)
        tables = {name: shock.compare(name, quick, lambda: advance(next(count))) for name in devices}
    if as_json:
        results = {
            name: {scheme: {one: asdict(cell) for one, cell in cells.items()} for scheme, cells in table.items()}
            for name, table in tables.items()
        }
        print(json.dumps(results))
        return 0
    for name, table in tables.items():
        heading, *lines = shock.rows(table, quick)
        title = escape(f"{name}; in brackets: ms per step of 1/240 s")
        printed = Table(*heading, box=None, pad_edge=False, title=title, title_justify="left")
        for line in lines:
            printed.add_row(*(escape(cell) for cell in line))
        console().print(printed, highlight=False)
    return 0


class _Watcher:
    """Updates the progress bar and draws the plot of each finished case, so that its trace can be released."""

    def __init__(self, writer: "_Writer | None", advance):
        self.writer, self.advance, self.done = writer, advance, 0

    def __call__(self, case, device: str, subject: Any, _) -> None:
        self.done += 1
        if self.writer and case.curve and subject is not None:
            self.writer.draw(case, device, subject)
        self.advance(self.done)


class _Writer:
    """Writes the files of a run."""

    def __init__(self, folder: str):
        self.folder = Path(folder)
        check_outputs(None, {"overview.png": (".png",)})
        self.folder.mkdir(parents=True, exist_ok=True)
        self.files: list[str] = []

    def draw(self, case, device: str, traces) -> None:
        from warp_rigid.validation import figures

        self.files.append(str(figures.save_case(case, device, traces, self.folder)))

    def finish(self, findings, devices) -> list[str]:
        """Write the overview, the table and the results; returns the paths of all files."""
        from warp_rigid.validation import figures, report

        self.files.append(str(figures.save_overview(findings, self.folder)))
        texts = {
            "table.md": report.markdown(findings),
            "results.json": json.dumps(report.as_json(findings, devices), indent=1),
        }
        for name, text in texts.items():
            with atomic_file(self.folder / name) as temporary:
                temporary.write_text(text)
            self.files.append(str(self.folder / name))
        return self.files
