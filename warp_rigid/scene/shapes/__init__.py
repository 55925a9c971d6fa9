"""The shapes of bodies, and what the simulation reads of them."""

from warp_rigid.scene.shapes.base import Grid, Part, PartKind, Shape
from warp_rigid.scene.shapes.compound import Compound
from warp_rigid.scene.shapes.heightfield import HarmonicMotion, Heightfield
from warp_rigid.scene.shapes.mesh import Mesh
from warp_rigid.scene.shapes.primitives import Box, Capsule, Cylinder, Plane, Sphere
from warp_rigid.scene.shapes.sampling import SampleKind, Samples

__all__ = [
    "Box",
    "Capsule",
    "Compound",
    "Cylinder",
    "Grid",
    "HarmonicMotion",
    "Heightfield",
    "Mesh",
    "Part",
    "PartKind",
    "Plane",
    "SampleKind",
    "Samples",
    "Shape",
    "Sphere",
]
