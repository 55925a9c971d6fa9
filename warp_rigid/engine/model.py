"""The model: a Scene as device arrays, with the pool of shapes and the bodies of all environments."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_rigid.checks import shown
from warp_rigid.engine import joints
from warp_rigid.engine.moving_ground import build_surfaces, with_copies
from warp_rigid.engine.settings import PER_ENVIRONMENT, Settings, check_setting
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.constraints.rows import OTHER_KINDS
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.fields import ForceField
from warp_rigid.scene.scene import COMBINE_RULES, Body, Motion, Scene
from warp_rigid.scene.shapes import PartKind, SampleKind, Shape
from warp_rigid.scene.shapes.heightfield import moves

KINDS = (*OTHER_KINDS, joints)
"""Everything besides contacts that connects bodies: modules with NAME, ROWS, KEPT, `definitions` and `upload`."""

UNBOUNDED = 2.0e9
"""Used for the infinite extents of planes [m]; products with it do not overflow in float32."""

OVERSIZED = 4.0
"""A dynamic body more than this many times larger than the median is not in the hash grid."""


@dataclass(frozen=True)
class Model:
    """A scene on the device; constant except for the parameters that users set.

    Attributes:
        scene: the scene.
        num_envs: number of environments.
        shapes: pool of shapes.
        surfaces: vertices of moving ground.
        surface_vertices: number of these vertices.
        surface_node: their first grid node in the pool.
        bodies: bodies of all environments.
        fields: force fields.
        field_count: number of force fields.
        combine_rules: combine rules of friction and restitution.
        small: (n,) bodies of an environment in the hash grid.
        oversized: (n,) the other bodies.
        grid_radius: cell width of the hash grid [m].
        constraint_rows: arrays of the joints and of the kinds of constraints other than contacts, by name.
    """

    scene: Scene
    num_envs: int
    shapes: Any
    surfaces: Any
    surface_vertices: int
    surface_node: int
    bodies: Any
    fields: Any
    field_count: int
    combine_rules: wp.vec2i
    small: np.ndarray
    oversized: np.ndarray
    grid_radius: float
    constraint_rows: dict[str, Any]

    def part(self, first: int, end: int) -> "Model":
        """The model of the environments `first` to `end - 1`, over the same arrays."""
        vertices = self.surface_vertices // self.num_envs
        return replace(
            self,
            num_envs=end - first,
            bodies=declare.part(self.bodies, env_ranges(self.scene, first, end)),
            surfaces=declare.part(self.surfaces, {"vertices": (first * vertices, end * vertices), "envs": (first, end)})
            if vertices
            else self.surfaces,
            surface_vertices=(end - first) * vertices,
            surface_node=self.surface_node + first * vertices,
            constraint_rows={
                kind.NAME: declare.part(self.constraint_rows[kind.NAME], env_ranges(self.scene, first, end))
                for kind in KINDS
            },
        )


def build_model(scene: Scene, num_envs: int, device: Any) -> Model:
    """Upload a scene for `num_envs` environments."""
    shapes, shape_of_body = _unique_shapes(scene.bodies)
    pooled, place, step = with_copies(shapes, num_envs)
    pool, surfaces, surface_vertices = _pool_shapes(pooled, _exact_reach(scene.bodies), num_envs, device)
    small, oversized, grid_radius = _split_by_size(scene.bodies)
    return Model(
        scene=scene,
        num_envs=num_envs,
        shapes=pool,
        surfaces=surfaces,
        surface_vertices=surface_vertices,
        surface_node=pool.grid_value.shape[0] - surface_vertices,
        bodies=_upload_bodies(scene, place[shape_of_body], step[shape_of_body], oversized, num_envs, device),
        fields=_upload_fields(scene.force_fields, device),
        field_count=len(scene.force_fields),
        combine_rules=wp.vec2i(
            COMBINE_RULES.index(scene.friction_combine), COMBINE_RULES.index(scene.restitution_combine)
        ),
        small=np.array(small, np.int32),
        oversized=np.array(oversized, np.int32),
        grid_radius=grid_radius,
        constraint_rows={kind.NAME: kind.upload(scene, num_envs, device) for kind in KINDS},
    )


def initial_state(scene: Scene, num_envs: int, device: Any) -> Any:
    """The initial state of every environment."""
    state = declare.allocate(schema.State, {"bodies": num_envs * len(scene.bodies)}, device)
    for name in ("position", "orientation", "linear_velocity", "angular_velocity"):
        rows = np.array([getattr(body, name) for body in scene.bodies], np.float32)
        getattr(state, name).assign(np.tile(rows, (num_envs, 1)))
    state.active.assign(np.tile(np.array([body.active for body in scene.bodies], np.int32), num_envs))
    return state


def initial_environments(scene: Scene, settings: Settings, num_envs: int, device: Any) -> Any:
    """Gravity and settings of every environment."""
    envs = declare.allocate(schema.Environments, {"envs": num_envs}, device)
    envs.first_body.assign(len(scene.bodies) * np.arange(num_envs + 1, dtype=np.int32))
    envs.gravity.assign(np.tile(np.array(scene.gravity, np.float32), (num_envs, 1)))
    for name in PER_ENVIRONMENT:
        getattr(envs, name).fill_(check_setting(name, getattr(settings, name)))
    return envs


def mass_arrays(shape: Shape, mass: np.ndarray) -> dict[str, np.ndarray]:
    """Masses (n,) [kg], inertia tensors and their inverses for bodies of one shape."""
    unit = shape.inertia / shape.volume
    inertia = mass[:, None, None] * unit
    return {
        "mass": mass,
        "inverse_mass": 1.0 / mass,
        "inertia": inertia,
        "inverse_inertia": np.linalg.inv(unit) / mass[:, None, None],
    }


def _unique_shapes(bodies: list[Body]) -> tuple[list[Shape], list[int]]:
    """Distinct shapes, and the index of each body's shape."""
    index: dict[str, int] = {}
    shapes: list[Shape] = []
    of_body = []
    for body in bodies:
        if body.shape.key not in index:
            index[body.shape.key] = len(shapes)
            shapes.append(body.shape)
        of_body.append(index[body.shape.key])
    return shapes, of_body


