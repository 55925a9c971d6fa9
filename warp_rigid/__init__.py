"""warp_rigid: GPU-parallel batched simulation of nonconvex rigid bodies with stacking, on NVIDIA Warp.

import warp_rigid as wr

scene = wr.Scene()
scene.add_static(wr.Plane(normal=(0, 0, 1), offset=0.0))
scene.add_body(wr.Box(half_extents=(0.1, 0.1, 0.1)), position=(0, 0, 1))
sim = wr.Simulator(scene, num_envs=64)
sim.step(240)
print(sim.get("position")[:, 1])
"""

from warp_rigid import interruption

if interruption.is_of_command():
    interruption.end_at_once()

import warp

if warp.config.log_level == warp.LOG_INFO:
    # Warp reports on stdout, where it would mix with what a program prints.
    warp.config.log_level = warp.LOG_WARNING

from warp_rigid import notebook as notebook  # registers what the classes show
from warp_rigid import scenes
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.errors import CapacityError, NonFiniteError
from warp_rigid.render.gltf import export_gltf
from warp_rigid.runs.recording import Recording, record
from warp_rigid.scene import fields
from warp_rigid.scene.camera import Camera
from warp_rigid.scene.coefficients import Coefficients
from warp_rigid.scene.fields import *  # noqa: F403
from warp_rigid.scene.joints import (
    DistanceJoint,
    Drive,
    FixedJoint,
    Joint,
    JointFrame,
    PrismaticJoint,
    RevoluteJoint,
    SphericalJoint,
)
from warp_rigid.scene.look import Look
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.scene import Body, Motion, Scene
from warp_rigid.scene.shapes import (
    Box,
    Capsule,
    Compound,
    Cylinder,
    HarmonicMotion,
    Heightfield,
    Mesh,
    Plane,
    Shape,
    Sphere,
)
from warp_rigid.sweep import Choice, Integers, LogUniform, Normal, SweepResult, Uniform, search, sweep
from warp_rigid.usd import UsdStream, export_usd, import_robot, import_usd
from warp_rigid.version import __version__ as __version__

__all__ = [
    "Body",
    "Box",
    "Camera",
    "CapacityError",
    "Capsule",
    "Choice",
    "Coefficients",
    "Compound",
    "Cylinder",
    "DistanceJoint",
    "Drive",
    "FixedJoint",
    "JointFrame",
    "HarmonicMotion",
    "Heightfield",
    "Integers",
    "Joint",
    "LogUniform",
    "Look",
    "Mesh",
    "Motion",
    "NonFiniteError",
    "Normal",
    "Plane",
    "PosePath",
    "PrismaticJoint",
    "Recording",
    "RevoluteJoint",
    "Scene",
    "Settings",
    "Shape",
    "Simulator",
    "Sphere",
    "SphericalJoint",
    "SweepResult",
    "Uniform",
    "UsdStream",
    "export_gltf",
    "export_usd",
    "import_robot",
    "import_usd",
    "record",
    "scenes",
    "search",
    "sweep",
]
__all__ += fields.__all__


def __dir__() -> list[str]:
    """The public names, without the modules that are imported with them."""
    return [*__all__, "__version__"]
