"""The pool of shapes: each distinct shape once for all environments, and moving ground once for each environment."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from warp_rigid.engine.layout import Layout, exclusive_sums
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.shape_arrays import MOST_OF_LEAF
from warp_rigid.scene.body_columns import shapes_of
from warp_rigid.scene.scene import Motion, Scene
from warp_rigid.scene.shapes import PartKind, SampleKind, Shape
from warp_rigid.scene.shapes.heightfield import Heightfield, moves

UNBOUNDED = 2.0e9
"""Used for the infinite extents of planes [m]; products with it do not overflow in float32."""


class Entry(NamedTuple):
    """A shape of the pool.

    Attributes:
        shape: the shape.
        reach: reach within which distances to it must be exact [m]; used for height fields only.
        env: the environment of this copy of a moving shape, -1 for a shape that environments share.
    """

    shape: Shape
    reach: float = 0.0
    env: int = -1


@dataclass(frozen=True)
class Pool:
    """The pool of shapes on the device.

    Attributes:
        arrays: the schema.Shapes.
        shape_of_row: index into the pool for each body of all environments, (bodies,) int32.
        moving: index in the pool, field and environment of each copy of a moving field.
        sample_start: (shapes + 1,) first sample of each shape of the pool.
    """

    arrays: Any
    shape_of_row: np.ndarray
    moving: list[tuple[int, Heightfield, int]]
    sample_start: np.ndarray


def build_pool(layout: Layout, device: Any) -> Pool:
    """Collect the shapes of all scenes, concatenate their parts, grids, clusters and samples, and upload them."""
    entries, shape_of_row = _entries(layout)
    parts = [entry.shape.parts() for entry in entries]
    samples = [entry.shape.samples() for entry in entries]
    grids, grid_of_part = _grids(entries, parts)
    balls = np.concatenate([entry.shape.inner_balls for entry in entries])
    hull = np.concatenate([np.zeros((0, 3)), *(entry.shape.hull for entry in entries)])
    nodes, triangles = _trees([part for group in parts for part in group])
    rows = {
        "shapes": _shape_rows(entries, parts, samples),
        "parts": _part_rows(entries, parts, grids, grid_of_part),
        "clusters": _cluster_rows(samples),
        "samples": _sample_rows(samples),
        "unsampled_edges": np.concatenate([s.unsampled_edges for s in samples]),
        "balls": balls.astype(np.float32),
        "hull": hull.astype(np.float32),
        "grid_value": np.concatenate(grids).astype(np.float32),
        "tree": nodes,
        "triangles": triangles,
    }
    return Pool(
        arrays=declare.upload(schema.Shapes, rows, device),
        shape_of_row=shape_of_row,
        moving=[(index, one.shape, one.env) for index, one in enumerate(entries) if moves(one.shape)],
        sample_start=exclusive_sums(np.array([len(some.kind) for some in samples])),
    )


def distinct_shapes(layout: Layout) -> list[tuple[Shape, int]]:
    """The shapes that differ, each the first of its content, with the number of copies that the pool holds of it."""
    copies: dict[str, int] = {}
    shapes: dict[str, Shape] = {}
    envs = np.bincount(layout.scene_of, minlength=len(layout.scenes)).tolist()
    for scene, count in zip(layout.scenes, envs, strict=True):
        for shape in shapes_of(scene.bodies)[0]:
            shapes.setdefault(shape.key, shape)
            copies[shape.key] = copies.get(shape.key, 0) + count if moves(shape) else 1
    return [(shape, copies[key]) for key, shape in shapes.items()]


def _entries(layout: Layout) -> tuple[list[Entry], np.ndarray]:
    """Shapes in the order of the pool, and the index of each body's shape; copies of moving shapes come last."""
    entries: list[Entry] = []
    index: dict[tuple[str, float], int] = {}
    of_body: list[np.ndarray] = []
    reaches = [_exact_reach(scene) for scene in layout.scenes]
    for scene, reach in zip(layout.scenes, reaches, strict=True):
        shapes, shape_of = shapes_of(scene.bodies)
        places = np.full(len(shapes), -1, np.int32)
        for number, shape in enumerate(shapes):
            key = (shape.key, reach if isinstance(shape, Heightfield) else 0.0)
            if not moves(shape) and key not in index:
                index[key] = len(entries)
                entries.append(Entry(shape, key[1]))
            places[number] = index.get(key, -1)
        of_body.append(places[shape_of])
    rows = np.concatenate(of_body)[layout.source]
    copies: dict[tuple[int, str], int] = {}
    for row in np.flatnonzero(rows < 0).tolist():
        env, shape = int(layout.env_of_row[row]), layout.scene_bodies[layout.source[row]].shape
        if (env, shape.key) not in copies:
            copies[env, shape.key] = len(entries)
            entries.append(Entry(shape, reaches[layout.scene_of[env]], env))
        rows[row] = copies[env, shape.key]
    return entries, rows


