"""`warp-rigid validate`: compare the engine with closed forms and published references."""

import itertools
import json
from pathlib import Path
from typing import Annotated, Any

import typer
import warp as wp

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
    compare: Annotated[
        list[Path] | None, typer.Option(help="Only compare the verdicts of this results.json with others; repeatable.")
    ] = None,
) -> int:
    """Compare the engine with closed forms and published references, in one table.

    Exit status 0: every check is within its tolerance, or is a known miss within its limit (MISS).
    1: a check failed (FAIL) or could not be evaluated (ERROR). 2: invalid input.
    6: a check that is listed as a known miss is within its tolerance (MET).
    """
    from warp_rigid.validation import figures, report, suite

    if compare:
        return _compare_runs(compare)
    devices = [str(choose_device(name)) for name in device] if device else [str(d) for d in wp.get_devices()]
    cases = suite.all_cases(quick)
    if names:
        cases = suite.choose(cases, [name.strip() for name in names.split(",")])
    folder = Path(output) if output else None
    if folder:
        check_outputs(None, {"overview.png": (".png",)})
        folder.mkdir(parents=True, exist_ok=True)
    files: list[str] = []
    done = itertools.count(1)
    with progress("validate", len(cases) * len(devices)) as advance:

        def on_case(case: Any, device: str, subject: Any, _: Any) -> None:
            # A case is drawn when it is done, so that its traces can be released.
            if folder and case.curve and subject is not None:
                files.append(str(figures.save_case(case, device, subject, folder)))
            advance(next(done))

        findings = suite.run_suite(cases, devices, on_case)
    files += _write(findings, devices, folder) if folder else []
    if as_json:
        print(json.dumps({**report.as_json(findings, devices), "files": files}))
    else:
        report.print_table(findings, console())
        say(report.summary(findings), *report.agreement(report.as_json(findings, devices)["checks"]))
        say_written(files)
    return report.exit_status(findings)


def _compare_runs(paths: list[Path]) -> int:
    """Print which verdicts of runs differ; the exit status is 0 if none does."""
    from warp_rigid.validation import report

    checks = []
    for path in paths:
        try:
            checks += json.loads(path.read_text())["checks"]
        except (ValueError, KeyError, TypeError):
            raise ValueError(f"--compare: must be the results.json of a run with -o, got {str(path)!r}") from None
    lines = report.agreement(checks)
    print(*lines or ["nothing to compare: the files contain verdicts of one device only"], sep="\n")
    return int(len(lines) != 1)


def _write(findings: list[Any], devices: list[str], folder: Path) -> list[str]:
    """Write the overview, the table and the results; returns their paths."""
    from warp_rigid.validation import figures, report

    files = [str(figures.save_overview(findings, folder))]
    results = json.dumps(report.as_json(findings, devices), indent=1)
    for name, text in {"table.md": report.markdown(findings), "results.json": results}.items():
        with atomic_file(folder / name) as temporary:
            temporary.write_text(text)
        files.append(str(folder / name))
    return files
