"""Layers over the user's own stage: its prims move, and keep their names, scales, materials and children."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warp_rigid as wr
from tests.usd_tools import moved, rigid, start_of, write_stage
from warp_rigid.commands import cli

SCALED = """
def Xform "Set"
{{
    double3 xformOp:translate = (0, 0, {height})
    float3 xformOp:rotateXYZ = (0, 0, 90)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    {body}
}}
"""


def corners(stage, path, time):
    """The corners of a prim's bounds in the world, (8, 3), in its own frame's order."""
    prim = stage.GetPrimAtPath(path)
    bounds = UsdGeom.Imageable(prim).ComputeUntransformedBound(time, "default").ComputeAlignedRange()
    matrix = np.array(UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(time))
    points = np.array([bounds.GetCorner(k) for k in range(8)])
    return points @ matrix[:3, :3] + matrix[3, :3]


@pytest.mark.parametrize("up", ["Z", "Y"])
def test_prims_of_a_stage_in_centimetres_fall_where_they_are(tmp_path, up):
    """A stretched cube below a turned and raised group falls freely for half a second; its stage uses centimetres."""
    stretched = "double size = 2; float3 xformOp:scale = (10, 20, 5); uniform token[] xformOpOrder = ['xformOp:scale']"
    text = SCALED.format(height=300, body=rigid("Crate", "Cube", stretched.replace("'", '"')))
    path = write_stage(tmp_path / "set.usda", text, up=up, meters=0.01)
    scene = wr.import_usd(path)
    recording = wr.record(wr.Simulator(scene, device="cpu"), frames=30, fps=60)
    wr.export_usd(recording, tmp_path / "shots" / "fall.usda", layout="override")

    mine, theirs = Usd.Stage.Open(str(path)), Usd.Stage.Open(str(tmp_path / "shots" / "fall.usda"))
    assert [str(prim.GetPath()) for prim in theirs.Traverse()] == [str(prim.GetPath()) for prim in mine.Traverse()]
    assert UsdGeom.GetStageUpAxis(theirs) == up and UsdGeom.GetStageMetersPerUnit(theirs) == 0.01
    assert theirs.GetRootLayer().subLayerPaths == ["../set.usda"]
    rest = corners(mine, "/World/Set/Crate", Usd.TimeCode.Default())
    fall = np.zeros(3)
    for frame in (0, 12, 30):
        # The stage has 24 time codes a second, the film 60 frames.
        found = corners(theirs, "/World/Set/Crate", frame * 24.0 / 60.0)
        seconds = frame / 60.0
        fall["XYZ".index(up)] = -0.5 * 981.0 * seconds * (seconds + 1.0 / 240.0)  # semi-implicit Euler
        np.testing.assert_allclose(found, rest + fall, atol=0.05)


def test_bodies_that_are_switched_off_are_hidden(tmp_path):
    """One from the start until half a second, one from then on, and one never."""
    text = "".join(rigid(name, "Sphere", moved(3 * k, 0, 0)) for k, name in enumerate(("Late", "Gone", "Always")))
    scene = wr.import_usd(write_stage(tmp_path / "set.usda", text))
    sim = wr.Simulator(scene, device="cpu")
    sim.set("active", False, bodies=["Late"])

    def switch(frame, sim):
        if frame == 6:
            sim.set("active", [True, False], bodies=["Late", "Gone"])

    wr.export_usd(wr.record(sim, frames=12, fps=12, on_frame=switch), tmp_path / "shot.usda", layout="override")
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    for frame in range(13):
        for name, shown in (("Late", frame > 6), ("Gone", frame <= 6), ("Always", True)):
            prim = UsdGeom.Imageable(stage.GetPrimAtPath(f"/World/{name}"))
            assert (prim.ComputeVisibility(frame * 24.0 / 12.0) == "inherited") == shown
    assert not stage.GetPrimAtPath("/World/Always").GetAttribute("visibility").HasAuthoredValue()


def test_a_root_that_is_moved_is_taken_into_account(tmp_path):
    body = rigid("Ball", "Sphere", f"double radius = 1; {moved(0, 0, 5)}")
    path = write_stage(tmp_path / "set.usda", SCALED.format(height=2, body=body))
    scene = wr.import_usd(path, "/World/Set")
    wr.export_usd(start_of(scene), tmp_path / "still.usda", layout="override")
    theirs = Usd.Stage.Open(str(tmp_path / "still.usda"))
    found = UsdGeom.Imageable(theirs.GetPrimAtPath("/World/Set/Ball")).ComputeLocalToWorldTransform(0.0)
    np.testing.assert_allclose(found.ExtractTranslation(), (0, 0, 7), atol=1e-9)


def test_what_cannot_be_overridden_is_refused_in_one_line(tmp_path):
    path = write_stage(tmp_path / "set.usda", rigid("Ball", "Sphere"))
    imported = start_of(wr.import_usd(path))
    with pytest.raises(ValueError, match="path: must not be the imported file itself"):
        wr.export_usd(imported, path, layout="override")
    with pytest.raises(ValueError, match="layout: override requires a scene that was imported"):
        wr.export_usd(start_of(wr.scenes.load("seesaw")), tmp_path / "a.usda", layout="override")
    with pytest.raises(ValueError, match="envs: must be one environment"):
        wr.export_usd(start_of(wr.import_usd(path), 2), tmp_path / "a.usda", layout="override")
    with pytest.raises(ValueError, match="layout: override is written at the end"):
        wr.UsdStream(None, tmp_path / "a.usda", layout="override")


def test_command_writes_an_override(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_stage(tmp_path / "set.usda", rigid("Ball", "Sphere"))
    command = ["run", "set.usda", "-o", "shot.usda", "--usd-layout", "override", "--frames", "6", "--device", "cpu"]
    assert cli.main(command) == 0
    stage = Usd.Stage.Open("shot.usda")
    times = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Ball")).GetTimeSamples()
    assert len(times) == 7
    assert cli.main(["run", "seesaw", *command[2:]]) == 2
    assert "--usd-layout: override requires a scene from a USD file" in capsys.readouterr().err
