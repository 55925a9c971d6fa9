"""The public names, and what objects show about themselves."""

import inspect

import numpy as np

import warp_rigid as wr


def test_the_package_lists_only_public_names():
    names = set(dir(wr))
    assert names == {*wr.__all__, "__version__"}
    assert not any(inspect.ismodule(getattr(wr, name)) for name in names - {"scenes"})


def test_tables_are_read_by_the_documented_name(tmp_path):
    table = wr.sweep("incline", {"friction": [0.2]}, duration=0.02, device="cpu", output=tmp_path / "t.parquet")
    assert wr.sweep.read(tmp_path / "t.parquet").rows == table.rows
    assert len(wr.sweep.merge([tmp_path / "t.parquet"])) == 1


def test_one_name_has_one_meaning_in_runs_and_sweeps():
    axes, fixed = {"height": [3]}, {"offset": 0.1}
    table = wr.sweep("leaning_tower", axes, fixed=fixed, duration=0.02, device="cpu", metrics=["top_height", "outcome"])
    columns = [name.removeprefix("outcome_") for name in table.metrics]
    assert len(columns) == len(set(columns))


def test_objects_show_what_they_are():
    scene = wr.Scene()
    scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(0, 0, 1))
    sim = wr.Simulator(scene, num_envs=3, device="cpu")
    sim.step(24)
    assert repr(sim) == "Simulator(3 environments of 1 bodies on cpu, dt 0.00416667 s, at 0.1 s)"
    assert repr(wr.record(sim, 2)) == "Recording(3 frames of 3 environments of 1 bodies, 60 frames/s)"
    tetrahedron = wr.Mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    pair = wr.Compound([(wr.Sphere(1.0), (0, 0, 0), (0, 0, 0, 1)), (wr.Capsule(0.5, 2.0), (0, 0, 1), (0, 0, 0, 1))])
    shown = {
        "Box(half_extents=(0.1, 0.2, 0.3))": wr.Box((0.1, 0.2, 0.3)),
        "Plane(normal=(0.0, 0.0, 1.0), offset=0.5)": wr.Plane(offset=0.5),
        "Heightfield(2 x 3 heights, size=(4.0, 5.0))": wr.Heightfield(np.zeros((2, 3)), (4, 5)),
        "Mesh(4 vertices, 4 triangles, sdf_resolution=64)": tetrahedron,
        "Compound(Sphere(radius=1.0), Capsule(radius=0.5, half_height=2.0))": pair,
    }
    assert shown == {text: shape for text, shape in shown.items() if repr(shape) == text}
