"""Strings: distance joints drawn as thin tubes between their anchors."""

from dataclasses import replace
from typing import Any

import numpy as np

from warp_rigid.render.appearance import body_gloss, corner_normals
from warp_rigid.render.film import DrawnMesh, Film, concatenated
from warp_rigid.runs.recording import Recording
from warp_rigid.scene.joints import DistanceJoint
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes.tessellation import triangulate_quads

SIDES = 6
"""Sides of a tube."""
THICKNESS = 0.02
"""Radius of a tube, as a fraction of the size of the joint's first body."""
STRETCH = 1.02
"""A string that is longer than this, relative to the greatest distance of its joint, is broken and not drawn."""
COLOR = (0.08, 0.08, 0.09)
"""Linear RGB."""


def with_strings(film: Film, recording: Recording) -> Film:
    """Add the strings of all environments to a film of a recording: distance joints that have a maximum.

    Only the scene of the recording is used: the poses are those of the film, as they may have
    been written to a file instead.

    A recording that was read from a file has no scene; its film stays as it is.
    """
    scene = recording.scene
    joints = scene.joints if scene else []
    entries = [e for e in joints if isinstance(e.joint, DistanceJoint) and np.isfinite(e.joint.range[1])]
    if scene is None or not entries:
        return film
    meshes = [_tubes(film, scene, entries, row) for row in range(len(film.offset))]
    frames, count = film.num_frames, len(meshes)
    strings: dict[str, Any] = {
        "mesh": len(film.meshes) + np.arange(count),
        "color": np.broadcast_to(np.array(COLOR, np.float32), (*film.color.shape[:-2], count, 3)),
        "position": np.broadcast_to(film.offset.astype(np.float32), (frames, count, 3)),
        "orientation": np.broadcast_to(np.array((0, 0, 0, 1), np.float32), (frames, count, 4)),
        "present": np.ones((frames, count), bool),
        "env": np.arange(count),
        "body": np.full(count, -1),
        "motion": np.full(count, Motion.STATIC),
        "gloss": body_gloss(count, {}),
        "image": np.full(count, -1),
    }
    return replace(film, meshes=(*film.meshes, *meshes), **concatenated([vars(film), strings]))


def _tubes(film: Film, scene: Scene, entries: list, row: int) -> DrawnMesh:
    """All strings of an environment as one mesh with the vertices of each frame."""
    vertices = []
    position, orientation, present = _poses(film, len(scene.bodies), row)
    for entry in entries:
        first, second = entry.anchors(position, orientation)
        length = np.linalg.norm(second - first, axis=1)
        drawn = (length <= STRETCH * entry.joint.range[1]) & present[:, entry.body_a]
        if entry.body_b is not None:
            drawn &= present[:, entry.body_b]
        second = np.where(drawn[:, None], second, first)
        radius = THICKNESS * scene.bodies[entry.body_a].shape.size
        vertices.append(_tube(first, second, radius))
    shown = np.concatenate(vertices, axis=1).astype(np.float32)
    k = np.arange(SIDES)
    sides = triangulate_quads(np.stack([2 * k, 2 * ((k + 1) % SIDES), 2 * ((k + 1) % SIDES) + 1, 2 * k + 1], axis=1))
    faces = np.concatenate([2 * SIDES * number + sides for number in range(len(entries))]).astype(np.int32)
    return DrawnMesh(shown[0], faces, corner_normals(shown[0], faces), tuple(shown))


def _poses(film: Film, bodies: int, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, orientations and presence of all bodies of an environment in all frames, (frames, bodies, ...)."""
    own = np.flatnonzero((film.env == row) & (film.body >= 0))
    position, orientation = np.zeros((film.num_frames, bodies, 3)), np.zeros((film.num_frames, bodies, 4))
    present = np.zeros((film.num_frames, bodies), bool)
    position[:, film.body[own]] = film.position[:, own] - film.offset[row]
    orientation[:, film.body[own]] = film.orientation[:, own]
    present[:, film.body[own]] = film.present[:, own]
    return position, orientation, present


def _tube(first: np.ndarray, second: np.ndarray, radius: float) -> np.ndarray:
    """Corners of tubes between points (frames, 3): (frames, 2 SIDES, 3), the two ends of a side one after the other.

    A string between two equal points has no extent.
    """
    along = second - first
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 0.0, along / np.maximum(length, 1e-30), (0.0, 0.0, 1.0))
    helper = np.where(np.abs(along[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    right = np.cross(along, helper)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(along, right)
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    around = np.cos(angle)[:, None] * right[:, None] + np.sin(angle)[:, None] * up[:, None]
    around = np.where(length[:, None] > 0.0, radius * around, 0.0)
    corners = np.stack([first[:, None] + around, second[:, None] + around], axis=2)
    return corners.reshape(len(first), 2 * SIDES, 3)
