"""The validation: its quick cases hold on every device, and its table, files and exit status tell the truth."""

import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from warp_rigid.commands import cli
from warp_rigid.validation import report, suite
from warp_rigid.validation.case import (
    AT_LEAST,
    OUTCOME,
    Check,
    CheckResult,
    Miss,
    ValidationCase,
    absolute,
    at_most,
    judge,
    relative,
)

QUICK = suite.all_cases(quick=True)


def slug(case):
    return f"{case.id} {case.title}"


LONG = ("V05", "V21", "V61", "V62", "V75", "V76", "V102", "V103", "V104", "V105", "V107")
"""Cases that take more than two seconds."""


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.long] * (case.id in LONG)) for case in QUICK], ids=slug
)
def test_quick_case(case, device):
    """Every check is within its tolerance, or is a known miss; a miss that is met must be listed no longer."""
    _, findings = judge(case, device)
    for finding in findings:
        told = "; ".join(map(str, report.rows(finding, with_device=True))) + " " + finding.note
        miss = finding.check.miss
        assert finding.verdict == ("MISS" if miss else "PASS"), told
        if miss and device == "cpu":
            assert miss.at_most <= 2.0 * finding.error[finding.worst], told


def test_every_case_says_where_its_references_are_from():
    full, quick = ([case.id for case in suite.all_cases(which)] for which in (False, True))
    assert set(quick) <= set(full) and len(full) > len(quick)
    for case in suite.all_cases():
        assert case.checks and case.source and bool(case.experiments) != bool(case.compute), slug(case)


def made_up(values, reference, tolerance, miss=None):
    """A case without a simulation, of one check."""
    labels = [f"variant {k}" for k in range(len(np.atleast_1d(values)))]
    check = Check("length", "m", lambda subject: subject, tolerance, reference, labels=labels, miss=miss)
    return ValidationCase("V99", "made up", "nobody", (check,), compute=lambda device: values, on_device=False)


def finding_of(*arguments) -> CheckResult:
    return judge(made_up(*arguments), "cpu")[1][0]


KNOWN = Miss("the reason", 0.3)


@pytest.mark.parametrize(
    ("values", "reference", "tolerance", "miss", "verdict"),
    [
        ([1.0, 1.009], 1.0, relative(0.01), None, "PASS"),
        ([1.0, 0.98], 1.0, relative(0.01), None, "FAIL"),
        ([-2.0], -2.01, relative(0.01), None, "PASS"),
        ([1.0, 0.8], 1.0, relative(0.01), KNOWN, "MISS"),
        ([1.0, 0.6], 1.0, relative(0.01), KNOWN, "FAIL"),
        ([1.0], 1.0, relative(0.01), KNOWN, "MET"),
        ([0.2], 0.0, absolute(0.1), None, "FAIL"),
        ([-5.0, 0.05], 0.0, at_most(0.1), None, "PASS"),
        ([0.2], 0.0, at_most(0.1), None, "FAIL"),
        ([5.0, 1.0], 1.0, AT_LEAST, None, "PASS"),
        ([5.0, 0.9], 1.0, AT_LEAST, None, "FAIL"),
        ([True, False], [1, 0], OUTCOME, None, "PASS"),
        ([True, True], [1, 0], OUTCOME, None, "FAIL"),
        ([1.0, np.nan], 1.0, relative(0.5), None, "FAIL"),
        ([1.0, np.nan], 1.0, relative(0.5), KNOWN, "FAIL"),
        ([np.inf], 1.0, at_most(0.5), None, "FAIL"),
    ],
)
def test_verdicts(values, reference, tolerance, miss, verdict):
    finding = finding_of(values, reference, tolerance, miss)
    assert finding.verdict == verdict
    assert report.exit_status([finding]) == {"PASS": 0, "MISS": 0, "MET": 6, "FAIL": 1}[verdict]
    assert (finding.note != "") == (miss is not None)
    assert not np.isfinite(finding.error[finding.worst]) or finding.error[finding.worst] == np.nanmax(finding.error)


