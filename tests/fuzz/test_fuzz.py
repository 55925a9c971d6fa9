"""Wild input of every kind ends in a result or in one line that names what is wrong.

FUZZ_CASES says how many cases there are in all (200, and 600 in the long tests); `make fuzz` tries 10 000 other ones.
"""

import faulthandler
import os
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings

from tests.fuzz import harness

GIVEN_CASES = int(os.environ.get("FUZZ_CASES", "0"))
SHORT, LONG = pytest.param(200, marks=pytest.mark.short), pytest.param(600, marks=pytest.mark.long)
CASES = [GIVEN_CASES] if GIVEN_CASES else [SHORT, LONG]
MODULES = sorted({p.stem for p in Path(__file__).parent.glob("*.py")} - {"harness", "test_fuzz", "test_corpus"})
TARGETS = [target for name in MODULES for target in import_module(f"tests.fuzz.{name}").TARGETS]


@pytest.mark.long
@pytest.mark.parametrize("cases", CASES)
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name.replace(" ", "_"))
def test_wild_input_ends_well(target, cases, tmp_path):
    case_count = -(-cases // len(TARGETS))
    # The same cases every time where changes are tested; others on every night's run.
    options = settings(
        max_examples=case_count,
        derandomize=not GIVEN_CASES,
        deadline=None,
        database=None,
        # The first bad case is told as it is: making it smaller may take hours where each takes seconds.
        phases=(Phase.generate,),
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )

    @options
    @given(target.cases)
    def attempt(case):
        harness.check(target, case, tmp_path)

    faulthandler.dump_traceback_later(600 + case_count, exit=True)
    try:
        attempt()
    finally:
        faulthandler.cancel_dump_traceback_later()


def test_the_harness_sees_what_it_must_see(tmp_path):
    """Each kind of bad end, so that the test above can fail."""

    def must_fail(attempt, error=AssertionError):
        with pytest.raises(error):
            harness.check(harness.Target("x", None, attempt), None, tmp_path)

    def refuses(text):
        def attempt(*_):
            raise ValueError(text)

        return attempt

    must_fail(refuses("two\nlines: here"))
    must_fail(refuses("names nothing"))
    must_fail(lambda *_: 1 / 0, ZeroDivisionError)
    must_fail(lambda *_: bytearray(3 * 10**9), MemoryError)
    must_fail(lambda *_: (tmp_path.parent / "elsewhere").write_text("x"))
    must_fail(lambda *_: os.system("true"))
    harness.check(harness.Target("x", None, refuses("dt: must be > 0")), None, tmp_path)
    harness.check(harness.Target("x", None, lambda *_: (tmp_path / "here").write_text("x")), None, tmp_path)
