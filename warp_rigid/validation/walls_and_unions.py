"""Section H: meshes with walls thinner than a cell of their distance grid, and unions of shells that overlap."""

import warnings

import numpy as np
import trimesh

from warp_rigid import rotations
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scene.shapes.mesh import Mesh
from warp_rigid.scenes.builders import meshes
from warp_rigid.scenes.builders.grounds import EARTH
from warp_rigid.scenes.builders.scene_parts import body, in_space, static
from warp_rigid.validation.case import Cases, Check, absolute, at_most, case, measured, relative
from warp_rigid.validation.experiment import Experiment, of_body

SIZE = 0.3
"""Width of the vessels and of the plates, and height of the drop [m]."""
PLATE = 1e-3
"""Thickness of the plates [m]."""
DEEPEST = 1e-3
"""Largest overlap at any time [m]."""
STRATA = 80
"""Cells of a side of the box of stratified points; volumes of solids that fill a tenth of it are exact to 0.1 %."""


def cases(quick: bool) -> Cases:
    """All cases of the section; one vessel and one body if quick."""
    if quick:
        return [vessels(("tray",), (200,), ("box",)), plates(), unions(("ball and box",), STRATA // 2)]
    return [vessels(("tray", "cup"), (200, 100, 50), ("ball", "box", "bunny")), plates(), unions(tuple(PARTS))]


def vessel(kind: str, wall: float) -> Mesh:
    """A vessel, open at the top, with its lower side at z = 0."""
    if kind == "tray":
        height = 0.2 * SIZE
        outer = trimesh.creation.box((SIZE, SIZE, height))
        inner = trimesh.creation.box((SIZE - 2 * wall, SIZE - 2 * wall, height))
    else:
        height = 0.7 * SIZE
        outer = trimesh.creation.cylinder(0.5 * SIZE, height)
        inner = trimesh.creation.cylinder(0.5 * SIZE - wall, height)
    outer.apply_translation((0, 0, 0.5 * height))
    inner.apply_translation((0, 0, 0.5 * height + wall))
    return Mesh.from_trimesh(trimesh.boolean.difference([outer, inner], engine="manifold"))


BODIES = {
    "ball": lambda: Sphere(0.02),
    "box": lambda: Box((0.02, 0.02, 0.02)),
    "bunny": lambda: meshes.bunny(0.05, sdf_resolution=32),
}


def vessels(kinds, shares, bodies, count=6):
    """Bodies dropped into vessels whose walls are a share of their width; a cell of the grid is 1/64 of it."""

    def experiment(kind, share, name):
        def scene():
            return in_space(static(vessel(kind, SIZE / share)), body(BODIES[name]()), gravity=EARTH)()

        draw = np.random.default_rng(72)
        place = draw.uniform((-0.05, -0.05, SIZE), (0.05, 0.05, SIZE), (count, 3))
        starts = of_body(position=place, orientation=rotations.random(draw, count))
        variants = tuple(str(k) for k in range(count))
        label = f"{name}, {kind} 1/{share}"
        return Experiment(scene, 2.0, variants, starts, every=4, label=label, watch_overlap=True)

    cells = [(kind, share, name) for kind in kinds for share in shares for name in bodies]
    experiments = tuple(experiment(*cell) for cell in cells)

    def outside(trace):
        place = trace.center[:, :, 1]
        return (np.abs(place[..., :2]).max(axis=(0, 2)) > 0.5 * SIZE) | (place[..., 2].min(axis=0) < 0.0)

    return case(
        "V72 bodies dropped into vessels with walls of a share of the width",
        "what is inside a closed wall stays inside",
        measured("outside at any time", "", outside, at_most(0.0)),
        *(
            measured(f"deepest overlap of the {name} at any time", "m", deepest, at_most(DEEPEST), rows=rows)
            for name, rows in ((name, np.repeat([cell[2] == name for cell in cells], count)) for name in bodies)
        ),
        of=experiments,
    )


def deepest(trace):
    """Deepest overlap of each environment in the whole record [m]."""
    return trace.overlap.max(axis=0)


def plates():
    """A plate thrown onto a held one, flat and tilted."""
    speeds = (0.5, 2.0, 10.0)
    tilts = np.array([[0, 0, 0], [0.01, 0, 0], [0.02, 0.01, 0.3], [0.05, -0.05, 0.8]])
    orientations = np.column_stack([tilts, np.ones(4)])
    orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)

    plate = Mesh.from_trimesh(trimesh.creation.box((SIZE, SIZE, PLATE)))
    scene = in_space(static(plate), body(plate, position=(0.03, -0.02, 0.05)))
    names = tuple(f"{speed:g} m/s, tilt {k}" for speed in speeds for k in range(len(orientations)))
    velocity = [(0.0, 0.0, -speed) for speed in speeds for _ in orientations]
    starts = of_body(orientation=np.tile(orientations, (len(speeds), 1)), linear_velocity=velocity)
    return case(
        "V72 a plate of 1 mm thrown onto another, as meshes",
        "solids do not pass through each other",
        measured("passed", "", lambda t: t.position[:, :, 1, 2].min(axis=0) < 0.0, at_most(0.0)),
        measured("deepest overlap at any time", "m", deepest, at_most(DEEPEST)),
        of=Experiment(scene, 0.5, names, starts, watch_overlap=True),
    )


def random_parts():
    """Boxes and balls in random poses that overlap."""
    draw = np.random.default_rng(73)
    parts = []
    for k in range(5):
        part = trimesh.creation.icosphere(radius=0.35) if k % 2 else trimesh.creation.box(draw.uniform(0.3, 1, 3))
        part.apply_transform(trimesh.transformations.random_rotation_matrix(draw.random(3)))
        parts.append(part.apply_translation(draw.uniform(-0.4, 0.4, 3)))
    return parts


PARTS = {
    "ball and box": lambda: [trimesh.creation.icosphere(radius=0.1), trimesh.creation.box((0.12, 0.12, 0.3))],
    "cross": lambda: [trimesh.creation.box(np.roll((3.0, 1.0, 1.0), k)) for k in range(3)],
    "bench": lambda: [
        trimesh.creation.box((1.0, 0.4, 0.1)),
        *(trimesh.creation.box((0.1, 0.4, 0.5)).apply_translation((x, 0, -0.22)) for x in (-0.4, 0.4)),
    ],
    "five parts": random_parts,
}
"""Closed convex shells that overlap."""


def inside_any(parts, points) -> np.ndarray:
    """Whether points are in any of some convex parts: behind all of its faces."""
    found = np.zeros(len(points), bool)
    for part in parts:
        offset = np.einsum("fi,fi->f", part.face_normals, part.triangles[:, 0])
        planes = np.round(np.column_stack([part.face_normals, offset]), 9)
        first = np.unique(planes, axis=0, return_index=True)[1]
        rows = np.arange(len(points))
        # A few faces at a time: a ball has a thousand, and most points are soon found to be outside.
        for faces in np.array_split(first, -(-len(first) // 16)):
            rows = rows[(points[rows] @ part.face_normals[faces].T < offset[faces]).all(axis=1)]
        found[rows] = True
    return found


def unions(names, strata=STRATA):
    """Mass properties and sign of a mesh of shells that overlap, against points inside any of them."""

    def compare(parts):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that they were joined
            mesh = Mesh.from_trimesh(trimesh.util.concatenate(parts))
        lower, upper = mesh.bounds
        draw = np.random.default_rng(7)
        cell = np.stack(np.meshgrid(*3 * [np.arange(strata)], indexing="ij"), axis=-1).reshape(-1, 3)
        points = lower + (upper - lower) * (cell + draw.random(cell.shape)) / strata
        inside = inside_any(parts, points)
        volume = np.prod(upper - lower) * inside.mean()
        arm = points[inside] - points[inside].mean(axis=0)
        spread = arm.T @ arm / len(arm)
        inertia = volume * (np.trace(spread) * np.eye(3) - spread)
        some = draw.choice(len(points), 20_000, replace=False)
        distance, _ = mesh.signed_distance(points[some])
        wrong = ((distance < 0.0) != inside[some]) & (np.abs(distance) > 1e-5)
        return mesh.volume, volume, np.abs(mesh.inertia - inertia).max() / np.abs(inertia).max(), wrong.sum()

    return case(
        "V73 meshes of closed shells that overlap",
        "stratified points inside any of the shells, half-space tests in float64",
        Check("volume", "m^3", lambda s: [row[0] for row in s], relative(0.01), lambda s: [row[1] for row in s]),
        Check("inertia error relative to the largest entry", "", lambda s: [row[2] for row in s], at_most(0.01)),
        Check("points with the wrong sign", "", lambda s: [row[3] for row in s], absolute(0)),
        compute=lambda _: [compare(PARTS[name]()) for name in names],
        labels=names,
        on_device=False,
    )
