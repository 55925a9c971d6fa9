"""Surfaces that run, as the attributes of PhysX for conveyor belts: read and written by name, without its schema."""

import numpy as np
from pxr import Gf, Sdf, Usd

from warp_rigid.usd.prims import applies, value_of
from warp_rigid.usd.specs import set_attribute
from warp_rigid.usd.usd_file import UsdFile

SURFACE_SCHEMA = "PhysxSurfaceVelocityAPI"
PREFIX = "physxSurfaceVelocity:"
LINEAR, ANGULAR = PREFIX + "surfaceVelocity", PREFIX + "surfaceAngularVelocity"
ENABLED, LOCAL = PREFIX + "surfaceVelocityEnabled", PREFIX + "surfaceVelocityLocalSpace"


def read_surface_motion(
    file: UsdFile, prim: Usd.Prim, rotation: np.ndarray, stretch: np.ndarray, place: np.ndarray, turn: np.ndarray
) -> dict[str, np.ndarray]:
    """Keywords of `Scene.add_static` with the motion of the surface of a body; none for a surface that does not run.

    Args:
        file: the file.
        prim: of the body.
        rotation: (3, 3) of the frame of the body in the world.
        stretch: (3, 3) with which lengths of the prim's frame are given in that frame [m].
        place: position (3,) of the shape in that frame [m].
        turn: rotation (3, 3) of the shape in that frame.
    """
    if not applies(prim, SURFACE_SCHEMA) or not value_of(prim, ENABLED, True):
        return {}
    linear = np.array(value_of(prim, LINEAR, (0.0, 0.0, 0.0)), np.float64)
    angular = np.radians(np.array(value_of(prim, ANGULAR, (0.0, 0.0, 0.0)), np.float64))
    if value_of(prim, LOCAL, True):
        linear = stretch @ linear
    else:
        to_body = rotation.T @ file.to_z_up
        linear, angular = to_body @ (file.meter * linear), to_body @ angular
    motion = {
        "surface_velocity": turn.T @ (linear + np.cross(angular, place)),
        "surface_angular_velocity": turn.T @ angular,
    }
    return {name: value for name, value in motion.items() if value.any()}


def write_surface_motion(prim: Sdf.PrimSpec, linear: np.ndarray, angular: np.ndarray) -> None:
    """Write the velocity (3,) [m/s] and angular velocity (3,) [rad/s] of a surface, in the frame of the prim."""
    set_attribute(prim, ENABLED, Sdf.ValueTypeNames.Bool, True)
    set_attribute(prim, LOCAL, Sdf.ValueTypeNames.Bool, True)
    set_attribute(prim, LINEAR, Sdf.ValueTypeNames.Vector3f, Gf.Vec3f(*map(float, linear)))
    set_attribute(prim, ANGULAR, Sdf.ValueTypeNames.Vector3f, Gf.Vec3f(*map(float, np.degrees(angular))))
