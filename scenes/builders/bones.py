"""Procedural surfaces of three bones: cranium, pelvis and femur, closed and nonconvex.

Units are metres, about life size; x points forward, y to the left, z up.
"""

import numpy as np

from warp_rigid.scene.shapes import tessellation
from warp_rigid.scenes.builders import organic

CRANIUM_FREQUENCY = 9  # 1620 triangles
CRANIUM_LENGTH = 0.2
PELVIS_SECTIONS = (44, 18)  # 1584 triangles
FEMUR_SECTIONS = (40, 16)  # 1280 triangles


def cranium() -> tuple[np.ndarray, np.ndarray]:
    """A closed surface of a skull, with eye sockets as hollows."""
    directions, faces = tessellation.geodesic(CRANIUM_FREQUENCY)
    vertices = directions * organic.skull_radius(directions)[:, None]
    return vertices * (CRANIUM_LENGTH / np.ptp(vertices, axis=0).max()), faces


def pelvis() -> tuple[np.ndarray, np.ndarray]:
    """A ring, thin in front and thick behind, whose sides widen into two wings."""
    around, along = PELVIS_SECTIONS
    angle = 2.0 * np.pi * np.arange(around) / around
    section_angle = 2.0 * np.pi * np.arange(along) / along
    # The angle 0 is in front, where the two halves meet; the wings are slightly behind the sides.
    side = np.exp(-(((np.abs(_wrapped(angle)) - 1.9) / 0.55) ** 2))
    back = np.exp(-((_wrapped(angle - np.pi) / 0.5) ** 2))
    thick = 0.013 + 0.012 * back + 0.003 * side
    high = 0.018 + 0.052 * side + 0.030 * back
    middle = np.stack([0.075 * np.cos(angle), 0.095 * np.sin(angle), 0.045 * side - 0.012 * back], axis=1)
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], axis=1)
    lean = 0.65 * side
    upward = np.sin(lean)[:, None] * outward + np.cos(lean)[:, None] * [0.0, 0.0, 1.0]
    across = np.cos(lean)[:, None] * outward - np.sin(lean)[:, None] * [0.0, 0.0, 1.0]
    offset = np.einsum("i,j,ix->ijx", thick, np.cos(section_angle), across)
    offset += np.einsum("i,j,ix->ijx", high, np.sin(section_angle), upward)
    vertices = (middle[:, None] + offset).reshape(-1, 3)
    return vertices, tessellation.ring_of_rings(around, along)


def femur() -> tuple[np.ndarray, np.ndarray]:
    """A slightly bowed shaft with two condyles below, and a neck with a round head at the side."""
    along, around = FEMUR_SECTIONS
    s = np.linspace(0.0, 1.0, along)
    middle = _centerline(s)
    tangent = np.gradient(middle, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    front = np.array([1.0, 0.0, 0.0])
    side = np.cross(tangent, front)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    front = np.cross(side, tangent)
    angle = 2.0 * np.pi * np.arange(around) / around
    width, depth = _femur_radii(s)
    offset = np.einsum("i,j,ix->ijx", depth, np.cos(angle), front)
    offset += np.einsum("i,j,ix->ijx", width, np.sin(angle), side)
    # A groove between the condyles, open below and behind.
    groove = np.exp(-((s / 0.07) ** 2))[:, None] * np.exp(-((_wrapped(angle - np.pi) / 0.5) ** 2))[None]
    offset *= 1.0 - 0.4 * groove[:, :, None]
    tube = (middle[:, None] + offset).reshape(-1, 3)
    first = middle[0] - 0.35 * width[0] * tangent[0]
    last = middle[-1] + 0.35 * width[-1] * tangent[-1]
    below, sides, above = tessellation.capped_tube(along, around)
    return np.concatenate([tube, [first, last]]), np.concatenate([sides, below, above]).astype(np.int32)


def _wrapped(angle):
    """The angle wrapped to [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _centerline(s):
    """From the knee up the shaft, then inward to the head, (n, 3) [m]."""
    bend = np.clip((s - 0.80) / 0.20, 0.0, 1.0)
    x = 0.012 * np.sin(np.pi * np.clip(s / 0.8, 0.0, 1.0))
    y = 0.012 * (1.0 - s) - 0.062 * bend**1.2
    z = 0.42 * s - 0.035 * bend**2
    return np.stack([x, y, z], axis=1)


def _femur_radii(s):
    """Half width and half depth of the sections along the centreline [m]."""
    knee = np.exp(-((s / 0.10) ** 2))
    trochanter = np.exp(-(((s - 0.83) / 0.05) ** 2))
    head = np.sqrt(np.clip(1.0 - ((s - 0.945) / 0.056) ** 2, 0.0, None))
    width = np.maximum(0.0135 + 0.026 * knee + 0.011 * trochanter, 0.023 * head)
    depth = np.maximum(0.0135 + 0.018 * knee + 0.005 * trochanter, 0.023 * head)
    return width, depth