def test_a_failure_outweighs_a_miss_that_is_met():
    met, failed = finding_of([1.0], 1.0, relative(0.01), KNOWN), finding_of([0.5], 1.0, relative(0.01))
    assert report.exit_status([met]) == 6
    assert report.exit_status([met, failed]) == report.exit_status([failed, met]) == 1
    assert report.summary([met, failed]) == "2 checks: 0 passed, 1 met although listed as misses, 1 failed"


def test_every_tower_is_judged():
    """Each offset under each setting has a line; the default and two passes from zero follow statics at all of them."""
    case = next(case for case in QUICK if case.id == "V61")
    default, two_pass, one_pass, off, leans = [check for check in case.checks if check.itemized]
    offsets = (0.0, 0.05, 0.08, 0.12, 0.15, 0.2)
    due = [offset > 0.1 for offset in offsets]
    assert list(default.reference) == list(two_pass.reference) == due != list(one_pass.reference)
    assert [label.endswith("falls") for label in one_pass.labels] == due
    assert sorted(float(label.split()[0]) for label in (*off.labels, *leans.labels)) == list(offsets)
    assert list(off.reference) == [False, True, True, True] and list(leans.reference) == [True, True]
    assert 3 * len(offsets) + len(off.labels) + len(leans.labels) == len(case.experiments[0].variants)


def test_a_case_that_breaks_is_an_error_and_stops_no_other():
    def broken(_):
        raise RuntimeError("no\nluck")

    check = Check("length", "m", lambda subject: subject, relative(0.1), 1.0, labels=("one",))
    bad = ValidationCase("V98", "broken", "nobody", (check,), compute=broken, on_device=False)
    findings = suite.run_suite([bad, made_up([1.0], 1.0, relative(0.1))], ["cpu"])
    assert [finding.verdict for finding in findings] == ["ERROR", "PASS"]
    assert findings[0].note == "RuntimeError: no luck"
    assert report.exit_status(findings) == 1
    assert json.loads(json.dumps(report.as_json(findings, ["cpu"]), allow_nan=False))["counts"]["ERROR"] == 1


def test_environments_that_failed_have_no_value():
    """A state that is not finite must never be measured as if the body were at rest."""
    case = next(case for case in QUICK if case.id == "V23")
    trace = case.experiments[0].run("cpu")
    trace.failed[1] = True
    value = case.checks[-1].measure((trace,))
    assert np.isnan(value).tolist() == [False, True, False, False]


def test_cases_of_no_device_run_once():
    findings = suite.run_suite([made_up([1.0], 1.0, relative(0.1))], ["cpu", "cuda:0"])
    assert [finding.device for finding in findings] == ["cpu"]


def test_verdicts_that_differ_between_devices_are_told(tmp_path, capsys):
    """In one run on two devices, and in files of two runs; what one device alone was asked does not count."""

    def check(device, quantity, verdict):
        return {"case": "V99", "title": "made up", "device": device, "quantity": quantity, "verdict": verdict}

    here = [check("cpu", *one) for one in (("way", "PASS"), ("way", "MISS"), ("height", "PASS"), ("mass", "PASS"))]
    there = [check("cuda:0", *one) for one in (("way", "PASS"), ("way", "PASS"), ("height", "PASS"))]
    expected = ["cpu and cuda:0: 2 of 3 verdicts are the same", "V99 way: MISS on cpu, PASS on cuda:0"]
    assert report.agreement([*here, *there]) == expected
    assert report.agreement(here) == []
    for name, checks in (("here", here), ("there", there)):
        (tmp_path / name).write_text(json.dumps({"checks": checks}))
    assert cli.main(["validate", "--compare", str(tmp_path / "here"), "--compare", str(tmp_path / "there")]) == 1
    assert capsys.readouterr().out.splitlines() == expected
    assert cli.main(["validate", "--compare", str(tmp_path / "there")]) == 1
    assert "nothing to compare" in capsys.readouterr().out
    (tmp_path / "other").write_text("{}")
    for name in ("other", "missing"):
        assert cli.main(["validate", "--compare", str(tmp_path / name)]) == 2
        error = capsys.readouterr().err
        assert name in error and error.count("\n") == 1


