"""The roofline's counts: sizes against the arrays' own, work against scenes whose work is known."""

import json
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks import roofline
from tests.oracles import ground_scene, stages_of
from warp_rigid import Simulator
from warp_rigid.bench.cases import BenchmarkCase
from warp_rigid.kernels import declare, schema
from warp_rigid.scene.shapes import Box

CPU = roofline.LIMITS["cpu"]
ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    "struct", [schema.State, schema.Motions, schema.Bodies, schema.Pairs, schema.Contacts, schema.History]
)
def test_rows_have_the_size_that_allocation_gives_them(struct):
    symbols = {term.split(" ")[0] for f in declare.LAYOUTS[struct.key].values() for term in f.shape.split(",")[:1]} - {
        "1"
    }
    for symbol in symbols:
        sizes = dict.fromkeys((*symbols, "env_bodies"), 10)
        grown = {**sizes, symbol: 11}
        assert roofline.row(struct, symbol) == declare.byte_size(struct, grown) - declare.byte_size(struct, sizes)


def test_an_array_that_a_layout_lacks_is_an_error():
    """Names that had been renamed elsewhere counted as 0 bytes."""
    with pytest.raises(KeyError, match="no_such_array"):
        roofline.row(schema.Motions, "bodies", "center", "no_such_array")


def test_records_have_the_size_of_their_arrays_elements(device):
    for record in (
        schema.ContactRecord,
        schema.ImpulseRecord,
        schema.OrderRecord,
        schema.SolverBodyRecord,
        schema.SampleRecord,
    ):
        two = wp.zeros(2, dtype=record, device=device)
        assert roofline.part(record) == two.strides[0]


def test_the_floor_is_the_slowest_of_three():
    memory = roofline.Work(read=CPU.bandwidth, written=CPU.bandwidth, single=CPU.single, launches=1)
    assert memory.floor(CPU) == (2.0, "memory")
    arithmetic = roofline.Work(read=1.0, single=CPU.single, double=2.0 * CPU.double)
    assert arithmetic.floor(CPU) == (3.0, "arithmetic")
    seconds, by = roofline.Work(launches=4).floor(CPU)
    assert by == "launches" and seconds == pytest.approx(4 * CPU.launch)


def test_work_of_a_stack_at_rest(device):
    """Two towers of three cubes: what touches, what rests, and what is looked for is known."""
    sim = Simulator(BenchmarkCase("stack", 3).build(), 2, device=device)
    sim.step(400)
    before = sim.get("position")
    found = roofline.count(sim)
    assert (found.envs, found.rows, found.small, found.wide) == (2, 8, 3, 1)
    assert found.touching == 6 and found.levels == 3 and found.contacts == len(sim.contacts())
    assert found.searched == found.clusters == found.samples == found.close == 0
    assert found.contacts <= found.sweeps <= 10 * found.contacts
    assert np.array_equal(sim.get("position"), before)
    # What was counted is the coming step: it comes as if nobody had looked.
    other = Simulator(BenchmarkCase("stack", 3).build(), 2, device=device)
    other.step(401), sim.step(1)
    assert np.array_equal(sim.get("position"), other.get("position"))


def test_what_falls_needs_no_sweeps_and_what_slides_is_searched(device):
    scene = ground_scene(friction=0.2)
    sliding = scene.add_body(Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1), linear_velocity=(2, 0, 0))
    sim = Simulator(scene, 2, device=device)
    sim.set("position", (0.0, 0.0, 5.0), envs=[1], bodies=[sliding])
    sim.step(2)
    found = roofline.count(sim)
    assert found.pairs == 2 and found.touching == 1
    shape = stages_of(sim).model.shapes.shapes.numpy()[stages_of(sim).model.bodies.shape.numpy()[sliding]]
    plane = stages_of(sim).model.shapes.shapes.numpy()[stages_of(sim).model.bodies.shape.numpy()[0]]
    both = [int(one["cluster_end"] - one["cluster_start"]) for one in (shape, plane)]
    assert found.searched >= 1 and found.clusters == found.searched * sum(both)
    assert 4 <= found.close <= found.samples
    needed = roofline.sweeps_needed(sim)
    assert needed[0] >= 1 and needed[1] == 0
    assert (sim.get("contact_iterations") == 10).all()


def test_a_table_is_written_with_every_stage_that_launches(device, tmp_path, capsys):
    page, figures = tmp_path / "page.md", tmp_path / "figures.json"
    arguments = ["stack:2:2", "--device", str(device), "--settle", "20"]
    roofline.main([*arguments, "--write", str(page), "--json", str(figures)])
    text = page.read_text()
    (found,) = json.loads(figures.read_text())
    printed = capsys.readouterr().out
    assert text.startswith("# Roofline") and "stage | stack:2 × 2\n" in text and "## stack:2 × 2" in printed
    for stage, work in found["work"].items():
        assert (f"\n{stage} | " in text) == (f"\n{stage} | " in printed) == (work["launches"] > 0)
        if work["launches"] > 0:
            # Where the sweeps have settled everything, nothing is left for shock propagation.
            assert work["read"] > 0 or (stage == "propagate_shock" and found["counts"]["unsettled"] == 0)
            assert 0.0 < found["floors"][stage][0] < found["measured"][stage]
    assert set(found["work"]) == set(found["measured"])


def test_a_scene_in_motion_is_counted_at_its_time(device, tmp_path):
    """A cube that starts at 0.25 m touches the floor after 0.2 s, and is searched in each step until it rests."""
    page = tmp_path / "page.md"
    roofline.main(["pile_box:2:2@0.3", "--device", str(device), "--write", str(page)])
    assert "stage | pile_box:2 × 2, 0.3 s\n" in page.read_text()
    moving, rest = (roofline.measure(f"pile_box:2:2@{time}", device, steps=2).counts for time in (0.3, 3))
    assert moving.searched > 0 and moving.samples > 0
    assert rest.searched == rest.samples == 0


def test_the_page_names_the_programs_figures():
    text = (ROOT / "docs" / "roofline.md").read_text()
    for name, told in (
        ("visit", "{} for a contact in a sweep"),
        ("distance", "{} for a distance"),
        ("contact", "{} for making"),
    ):
        assert told.format(roofline.OPERATIONS[name]) in text
    gpu = roofline.LIMITS["cuda"]
    assert f"| memory | {1e-12 * gpu.bandwidth:.1f} TB/s | {1e-9 * CPU.bandwidth:.0f} GB/s |" in text
    assert f"| {1e-12 * gpu.single:.0f} TFLOP/s | {1e-9 * CPU.single:.0f} GFLOP/s |" in text
    assert f"| {1e6 * gpu.launch:.2f} µs | {1e6 * CPU.launch:.2f} µs |" in text
