"""The thresholds: each is explained, and the engine uses it."""

import re
from pathlib import Path

from warp_rigid.kernels import tuning

ROOT = Path(__file__).resolve().parents[1]


def test_every_threshold_is_explained_and_used():
    found = tuning.thresholds()
    assert {name for name in vars(tuning) if name.isupper()} == set(found)
    files = [*(ROOT / "kernels").rglob("*.py"), *(ROOT / "warp_rigid/engine").glob("*.py")]
    sources = "".join(file.read_text() for file in files if file.name != "tuning.py")
    sources = re.sub(r"^from warp_rigid.kernels.tuning import (\(.*?\)|[^(\n]*)$", "", sources, flags=re.S | re.M)
    for name, threshold in found.items():
        assert threshold.value == getattr(tuning, name) and len(threshold.text) > 40
        assert re.search(rf"\b{name}\b", sources), f"{name} is not used"
