"""Masses, centres and inertia of imported bodies are those that OpenUSD computes from the same file."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

import warp_rigid as wr
from tests.oracles import random_quaternion, rotation_matrix


def quaternion(turn):
    """An array (x, y, z, w) as OpenUSD's type."""
    x, y, z, w = map(float, turn)
    return Gf.Quatf(w, x, y, z)


def solid(kind, scale):
    """Volume and principal moments for density 1 of the default solids of UsdGeom, scaled alike along all axes."""
    if kind == "Cube":
        volume, moments = 8.0, np.full(3, 16.0 / 3.0)
    elif kind == "Sphere":
        volume, moments = 4.0 / 3.0 * np.pi, np.full(3, 8.0 / 15.0 * np.pi)
    else:  # a cylinder of radius 1 and height 2 about z
        volume, moments = 2.0 * np.pi, 2.0 * np.pi * np.array([7.0 / 12.0, 7.0 / 12.0, 0.5])
    return volume * scale**3, moments * scale**5


def state_mass(prim, rng):
    """State nothing, the density, the mass, also the centre, or all properties."""
    api = UsdPhysics.MassAPI.Apply(prim)
    stated = rng.integers(5)
    if stated == 1:
        api.CreateDensityAttr(rng.uniform(100.0, 2000.0))
    if stated >= 2:
        api.CreateMassAttr(rng.uniform(1.0, 10.0))
    if stated >= 3:
        api.CreateCenterOfMassAttr(Gf.Vec3f(*rng.uniform(-0.3, 0.3, 3)))
    if stated == 4:
        moments = rng.uniform(1.0, 1.9, 3)  # the largest is less than the sum of the others
        api.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments))
        api.CreatePrincipalAxesAttr(quaternion(random_quaternion(rng)))


def random_body(stage, rng):
    """A body of one to four colliders; returns it with what OpenUSD needs to know of each collider."""
    body = UsdGeom.Xform.Define(stage, "/World/Body")
    body.AddTranslateOp().Set(Gf.Vec3d(*rng.normal(size=3)))
    body.AddOrientOp().Set(quaternion(random_quaternion(rng)))
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    material = UsdShade.Material.Define(stage, "/World/Material")
    UsdPhysics.MaterialAPI.Apply(material.GetPrim()).CreateDensityAttr(500.0)
    if rng.random() < 0.5:
        UsdShade.MaterialBindingAPI.Apply(body.GetPrim()).Bind(material, materialPurpose="physics")
    parts = {}
    for k in range(rng.integers(1, 5)):
        kind, scale = rng.choice(["Cube", "Sphere", "Cylinder"]), rng.uniform(0.3, 1.2)
        place, turn = rng.normal(size=3), random_quaternion(rng)
        shape = getattr(UsdGeom, kind).Define(stage, f"/World/Body/part_{k}")
        shape.AddTranslateOp().Set(Gf.Vec3d(*place))
        shape.AddOrientOp().Set(quaternion(turn))
        shape.AddScaleOp().Set(Gf.Vec3f(scale))
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
        state_mass(shape.GetPrim(), rng)
        told = UsdPhysics.RigidBodyAPI.MassInformation()
        told.volume, moments = solid(kind, scale)
        told.inertia = Gf.Matrix3f(*np.diag(moments).ravel().tolist())
        told.centerOfMass, told.localPos, told.localRot = Gf.Vec3f(0.0), Gf.Vec3f(*place), quaternion(turn)
        parts[shape.GetPath()] = told
    state_mass(body.GetPrim(), rng)
    return body, parts


@pytest.mark.parametrize("seed", range(25))
def test_mass_properties_are_those_of_openusd(tmp_path, seed):
    rng = np.random.default_rng(seed)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(stage.DefinePrim(Sdf.Path("/World"), "Xform"))
    body, parts = random_body(stage, rng)
    api = UsdPhysics.RigidBodyAPI(body.GetPrim())
    mass, moments, center, axes = api.ComputeMassProperties(lambda prim: parts[prim.GetPath()])
    stage.Export(str(tmp_path / "body.usda"))

    scene = wr.import_usd(tmp_path / "body.usda", strict=True)
    sim = wr.Simulator(scene, device="cpu")
    assert sim.get("mass")[0, 0] == pytest.approx(mass, rel=1e-5)
    np.testing.assert_allclose(scene.bodies[0].shape.center_of_mass, center, atol=1e-5)
    inner = rotation_matrix(np.array([*axes.imaginary, axes.real]))
    turn = rotation_matrix(np.asarray(scene.bodies[0].orientation)) @ inner
    expected = turn @ np.diag(np.array(moments)) @ turn.T
    np.testing.assert_allclose(sim.get("inertia")[0, 0], expected, rtol=1e-4, atol=1e-4 * max(moments))
