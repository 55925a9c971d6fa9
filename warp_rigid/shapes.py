"""The shapes of bodies, and what the simulation reads of them."""

from warp_rigid.compound import Compound
from warp_rigid.geometry import Grid, Part, PartKind, Shape
from warp_rigid.heightfield import HarmonicMotion, Heightfield
from warp_rigid.mesh import Mesh
from warp_rigid.primitives import Box, Capsule, Cylinder, Plane, Sphere
from warp_rigid.sampling import SampleKind, Samples

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
