"""The exported file, read back with the USD library alone."""

import dataclasses

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation

from tests.fakes import FakeSimulator
from tests.usd_tools import validator_errors
from warp_rigid import Box, Cylinder, Plane, Scene, Simulator, Sphere
from warp_rigid.runs.recording import record
from warp_rigid.scenes.builders import meshes
from warp_rigid.usd import export_usd, import_usd

FRAMES = 24


@pytest.fixture(scope="module")
def recording():
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    scene.add_static(Box((0.1, 0.2, 0.3)), position=(0.0, 0.0, 0.3), name="table top")
    scene.add_body(Box((0.1, 0.2, 0.3)), position=(1.0, 0.0, 2.0), name="brick")
    scene.add_body(Sphere(0.2), position=(0.0, 1.0, 3.0), name="ball")
    scene.add_body(Box((0.1, 0.2, 0.3)), position=(0.0, -1.0, 4.0), name="brick")
    scene.add_kinematic(Cylinder(0.3, 0.1), position=(-1.0, 0.0, 1.0), name="3rd wheel")
    recording = record(FakeSimulator(scene, num_envs=3), FRAMES, fps=24.0, envs=[0, 2])
    return dataclasses.replace(recording, labels=("off", "two_pass"))


@pytest.fixture(scope="module", params=["film.usdc", "film.usda", "film.usdz"])
def path(request, recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("usd") / "made" / request.param
    export_usd(recording, path, profile="animation")
    return path


@pytest.fixture(scope="module")
def stage(path):
    return Usd.Stage.Open(str(path))


def instancers(stage):
    return [UsdGeom.PointInstancer(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.PointInstancer)]


def poses(stage, time):
    """Body -> position and quaternion (x, y, z, w) in each environment, from ids alone."""
    result = {}
    for instancer in instancers(stage):
        env = instancer.GetPath().pathString.split("/")[2]
        values = zip(
            instancer.GetIdsAttr().Get(time),
            instancer.GetPositionsAttr().Get(time),
            instancer.GetOrientationsfAttr().Get(time),
            strict=True,
        )
        for body, position, quaternion in values:
            xyzw = (*quaternion.GetImaginary(), quaternion.GetReal())
            result[env, body] = (*position, *xyzw)
    return result


def test_usd_validators_find_nothing(stage):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in errors] == []


def test_stage_tells_units_and_times(stage):
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert stage.GetFramesPerSecond() == stage.GetTimeCodesPerSecond() == 24.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, FRAMES)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert all(
        stage.HasAuthoredMetadata(name) for name in ("upAxis", "metersPerUnit", "kilogramsPerUnit", "framesPerSecond")
    )


@pytest.mark.parametrize("frame", [0, 1, 13, FRAMES])
def test_poses_are_the_recordings(stage, recording, frame):
    found = poses(stage, frame)
    assert len(found) == 2 * 6
    for row, env in enumerate(("env_0000", "env_0002")):
        for body in range(6):
            pose = np.array(found[env, body], dtype=np.float32)
            assert (pose[:3] == recording.position[frame, row, body]).all()
            quaternion = recording.orientation[frame, row, body]
            assert (pose[3:] == quaternion).all() or (pose[3:] == -quaternion).all()


def test_quaternions_never_take_the_long_way(stage, recording):
    raw = np.sum(recording.orientation[1:] * recording.orientation[:-1], axis=-1)
    assert (raw < 0).any()
    for frame in range(FRAMES):
        now, then = poses(stage, frame), poses(stage, frame + 1)
        assert all(np.dot(now[key][3:], then[key][3:]) > 0 for key in now)


def test_environments_stand_apart_by_their_own_prim_only(stage):
    offsets = []
    for name, label in (("env_0000", "off"), ("env_0002", "two_pass")):
        prim = stage.GetPrimAtPath(f"/World/{name}")
        assert prim.GetDisplayName() == label
        matrix = UsdGeom.XformCache().GetLocalToWorldTransform(prim)
        assert matrix.ExtractRotationMatrix() == Gf.Matrix3d(1.0)
        offsets.append(np.array(matrix.ExtractTranslation()))
    assert np.linalg.norm(offsets[0] - offsets[1]) > 2.0