def _split_by_size(bodies: list[Body]) -> tuple[list[int], list[int], float]:
    """Bodies in the hash grid, oversized bodies, and the cell width of the grid [m]."""
    reach = np.array([0.5 * np.linalg.norm(_extent(body.shape)) for body in bodies])
    dynamic = np.array([body.motion == Motion.DYNAMIC for body in bodies], bool)
    typical = float(np.median(reach[dynamic])) if dynamic.any() else 1.0
    small = dynamic & (reach <= OVERSIZED * typical)
    return (
        [int(i) for i in np.flatnonzero(small)],
        [int(i) for i in np.flatnonzero(~small)],
        2.0 * float(reach[small].max()) if small.any() else 1.0,
    )


def _extent(shape: Shape) -> np.ndarray:
    """Side lengths of the shape's bounding box [m]."""
    lower, upper = shape.bounds
    return np.clip(upper, -UNBOUNDED, UNBOUNDED) - np.clip(lower, -UNBOUNDED, UNBOUNDED)


def body_sizes(scene: Scene, num_envs: int) -> dict[str, int]:
    """How long the arrays of Bodies are, and those of the kinds of constraints besides contacts."""
    one = {"bodies": len(scene.bodies), "filtered": 2 * len(scene.filtered_pairs)}
    one |= {kind.NAME: len(kind.definitions(scene)) for kind in OTHER_KINDS} | joints.sizes(scene)
    return {symbol: num_envs * size for symbol, size in one.items()}


def other_constraints(scene: Scene) -> int:
    """Constraints of other kinds than contact in a scene.

    Raises:
        ValueError: a constraint of the scene is of no known kind.
    """
    known = [definition for kind in OTHER_KINDS for definition in kind.definitions(scene)]
    for index, constraint in enumerate(scene.constraints):
        if not any(constraint is definition for definition in known):
            raise ValueError(f"scene.constraints: number {index} is of no known kind, got {shown(constraint)}")
    return len(known)