def _exact_reach(scene: Scene) -> float:
    """Reach within which distances to height fields must be exact [m]: sample radius and half-length, plus a margin."""
    if not any(isinstance(body.shape, Heightfield) for body in scene.bodies):
        return 0.0
    shapes = shapes_of([body for body in scene.bodies if body.motion == Motion.DYNAMIC])[0]
    reach = 0.0 if shapes else UNBOUNDED
    for shape in shapes:
        samples = shape.samples()
        spans = np.linalg.norm(samples.slide, axis=1) + samples.radius
        reach = max(reach, float(spans.max(initial=0.0)) + 0.1 * shape.size)
    return reach


def _grids(entries: list[Entry], parts: list) -> tuple[list[np.ndarray], list[int]]:
    """Values of all grids, and for each part the index of its grid; shapes with equal content share their grids."""
    grids: list[np.ndarray] = [np.zeros(0, np.float32)]
    of_part: list[int] = []
    known: dict[tuple[str, int, int], int] = {}
    for entry, group in zip(entries, parts, strict=True):
        for number, part in enumerate(group):
            key = (entry.shape.key, number, entry.env)
            if part.grid and key not in known:
                known[key] = len(grids)
                grids.append(np.ravel(part.grid.values))
            of_part.append(known.get(key, 0))
    return grids, of_part


def _shape_rows(entries: list[Entry], parts: list, samples: list) -> np.ndarray:
    """One record per shape."""
    shapes = [entry.shape for entry in entries]
    rows = np.zeros(len(shapes), schema.ShapeRecord.numpy_dtype())
    _set_ranges(rows, "part", parts)
    _set_ranges(rows, "cluster", [s.cluster_radius for s in samples])
    _set_ranges(rows, "hull", [shape.hull for shape in shapes])
    _set_ranges(rows, "ball", [shape.inner_balls for shape in shapes])
    rows["convex"] = [len(group) == 1 and group[0].kind not in (PartKind.GRID, PartKind.HEIGHTFIELD) for group in parts]
    rows["inside"] = [
        shape.hull.mean(axis=0) if len(shape.hull) else (group[0].position if group else shape.center_of_mass)
        for shape, group in zip(shapes, parts, strict=True)
    ]
    rows["lower"] = [np.clip(shape.bounds[0], -UNBOUNDED, UNBOUNDED) for shape in shapes]
    rows["upper"] = [np.clip(shape.bounds[1], -UNBOUNDED, UNBOUNDED) for shape in shapes]
    rows["size"] = [min(shape.size, UNBOUNDED) for shape in shapes]
    rows["wall"] = [min(shape.wall, UNBOUNDED) for shape in shapes]
    rows["cell"] = [
        max((part.grid.spacing for part in group if part.kind == PartKind.GRID), default=0.0) for group in parts
    ]
    rows["dip"] = [s.dip for s in samples]
    rows["unsampled_length"] = [
        np.linalg.norm(s.unsampled_edges, axis=1).max() if len(s.unsampled_edges) else 0.0 for s in samples
    ]
    rows["rise"] = [shape.top_speed if moves(shape) else 0.0 for shape in shapes]
    return rows


def _set_ranges(rows: np.ndarray, name: str, lists: list) -> None:
    """Set the first and the last entry that each row has in the lists, which follow each other in one array."""
    start = exclusive_sums(np.array([len(entries) for entries in lists]))
    rows[f"{name}_start"], rows[f"{name}_end"] = start[:-1], start[1:]


