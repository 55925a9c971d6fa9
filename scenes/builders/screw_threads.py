"""A bolt and a nut with a single-start right-handed thread of trapezoidal profile, by the manifold3d package."""

import math
from dataclasses import dataclass

import numpy as np

from warp_rigid.scene.shapes.mesh import Mesh

SLICES_PER_TURN = 60
ARC, FLANK_ARC = math.radians(10.0), math.radians(6.0)
"""Largest angle between neighbouring corners of a cross-section, on crest and root, and on the flanks, which touch."""


@dataclass(frozen=True)
class Thread:
    """Dimensions of a thread.

    Attributes:
        core: radius of the bolt between the ridges [m].
        crest: radius of the bolt on the ridge [m].
        pitch: axial distance between neighbouring turns [m].
        crest_part: width of the ridge's crest over the pitch.
        flank_part: axial width of each flank over the pitch.
        clearance: gap between the flanks of bolt and nut along their normal [m].
        radial_clearance: between crests and roots, which do not touch [m].
    """

    core: float = 0.032
    crest: float = 0.040
    pitch: float = 0.040
    crest_part: float = 0.38
    flank_part: float = 0.12
    clearance: float = 0.0004
    radial_clearance: float = 0.002

    @property
    def mean_radius(self) -> float:
        """Radius of the middle of the flanks [m]."""
        return 0.5 * (self.core + self.crest)

    @property
    def lead_tangent(self) -> float:
        """Tangent of the angle by which the thread rises, at the mean radius."""
        return self.pitch / (2.0 * math.pi * self.mean_radius)

    @property
    def flank_tangent(self) -> float:
        """Tangent of the angle between a flank and the plane across the axis, in a section through the axis."""
        return self.flank_part * self.pitch / (self.crest - self.core)

    def section(self, of_nut: bool = False) -> np.ndarray:
        """Corners of the cross-section of the bolt, or of the nut's hole, at z = 0, counter-clockwise, (n, 2) [m]."""
        crest, flank, outwards = 0.5 * self.crest_part, self.flank_part, 0.0
        if of_nut:
            outwards = self.radial_clearance
            axial = self.clearance * math.hypot(1.0, self.flank_tangent) - outwards * self.flank_tangent
            crest += axial / self.pitch
        turns = np.array([-crest, crest, crest + flank, 1.0 - crest - flank, 1.0 - crest])
        radii = np.array([self.crest, self.crest, self.core, self.core, self.crest]) + outwards
        corners = []
        for k, arc in enumerate((ARC, FLANK_ARC, ARC, FLANK_ARC)):
            count = math.ceil(2.0 * math.pi * (turns[k + 1] - turns[k]) / arc)
            part = np.arange(count) / count
            angle = 2.0 * math.pi * (turns[k] + part * (turns[k + 1] - turns[k]))
            radius = radii[k] + part * (radii[k + 1] - radii[k])
            corners.append(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
        return np.concatenate(corners)


def bolt(thread: Thread, length: float, head_height: float, across_flats: float) -> Mesh:
    """A bolt whose thread begins at z = 0 and whose hexagonal head is below.

    Args:
        thread: its dimensions.
        length: of the thread [m].
        head_height: of the head [m].
        across_flats: width of the head [m].
    """
    head = _hexagon(across_flats, head_height).translate((0.0, 0.0, -head_height))
    return _mesh(head + _screw(thread.section(), thread, length))


def nut(thread: Thread, height: float, across_flats: float) -> Mesh:
    """A hexagonal nut between z = 0 and `height`, which fits a bolt at the same pose, turned and raised alike.

    Args:
        thread: dimensions of the bolt.
        height: along the axis [m].
        across_flats: its width [m].
    """
    return _mesh(_hexagon(across_flats, height) - _screw(thread.section(of_nut=True), thread, height))


def _screw(section, thread, length):
    """The cross-section, extruded along the axis and turned once per pitch."""
    import manifold3d

    turns = length / thread.pitch
    slices = round(SLICES_PER_TURN * turns)
    return manifold3d.Manifold.extrude(manifold3d.CrossSection([section]), length, slices, 360.0 * turns)


def _hexagon(across_flats, height):
    """A hexagonal prism from z = 0, its corners cut off by cones of 30 degrees as on a real nut."""
    import manifold3d

    angle = math.pi / 3.0 * np.arange(6)
    corner = across_flats / math.sqrt(3.0)
    prism = manifold3d.Manifold.extrude(
        manifold3d.CrossSection([corner * np.stack([np.cos(angle), np.sin(angle)], axis=1)]), height
    )
    cut = (corner - 0.48 * across_flats) * math.tan(math.pi / 6.0)
    profile = [(0, 0), (0.48 * across_flats, 0), (corner, cut), (corner, height - cut)]
    profile += [(0.48 * across_flats, height), (0, height)]
    return prism ^ manifold3d.Manifold.revolve(manifold3d.CrossSection([np.array(profile, float)]), 48)


def _mesh(solid):
    data = solid.to_mesh64()
    return Mesh(np.array(data.vert_properties)[:, :3], np.array(data.tri_verts, dtype=np.int32))