def test_extents_are_those_usd_computes(stage):
    for instancer in instancers(stage):
        for time in (Usd.TimeCode.Default(), Usd.TimeCode(7)):
            computed = instancer.ComputeExtentAtTime(time, time)
            np.testing.assert_allclose(instancer.GetExtentAttr().Get(time), computed, atol=1e-5)


def test_nothing_is_drawn_but_the_instances(stage):
    """Meshes lie under an instancer, which draws them only as instances, or in a class."""
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            owner = prim.GetParent().GetParent()
            assert owner.IsA(UsdGeom.PointInstancer)
    assert stage.GetPrimAtPath("/World/Shapes").IsAbstract()


def test_prototypes_are_complete_meshes(stage, recording):
    for instancer in instancers(stage):
        assert set(instancer.GetProtoIndicesAttr().Get()) == {0}
        (target,) = instancer.GetPrototypesRel().GetTargets()
        assert stage.GetPrimAtPath(target).GetParent().GetTypeName() == "Scope"
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(target))
        surface = recording.surfaces[recording.surface[instancer.GetIdsAttr().Get()[0]]]
        points = np.array(mesh.GetPointsAttr().Get())
        # The ground of the first environment reaches below the others.
        if surface.endless:
            assert points.max() > surface.vertices.max() and len(points) == len(surface.vertices)
        else:
            assert (points == surface.vertices).all()
        assert (np.array(mesh.GetFaceVertexIndicesAttr().Get()) == surface.faces.ravel()).all()
        assert (np.array(mesh.GetFaceVertexCountsAttr().Get()) == 3).all()
        assert mesh.GetSubdivisionSchemeAttr().Get() == UsdGeom.Tokens.none
        assert mesh.GetNormalsInterpolation() == UsdGeom.Tokens.faceVarying
        normals = np.array(mesh.GetNormalsAttr().Get())
        assert len(normals) == surface.faces.size
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-5)
        np.testing.assert_array_equal(mesh.GetExtentAttr().Get(), [points.min(0), points.max(0)])


def test_each_body_has_its_colour(stage):
    for instancer in instancers(stage):
        primvar = UsdGeom.PrimvarsAPI(instancer).GetPrimvar("displayColor")
        assert len(primvar.Get()) == len(instancer.GetIdsAttr().Get())
        assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex


def test_still_bodies_have_no_samples(stage):
    sampled = {
        body: instancer.GetPositionsAttr().GetNumTimeSamples()
        for instancer in instancers(stage)
        for body in instancer.GetIdsAttr().Get()
    }
    assert sampled == {0: 0, 1: 0, 2: FRAMES + 1, 3: FRAMES + 1, 4: FRAMES + 1, 5: 0}


def test_bodies_of_one_shape_share_an_instancer(stage):
    groups = sorted(sorted(i.GetIdsAttr().Get()) for i in instancers(stage) if i.GetPath().HasPrefix("/World/env_0000"))
    assert groups == [[0], [1], [2, 4], [3], [5]]


def test_one_environment_stands_at_the_origin(recording, tmp_path):
    export_usd(recording, tmp_path / "one.usdc", envs=[2])
    stage = Usd.Stage.Open(str(tmp_path / "one.usdc"))
    envs = [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren() if prim.IsA("Xform")]
    assert envs == ["env_0002"]
    matrix = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/env_0002"))
    assert matrix == Gf.Matrix4d(1.0)


def test_bad_arguments_are_named(recording, tmp_path):
    with pytest.raises(ValueError, match=r"path: must end in one of .usd"):
        export_usd(recording, tmp_path / "film.mp4")
    with pytest.raises(ValueError, match=r"envs: \[1\] were not recorded"):
        export_usd(recording, tmp_path / "film.usdc", envs=[1])
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        export_usd(recording, tmp_path / "file" / "film.usdc")