@pytest.fixture(scope="module")
def one_run(tmp_path_factory):
    """Folder and JSON of a run of two families and of a made-up case with a known miss."""
    folder = tmp_path_factory.mktemp("out") / "new" / "folder"
    with pytest.MonkeyPatch.context() as patch:
        printed = []
        patch.setattr("builtins.print", lambda *a, **_: printed.append(" ".join(map(str, a))))
        patch.setattr(suite, "all_cases", lambda quick: [*QUICK, made_up([1.0, 0.8], 1.0, relative(0.01), KNOWN)])
        names = "V20,V23,V99"
        status = cli.main(["validate", "--quick", "--cases", names, "--device", "cpu", "-o", str(folder), "--json"])
    assert status == 0
    return folder, json.loads(printed[-1])


def test_json_holds_every_variant(one_run):
    _, told = one_run
    assert (told["devices"], told["passed"]) == (["cpu"], True)
    assert told["counts"] == {"PASS": 6, "MISS": 1, "MET": 0, "FAIL": 0, "ERROR": 0}
    assert {check["contacts"] for check in told["checks"] if check["case"] == "V23"} == {32}
    assert all(0.0 <= check["residual"] < 1e-5 for check in told["checks"] if check["case"] == "V23")
    missed = next(check for check in told["checks"] if check["verdict"] == "MISS")
    assert (missed["case"], missed["tolerance"], missed["tolerance_kind"]) == ("V99", 0.01, "relative")
    assert [variant["reference"] for variant in missed["variants"]] == [1.0, 1.0]
    assert [variant["error"] for variant in missed["variants"]] == pytest.approx([0.0, 0.2])
    assert missed["note"] == "the reason"


def test_files_of_a_run(one_run):
    folder, told = one_run
    assert sorted(told["files"]) == sorted(str(path) for path in folder.iterdir())
    pictures = [path for path in folder.iterdir() if path.suffix == ".png"]
    assert {path.name.split("_")[0] for path in pictures} == {"V23", "overview.png"}
    for path in pictures:
        colors = Image.open(path).convert("RGB").getcolors(1 << 20)
        assert len(colors) > 20
    kept = json.loads((folder / "results.json").read_text())
    assert kept["checks"] == told["checks"]
    lines = (folder / "table.md").read_text().splitlines()
    assert all(line.count("|") == 5 or line.endswith(" |") for line in lines)
    assert sum(line.endswith("| MISS") for line in lines) == 1
    (case,) = [line for line in lines if line.startswith("**V23 ")]
    assert "(oracle: Coulomb's law, closed form); 32 contacts, residual " in case and case.endswith(" m/s |")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--cases", "V10,nothing"], "--cases: must be names of cases, got 'nothing'; all names: V01 to V110"),
        (["--device", "cuda:77"], "device: must be one of"),
    ],
)
def test_bad_input_is_refused_before_anything_runs(capsys, monkeypatch, arguments, text):
    monkeypatch.setattr(suite, "run_suite", None)
    assert cli.main(["validate", *arguments]) == 2
    assert text in capsys.readouterr().err


def test_cases_are_listed_without_optional_packages():
    program = (
        "import sys\nfrom warp_rigid.extras import EXTRAS\n"
        "sys.modules.update(dict.fromkeys(EXTRAS))\n"
        "from warp_rigid.validation.suite import all_cases\nprint(len(all_cases()))"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", program], capture_output=True, text=True, check=True)
    assert int(done.stdout.split()[-1]) == len(suite.all_cases())
