"""Damaged caches are reported once and computed again."""

import os
import subprocess
import sys

import numpy as np
import pytest

from tests.test_sdf import bakes, cache_files, empty_cache, small_mesh  # noqa: F401

PROGRAM = """
import logging
import warp as wp
import warp_rigid as wr
logging.basicConfig(format="%(message)s")
wp.config.log_level = wp.LOG_WARNING
from warp_rigid.kernel_cache import load_module
from warp_rigid.kernels.common import capacity
wp.init()
load_module(wp.get_device("cpu"), capacity.__name__, 1)
wanted, row = wp.zeros((16, 2), dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
wp.launch(capacity.close_row, dim=1, inputs=[wanted], outputs=[row], device="cpu")
print(row.numpy()[0])
"""


def run(cache, program=PROGRAM):
    """Load and use the kernels of one module; standard output and the lines about the cache."""
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    told = [line for line in done.stderr.splitlines() if "cache" in line or "compiling" in line]
    return done.stdout.split()[-1], told


@pytest.fixture(scope="module")
def kernels(tmp_path_factory):
    """A kernel cache with the module, and what it computes; that it is compiled is told once, before it begins."""
    cache = tmp_path_factory.mktemp("kernels")
    tell = PROGRAM.replace('"%(message)s"', '"%(message)s", level="INFO"')
    tell += "from warp_rigid.kernels.common import team\nload_module(wp.get_device('cpu'), team.__name__, 1)\n"
    printed, told = run(cache, tell)
    assert [line.partition(",")[0] for line in told] == ["compiling kernels for cpu"]
    assert run(cache, tell) == (printed, [])
    return cache, printed


@pytest.mark.parametrize(
    ("suffix", "damage"), [(".o", "bit"), pytest.param(".meta", "garbage", marks=pytest.mark.long)]
)
def test_a_damaged_kernel_is_compiled_again(kernels, suffix, damage):
    cache, expected = kernels
    (file,) = (file for file in cache.rglob(f"*{suffix}") if "capacity" in file.name)
    good = file.read_bytes()
    bit = bytearray(good)
    bit[len(bit) // 2] ^= 16
    file.write_bytes(bytes(bit) if damage == "bit" else b"x" * 5000)
    printed, told = run(cache)
    assert printed == expected and len(told) == 1 and "is damaged" in told[0] and str(file.parent) in told[0]
    assert run(cache) == (expected, [])


@pytest.mark.long
def test_a_damaged_kernel_without_a_checksum_is_compiled_again(kernels):
    """As left by an older version."""
    cache, expected = kernels
    (file,) = (file for file in cache.rglob("*.o") if "capacity" in file.name)
    for checksum in cache.rglob("*.sha256"):
        checksum.unlink()
    file.write_bytes(file.read_bytes()[:50])
    printed, told = run(cache)
    assert printed == expected and len(told) == 1


def test_a_changed_byte_of_a_distance_grid_is_harmless(empty_cache, bakes, caplog):  # noqa: F811
    values = small_mesh(8).grid.values
    (file,) = cache_files(empty_cache)
    good = file.read_bytes()
    rng = np.random.default_rng(0)
    places = [*range(0, 120, 2), *range(len(good) - 200, len(good), 2), *rng.integers(0, len(good), 40).tolist()]
    for place in places:
        content = bytearray(good)
        content[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(content)
        caplog.clear()
        before = len(bakes)
        np.testing.assert_array_equal(small_mesh(8).grid.values, values)
        assert len(caplog.records) == len(bakes) - before <= 1, "computed again if and only if it was reported"
        assert not caplog.records or (str(file) in caplog.text and "is damaged" in caplog.text)
    assert len(bakes) > 50
