"""Standalone pages of films, read without a browser."""

import re

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.render.film import film_from_recording
from warp_rigid.viewer.playback import save_html

zstandard = pytest.importorskip("zstandard")

ALPHABET = bytes(code for code in range(0x21, 0x7F) if chr(code) not in "\"&<>'`")
"""Digits of base 88, in which viser's page holds its compressed program: five for four bytes."""


def program_of(page):
    """The JavaScript program that a page of viser unpacks and runs."""
    text, styles = re.search(r'<script data-p="([^"]*)" data-ss="(\d+)"', page).groups()
    digits = np.frombuffer(text.encode(), np.uint8)
    place = np.zeros(128, np.uint64)
    place[np.frombuffer(ALPHABET, np.uint8)] = np.arange(len(ALPHABET))
    whole = place[digits[: len(digits) // 5 * 5]].reshape(-1, 5)
    packed = (whole * 88 ** np.arange(4, -1, -1, dtype=np.uint64)).sum(axis=1).astype(">u4").tobytes()
    # A last group of k digits holds k - 1 bytes.
    value, rest = 0, digits[len(digits) // 5 * 5 :]
    for digit in rest:
        value = value * 88 + int(place[digit])
    packed += value.to_bytes(max(0, len(rest) - 1), "big")
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=2**27)[int(styles) :].decode()


def test_a_loop_changes_neither_lights_nor_visibility(tmp_path):
    """The function that viser calls before each loop, which hides all and brings back its own lights, is empty."""
    scene = wr.Scene()
    scene.add_body(wr.Box((0.2, 0.2, 0.2)))
    recording = wr.record(wr.Simulator(scene, device="cpu"), frames=2)
    save_html(film_from_recording(recording), tmp_path / "film.html")
    page = (tmp_path / "film.html").read_text()
    changed = re.findall(r'e\.textContent=code\.replace\(/(.*?)/,"(.*?)"\);', page)
    assert len(changed) == 1
    pattern, instead = changed[0]
    program = program_of(page)
    assert len(re.findall(pattern, program)) == 1
    start = re.search(r"\(\)\{" + pattern, program).start()
    body = re.sub(pattern, instead, program[start : start + 1000], count=1)
    assert body.startswith("(){return;let ") and "visibility:!1" in body
