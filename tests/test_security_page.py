"""SECURITY.md is a list of tests."""

import re
from pathlib import Path

TESTS = Path(__file__).parent


def test_every_test_that_the_page_names_exists():
    page = (TESTS.parent / "SECURITY.md").read_text()
    named = re.findall(r"`([\w/]+\.py)::(\w+)`", page)
    assert len(named) >= 15
    for file, test in named:
        assert f"def {test}(" in (TESTS / file).read_text(), f"{file}::{test}"
    untrusted = page.split("## Untrusted input")[1].split("Two kinds of input")[0]
    for statement in re.split(r"\n- ", untrusted)[1:]:
        assert re.search(r"`[\w/]+\.py::\w+`", statement), f"no test: {statement}"