def env_ranges(scene: Scene, first: int, end: int) -> dict[str, tuple[int, int]]:
    """Rows of the environments from `first` to before `end`, by the symbol that counts them."""
    sizes = {"envs": 1, **body_sizes(scene, 1)}
    return {symbol: (first * size, end * size) for symbol, size in sizes.items()}


def _filtered(scene: Scene) -> list[list[int]]:
    """For each body of an environment, the bodies with which contact is filtered out."""
    others: list[list[int]] = [[] for _ in scene.bodies]
    for a, b in sorted(scene.filtered_pairs):
        others[a].append(b)
        others[b].append(a)
    return others


def _upload_fields(force_fields: list[ForceField], device: Any) -> Any:
    """Write the kinds and parameters of the force fields."""
    rows = [field.row() for field in force_fields]
    width = max((len(row) for row in rows), default=0)
    fields = declare.allocate(schema.FieldForces, {"fields": len(rows), "field_parameters": width}, device)
    if rows:
        fields.kind.assign(np.array([int(field.kind) for field in force_fields], np.int32))
        fields.parameters.assign(np.array([np.pad(row, (0, width - len(row))) for row in rows]))
    return fields


def _upload_bodies(
    scene: Scene, shape_of_body: np.ndarray, step: np.ndarray, oversized: list[int], num_envs: int, device: Any
) -> Any:
    """Repeat one environment's rows for all; the index of each body's shape increases by `step` per environment."""
    bodies = scene.bodies
    filtered = _filtered(scene)
    rows = declare.allocate(schema.Bodies, body_sizes(scene, num_envs), device)
    rows.env.assign(np.repeat(np.arange(num_envs, dtype=np.int32), len(bodies)))
    rows.filtered_start.assign(_starts(num_envs * [len(others) for others in filtered]))
    if scene.filtered_pairs:
        rows.filtered.assign(np.tile(np.concatenate(filtered).astype(np.int32), num_envs))
    host: dict[str, np.ndarray] = {
        "motion": np.array([int(body.motion) for body in bodies], np.int32),
        "oversized": np.isin(np.arange(len(bodies)), oversized).astype(np.int32),
        "center_of_mass": np.array([_center_of_mass(body) for body in bodies], np.float32),
    }
    for name in COEFFICIENTS:
        host[name] = np.array([getattr(body, name) for body in bodies], np.float32)
    shapes = {"mass": (), "inverse_mass": (), "inertia": (3, 3), "inverse_inertia": (3, 3)}
    for name, tail in shapes.items():
        host[name] = np.zeros((len(bodies), *tail), np.float32)
    for i, body in enumerate(bodies):
        if body.motion == Motion.DYNAMIC:
            for name, value in mass_arrays(body.shape, np.array([body.mass])).items():
                host[name][i] = value[0]
    for name, value in host.items():
        getattr(rows, name).assign(np.tile(value, (num_envs,) + (1,) * (value.ndim - 1)))
    rows.shape.assign((shape_of_body + np.arange(num_envs)[:, None] * step).reshape(-1).astype(np.int32))
    return rows


def _center_of_mass(body: Body) -> np.ndarray:
    """Centre of mass in the shape's frame; zero for static bodies, which may be unbounded."""
    return np.zeros(3) if body.motion == Motion.STATIC else body.shape.center_of_mass


def _exact_reach(bodies: list[Body]) -> float:
    """Reach within which distances to height fields must be exact [m]: sample radius and half-length, plus a margin."""
    shapes = {body.shape for body in bodies if body.motion == Motion.DYNAMIC}
    reach = 0.0 if shapes else UNBOUNDED
    for shape in shapes:
        samples = shape.samples()
        spans = np.linalg.norm(samples.slide, axis=1) + samples.radius
        reach = max(reach, float(spans.max(initial=0.0)) + 0.1 * shape.size)
    return reach