def _part_rows(entries: list[Entry], parts: list, grids: list[np.ndarray], grid_of_part: list[int]) -> np.ndarray:
    """One record per part."""
    flat = [(entry.reach, part) for entry, group in zip(entries, parts, strict=True) for part in group]
    rows = np.zeros(len(flat), schema.PartRecord.numpy_dtype())
    for row, (reach, part) in zip(rows, flat, strict=True):
        row["kind"] = int(part.kind)
        row["placed"] = part.position != (0, 0, 0) or part.orientation != (0, 0, 0, 1)
        row["position"], row["orientation"] = part.position, part.orientation
        row["size"] = (*part.size[:3], reach) if part.kind == PartKind.HEIGHTFIELD else part.size
        if part.grid:
            row["grid_dims"] = part.grid.values.shape
            row["grid_origin"], row["grid_spacing"] = part.grid.origin, part.grid.spacing
    rows["grid_start"] = exclusive_sums(np.array([grid.size for grid in grids]))[grid_of_part]
    tree_start = exclusive_sums(np.array([len(part.tree.nodes) if part.tree else 0 for _, part in flat]))
    rows["tree_start"], rows["surface_end"] = tree_start[:-1], tree_start[1:]
    exact = [part.tree is not None and part.tree.signed for _, part in flat]
    rows["tree_end"] = np.where(exact, rows["surface_end"], rows["tree_start"])
    return rows


def _trees(parts: list) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and triangles of the trees of all meshes; their indices count from the start of the pool."""
    trees = [part.tree for part in parts if part.tree]
    node_start = exclusive_sums(np.array([len(tree.nodes) for tree in trees], np.int64))
    triangle_start = exclusive_sums(np.array([len(tree.triangles) for tree in trees], np.int64))
    nodes = np.zeros(node_start[-1], schema.TreeRecord.numpy_dtype())
    for tree, node, triangle in zip(trees, node_start, triangle_start, strict=False):
        rows = nodes[node : node + len(tree.nodes)]
        rows[:] = tree.nodes
        rows["skip"] += node
        rows["leaf"] += MOST_OF_LEAF * triangle
    triangles = np.concatenate([np.zeros(0, schema.TriangleRecord.numpy_dtype()), *[t.triangles for t in trees]])
    return nodes, triangles


def _cluster_rows(samples: list) -> np.ndarray:
    """One record per cluster."""
    first_sample = exclusive_sums(np.array([len(s.kind) for s in samples]))
    rows = np.zeros(sum(len(s.cluster_radius) for s in samples), schema.ClusterRecord.numpy_dtype())
    if len(rows):
        rows["center"] = np.concatenate([s.cluster_center for s in samples])
        rows["radius"] = np.concatenate([s.cluster_radius for s in samples])
        kind = np.concatenate([s.kind[s.cluster_start[:-1]] for s in samples])
        choice = np.concatenate([s.choice[s.cluster_start[:-1]] for s in samples])
        kind = np.where(np.isin(kind, (SampleKind.RIM, SampleKind.CAP)), SampleKind.POINT, kind)
        rows["kind"] = np.where(choice > 1, SampleKind.CORNER, kind)
        for name, ends in (("sample_start", slice(None, -1)), ("sample_end", slice(1, None))):
            rows[name] = np.concatenate(
                [s.cluster_start[ends] + first for s, first in zip(samples, first_sample, strict=False)]
            )
    return rows


def _sample_rows(samples: list) -> np.ndarray:
    """One record per sample."""
    rows = np.zeros(sum(len(s.kind) for s in samples), schema.SampleRecord.numpy_dtype())
    for name in ("point", "normal", "slide", "radius", "kind", "choice"):
        rows[name] = np.concatenate([getattr(s, name) for s in samples])
    first_edge = exclusive_sums(np.array([len(s.unsampled_edges) for s in samples]))
    edges = np.concatenate([s.edges + first for s, first in zip(samples, first_edge, strict=False)])
    rows["edge_start"], rows["edge_end"] = edges.T
    return rows
