"""The shapes of bodies.

Every file of this folder is imported, so that each shape is registered (see `Shape.classes`).
"""

from importlib import import_module
from pkgutil import iter_modules

from warp_rigid.scene.shapes.analytic import Box, Capsule, Cylinder, Plane, Sphere
from warp_rigid.scene.shapes.base import Grid, Part, PartKind, Shape
from warp_rigid.scene.shapes.compound import Compound
from warp_rigid.scene.shapes.heightfield import HarmonicMotion, Heightfield
from warp_rigid.scene.shapes.mesh import Mesh
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

for _file in iter_modules(__path__):
    import_module(f"{__name__}.{_file.name}")
