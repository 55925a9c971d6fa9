"""The thresholds: each is explained, and a kernel uses it."""

import re
from pathlib import Path

from warp_rigid.kernels import tuning

KERNELS = Path(tuning.__file__).parent


def test_every_threshold_is_explained_and_used():
    found = tuning.thresholds()
    assert {name for name in vars(tuning) if name.isupper()} == set(found)
    sources = "".join(file.read_text() for file in KERNELS.rglob("*.py") if file.name != "tuning.py")
    for name, threshold in found.items():
        assert threshold.value == getattr(tuning, name) and len(threshold.text) > 40
        assert len(re.findall(rf"\b{name}\b", sources)) > 1, f"{name} is imported, but not used"