def _pool_shapes(shapes: list[Shape], exact_reach: float, num_envs: int, device: Any) -> tuple[Any, Any, int]:
    """Concatenate parts, grids, clusters and samples of all shapes, and the vertices of moving height fields."""
    parts = [shape.parts() for shape in shapes]
    samples = [shape.samples() for shape in shapes]
    flat = [part for group in parts for part in group]
    grids = [np.ravel(part.grid.values) if part.grid else np.zeros(0, np.float32) for part in flat]
    pool = schema.Shapes()
    pool.shapes = wp.array(_shape_rows(shapes, parts, samples), dtype=schema.ShapeRecord, device=device)
    pool.parts = wp.array(_part_rows(flat, grids, exact_reach), dtype=schema.PartRecord, device=device)
    pool.clusters = wp.array(_cluster_rows(samples), dtype=schema.ClusterRecord, device=device)
    pool.samples = wp.array(_sample_rows(samples), dtype=schema.SampleRecord, device=device)
    pool.grid_value = wp.array(np.concatenate(grids).astype(np.float32), dtype=float, device=device)
    return pool, *build_surfaces(shapes, _starts([len(s.kind) for s in samples]), num_envs, device)


def _shape_rows(shapes: list[Shape], parts: list, samples: list) -> np.ndarray:
    """One record per shape."""
    rows = np.zeros(len(shapes), schema.ShapeRecord.numpy_dtype())
    part_start = _starts([len(group) for group in parts])
    cluster_start = _starts([len(s.cluster_radius) for s in samples])
    rows["part_start"], rows["part_end"] = part_start[:-1], part_start[1:]
    rows["convex"] = [len(group) == 1 and group[0].kind not in (PartKind.GRID, PartKind.HEIGHTFIELD) for group in parts]
    rows["cluster_start"], rows["cluster_end"] = cluster_start[:-1], cluster_start[1:]
    rows["lower"] = [np.clip(shape.bounds[0], -UNBOUNDED, UNBOUNDED) for shape in shapes]
    rows["upper"] = [np.clip(shape.bounds[1], -UNBOUNDED, UNBOUNDED) for shape in shapes]
    rows["size"] = [min(shape.size, UNBOUNDED) for shape in shapes]
    rows["rise"] = [shape.top_speed if moves(shape) else 0.0 for shape in shapes]
    return rows


def _part_rows(parts: list, grids: list[np.ndarray], exact_reach: float) -> np.ndarray:
    """One record per part."""
    rows = np.zeros(len(parts), schema.PartRecord.numpy_dtype())
    for row, part in zip(rows, parts, strict=True):
        row["kind"] = int(part.kind)
        row["placed"] = part.position != (0, 0, 0) or part.orientation != (0, 0, 0, 1)
        row["position"], row["orientation"] = part.position, part.orientation
        row["size"] = (*part.size[:3], exact_reach) if part.kind == PartKind.HEIGHTFIELD else part.size
        if part.grid:
            row["grid_dims"] = part.grid.values.shape
            row["grid_origin"], row["grid_spacing"] = part.grid.origin, part.grid.spacing
    rows["grid_start"] = _starts([grid.size for grid in grids])[:-1]
    return rows


def _cluster_rows(samples: list) -> np.ndarray:
    """One record per cluster."""
    first_sample = _starts([len(s.kind) for s in samples])
    rows = np.zeros(sum(len(s.cluster_radius) for s in samples), schema.ClusterRecord.numpy_dtype())
    if len(rows):
        rows["center"] = np.concatenate([s.cluster_center for s in samples])
        rows["radius"] = np.concatenate([s.cluster_radius for s in samples])
        kind = np.concatenate([s.kind[s.cluster_start[:-1]] for s in samples])
        rows["kind"] = np.where(np.isin(kind, (SampleKind.RIM, SampleKind.CAP)), SampleKind.POINT, kind)
        rows["sample_start"] = np.concatenate(
            [s.cluster_start[:-1] + f for s, f in zip(samples, first_sample, strict=False)]
        )
        rows["sample_end"] = np.concatenate(
            [s.cluster_start[1:] + f for s, f in zip(samples, first_sample, strict=False)]
        )
    return rows


def _sample_rows(samples: list) -> np.ndarray:
    """One record per sample."""
    rows = np.zeros(sum(len(s.kind) for s in samples), schema.SampleRecord.numpy_dtype())
    for name in ("point", "normal", "slide", "radius", "kind"):
        rows[name] = np.concatenate([getattr(s, name) for s in samples])
    return rows


def _starts(counts: list[int]) -> np.ndarray:
    """Exclusive sums of counts, with the total at the end."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