@pytest.mark.parametrize("profile", ["animation", "scene"])
def test_a_renderer_finds_a_material_lights_and_a_camera_that_sees_the_bodies(tmp_path, profile):
    scene = Scene()
    scene.add_static(Plane())
    for i in range(4):
        scene.add_body(Sphere(0.2), position=(1.5 * i, 0, 1.0))
    path = tmp_path / "film.usda"
    export_usd(record(Simulator(scene, num_envs=2, device="cpu"), 6), path, profile=profile)
    assert validator_errors(path) == []
    stage = Usd.Stage.Open(str(path))
    kinds = {prim.GetTypeName() for prim in stage.Traverse()}
    assert {"DistantLight", "DomeLight", "Camera", "Material"} <= kinds
    shape = next(prim for prim in stage.Traverse(Usd.TraverseInstanceProxies()) if prim.IsA(UsdGeom.Boundable))
    material = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()[0]
    surface = material.ComputeSurfaceSource()[0]
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    suns = [prim for prim in stage.Traverse() if prim.GetTypeName() == "DistantLight"]
    assert [prim.GetAttribute("inputs:normalize").Get() for prim in suns] == [True]
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(Usd.TimeCode(0)).frustum
    for env in range(2):
        offset = np.array(stage.GetPrimAtPath(f"/World/env_000{env}").GetAttribute("xformOp:translate").Get())
        for i in range(4):
            assert frustum.Intersects(Gf.Vec3d(*(offset + [1.5 * i, 0, 1.0]))), (env, i)


@pytest.mark.parametrize("profile", ["animation", "scene"])
def test_level_grounds_of_several_environments_are_drawn_once_and_below_all(tmp_path, profile):
    """Coincident surfaces are black in path tracers."""
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    scene.add_body(Sphere(0.2), position=(3, 0, 1.0))
    path = tmp_path / "film.usda"
    export_usd(record(Simulator(scene, num_envs=4, device="cpu"), 6), path, profile=profile)
    stage = Usd.Stage.Open(str(path))
    grounds = [UsdGeom.Imageable(stage.GetPrimAtPath(f"/World/env_000{env}/ground")) for env in range(4)]
    assert [ground.ComputeVisibility() for ground in grounds] == ["inherited", *["invisible"] * 3]
    boxes = UsdGeom.BBoxCache(Usd.TimeCode(0), ["default", "render"], useExtentsHint=False)
    drawn = boxes.ComputeWorldBound(grounds[0].GetPrim()).ComputeAlignedRange()
    for env in range(4):
        offset = stage.GetPrimAtPath(f"/World/env_000{env}").GetAttribute("xformOp:translate").Get()
        for x in (-4.0, 4.0):
            assert drawn.GetMin()[0] <= offset[0] + x <= drawn.GetMax()[0], (env, x)


def test_bodies_of_a_scene_are_drawn_as_meshes_with_a_material_within_their_instance(tmp_path):
    """Blender reads no material of a cube or sphere, and none that is bound outside of an instance."""
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    for i, shape in enumerate((Sphere(0.2), Box((0.1, 0.2, 0.3)), meshes.octahedron())):
        scene.add_body(shape, position=(1.5 * i, 0, 1.0))
    path = tmp_path / "film.usda"
    recording = record(Simulator(scene, device="cpu"), 3)
    export_usd(recording, path, profile="scene")
    stage = Usd.Stage.Open(str(path))
    colors = set()
    for prototype in stage.GetPrototypes():
        shapes = [prim for prim in Usd.PrimRange(prototype) if prim.IsA(UsdGeom.Gprim)]
        drawn = [prim for prim in shapes if UsdGeom.Imageable(prim).ComputePurpose() == "default"]
        assert [prim.GetTypeName() for prim in drawn] == ["Mesh"]
        material = UsdShade.MaterialBindingAPI(drawn[0]).ComputeBoundMaterial()[0]
        assert material.GetPath().HasPrefix(prototype.GetPath())
        colors.add(tuple(material.ComputeSurfaceSource()[0].GetInput("diffuseColor").Get()))
    assert len(colors) == 4
    again = import_usd(path)
    assert [type(body.shape).__name__ for body in again.bodies] == ["Plane", "Sphere", "Box", "Mesh"]
