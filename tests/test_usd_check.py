"""`warp-rigid usd`: faults that the USD library's own validators miss, and instancers made flat."""

import json

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warp_rigid as wr
from tests.fakes import FakeSimulator
from tests.usd_tools import rigid, validator_errors, write_stage
from warp_rigid.commands import cli
from warp_rigid.usd.check import check_usd
from warp_rigid.usd.instancing import flatten_usd

INSTANCER = """
def PointInstancer "Many" {
    point3f[] positions%s
    int[] protoIndices = [0, %d]
    rel prototypes = </World/Many/P/A>
    float3[] extent = [(-9, -9, -9), (9, 9, 9)]
    def Scope "P" {
        def Sphere "A" {
            float3[] extent = [(-1, -1, -1), (1, 1, 1)]
        }
    }
}
"""
TETRAHEDRON = (
    "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]; int[] faceVertexCounts = [3, 3, 3, 3];"
    " int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]; float3[] extent = [(0, 0, 0), (1, 1, 1)];"
)
MOVING = "double3 xformOp:translate.timeSamples = { 0: (0, 0, 5) }"
FAULTY = {
    "InstancerArrays": (INSTANCER % (" = [(0, 0, 0), (1, 0, 0)]", 1), "protoIndices are from 0 to 1"),
    "InstancerArrays ": (INSTANCER % (" = [(0, 0, 0)]", 0), "positions has 1 values for 2 instances"),
    "DefaultTimePose": (
        INSTANCER % (".timeSamples = { 0: [(0, 0, 0), (1, 0, 0)] }", 0),
        "positions has 1 time samples",
    ),
    "DefaultTimePose ": (
        rigid("Box", "Cube", MOVING + '; uniform token[] xformOpOrder = ["xformOp:translate"]'),
        "xformOp:translate has 1 time samples but no default value",
    ),
    "ApproximationToken": (
        rigid(
            "Solid", "Mesh", TETRAHEDRON + 'uniform token physics:approximation = "sdf"', ["PhysicsMeshCollisionAPI"]
        ),
        ", is sdf",
    ),
    "MaterialOnCollider": (
        'def Material "M" (\n prepend apiSchemas = ["PhysicsMaterialAPI"]\n)\n{\n}\n'
        'def Xform "Body" (\n prepend apiSchemas = ["PhysicsRigidBodyAPI", "MaterialBindingAPI"]\n)\n{\n'
        ' rel material:binding:physics = </World/M>\n def Cube "C" (\n'
        ' prepend apiSchemas = ["PhysicsCollisionAPI"]\n)\n'
        "{\n float3[] extent = [(-1, -1, -1), (1, 1, 1)]\n}\n}\n",
        "must be bound to the collider",
    ),
}


@pytest.mark.parametrize("rule", FAULTY)
def test_own_checks_find_what_the_librarys_miss(rule, tmp_path, capsys):
    text, message = FAULTY[rule]
    path = write_stage(tmp_path / "bad.usda", text)
    assert validator_errors(path) == []
    (problem,) = check_usd(path)
    assert problem.rule == rule.strip() and message in problem.text
    assert cli.main(["usd", "check", str(path)]) == 2
    assert problem.path in capsys.readouterr().out


def test_faults_that_the_librarys_validators_find_are_told(tmp_path, capsys):
    stage = Usd.Stage.CreateNew(str(tmp_path / "bare.usda"))
    UsdGeom.Xform.Define(stage, "/root")
    stage.Save()
    assert cli.main(["usd", "check", str(tmp_path / "bare.usda"), "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert {problem["rule"] for problem in found["problems"]} >= {"MissingDefaultPrim"}


def test_a_sound_file_and_no_file(tmp_path, capsys):
    assert cli.main(["usd", "check", str(write_stage(tmp_path / "good.usda", ""))]) == 0
    assert "0 problem(s)" in capsys.readouterr().err
    assert cli.main(["usd", "check", str(tmp_path / "none.usda")]) == 2


def test_a_flat_film_is_the_same_film(tmp_path, capsys):
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for x in range(3):
        scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(x, 0, 2))
    recording = wr.record(FakeSimulator(scene, 2), 10)
    wr.export_usd(recording, tmp_path / "film.usdc", profile="animation")
    assert cli.main(["usd", "flatten", str(tmp_path / "film.usdc"), str(tmp_path / "flat.usda")]) == 0
    assert "8 instances" in capsys.readouterr().out
    assert check_usd(tmp_path / "flat.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "flat.usda"))
    assert not any(prim.IsA(UsdGeom.PointInstancer) for prim in stage.Traverse())
    source = Usd.Stage.Open(str(tmp_path / "film.usdc"))
    for frame in (0, 7, Usd.TimeCode.Default()):
        instancer = UsdGeom.PointInstancer(source.GetPrimAtPath("/World/env_0001/box_1"))
        outer = UsdGeom.XformCache(frame).GetLocalToWorldTransform(instancer.GetPrim())
        for index, matrix in enumerate(instancer.ComputeInstanceTransformsAtTime(frame, frame)):
            prim = stage.GetPrimAtPath(f"/World/env_0001/box_1_instances/instance_{index}/prototype")
            assert prim.IsA(UsdGeom.Mesh) and str(tmp_path) not in (tmp_path / "flat.usda").read_text()
            placed = UsdGeom.XformCache(frame).GetLocalToWorldTransform(prim)
            np.testing.assert_allclose(placed, matrix * outer, atol=1e-6)


def test_flatten_refuses_in_one_line(tmp_path):
    with pytest.raises(ValueError, match="must end in .usd"):
        flatten_usd(tmp_path / "a.usdc", tmp_path / "b.usdz")
    with pytest.raises(FileNotFoundError):
        flatten_usd(tmp_path / "a.usdc", tmp_path / "b.usdc")
