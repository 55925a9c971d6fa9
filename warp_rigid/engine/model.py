"""The model: scenes as device arrays, with the pool of shapes and the bodies of all environments."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from warp_rigid.engine import joints
from warp_rigid.engine.layout import Layout, exclusive_sums
from warp_rigid.engine.moving_ground import build_surfaces
from warp_rigid.engine.settings import PER_ENVIRONMENT, Settings, check_setting
from warp_rigid.engine.shape_pool import UNBOUNDED, Pool, build_pool
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.enums import OutOfBounds
from warp_rigid.scene.body_columns import column, is_dynamic, shapes_of
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.pose_path import PosePath
from warp_rigid.scene.scene import COMBINE_RULES, SURFACE_VELOCITIES, Body, Motion, Scene
from warp_rigid.scene.shapes import Shape

OVERSIZED = 4.0
"""A dynamic body more than this many times larger than the median is not of ordinary size."""


FEWEST_ITERATIONS, MOST_ITERATIONS = 16, 32
"""Iterations of continuous collision detection. In each, the impacts of the previous one reach the next body of a
chain, so there are as many as bodies. A body in a hollow one, which lands, is hit several times. They end when no body
is hit: a heap of 4096 boxes that lands takes 9 on average, and sometimes more than the maximum. With 8 at most, its
boxes overlap by 48 mm instead of 20 mm, of 200 mm."""


class SizeGroups(NamedTuple):
    """Bodies of a scene by size, for the broad phase.

    Attributes:
        small: (n,) dynamic bodies of ordinary size.
        oversized: (n,) the other bodies.
        width: cell width of the hash grid at the level of ordinary bodies [m].
    """

    small: np.ndarray
    oversized: np.ndarray
    width: float


@dataclass(frozen=True)
class Model:
    """The scenes on the device; constant except for the parameters that users set.

    Attributes:
        layout: the scene of each environment.
        shapes: pool of shapes.
        surfaces: vertices of moving ground.
        surface_node: their first grid node in the pool.
        bodies: bodies of all environments.
        fields: force fields of all environments.
        size_groups: for each scene, its bodies by size.
        joints: joints of all environments.
        paths: paths of kinematic bodies of all environments.
    """

    layout: Layout
    shapes: Any
    surfaces: Any
    surface_node: int
    bodies: Any
    fields: Any
    size_groups: dict[Scene, SizeGroups]
    joints: Any
    paths: Any

    def part(self, first: int, end: int) -> "Model":
        """The model of the environments `first` to `end - 1`, over the same arrays."""
        ranges = self.layout.ranges(first, end)
        names = ("surfaces", "bodies", "fields", "joints", "paths")
        parts: dict[str, Any] = {name: declare.part(getattr(self, name), ranges) for name in names}
        node = self.surface_node + ranges["vertices"][0]
        return replace(self, layout=self.layout.part(first, end), surface_node=node, **parts)


class Arrays(NamedTuple):
    """The scenes on the device, and what steps change.

    Attributes:
        model: the scenes.
        state: state of the bodies.
        sleep_state: sleep state of the bodies.
        envs: settings and status of the environments.
    """

    model: Model
    state: Any
    sleep_state: Any
    envs: Any

    def part(self, first: int, end: int) -> "Arrays":
        """The environments `first` to `end - 1`, over the same arrays."""
        ranges = self.model.layout.ranges(first, end)
        changed = (declare.part(arrays, ranges) for arrays in (self.state, self.sleep_state, self.envs))
        return Arrays(self.model.part(first, end), *changed)


def build_model(layout: Layout, device: Any) -> Model:
    """Upload the scenes of all environments."""
    pool = build_pool(layout, device)
    groups = {scene: _split_by_size(scene.bodies) for scene in layout.scenes}
    return Model(
        layout=layout,
        shapes=pool.arrays,
        surfaces=build_surfaces(layout, pool, device),
        surface_node=pool.arrays.grid_value.shape[0] - layout.sizes["vertices"],
        bodies=_upload_bodies(layout, pool, device),
        fields=_upload_fields(layout, device),
        size_groups=groups,
        joints=joints.upload(layout, device),
        paths=_upload_paths(layout, device),
    )


def initial_state(layout: Layout, device: Any) -> Any:
    """The initial state of every environment."""
    state = declare.allocate(schema.State, layout.sizes, device)
    for name in ("position", "orientation", "linear_velocity", "angular_velocity"):
        getattr(state, name).assign(_column(layout, name, np.float32))
    state.active.assign(_column(layout, "active", np.int32))
    return state


def initial_environments(layout: Layout, settings: Settings, device: Any) -> Any:
    """Rules, gravity and settings of every environment."""
    envs = declare.allocate(schema.Environments, layout.sizes, device)
    envs.first_body.assign(layout.first_body.astype(np.int32))
    bounds = [scene.bounds or ((0.0,) * 3,) * 2 for scene in layout.scenes]
    of_scene: dict[str, Any] = {
        "gravity": np.array([scene.gravity for scene in layout.scenes], np.float32),
        "friction_rule": [COMBINE_RULES.index(scene.friction_combine) for scene in layout.scenes],
        "restitution_rule": [COMBINE_RULES.index(scene.restitution_combine) for scene in layout.scenes],
        "out_of_bounds": [
            OutOfBounds.UNBOUNDED if scene.bounds is None else OutOfBounds[scene.out_of_bounds.upper()]
            for scene in layout.scenes
        ],
        "ccd_iterations": [ccd_iterations(scene) for scene in layout.scenes],
        "lower": np.array([lower for lower, _ in bounds], np.float32),
        "upper": np.array([upper for _, upper in bounds], np.float32),
    }
    for name, rows in of_scene.items():
        values = np.asarray(rows)[layout.scene_of]
        getattr(envs, name).assign(values if values.dtype == np.float32 else values.astype(np.int32))
    for name in PER_ENVIRONMENT:
        getattr(envs, name).fill_(check_setting(name, getattr(settings, name)))
    return envs


def ccd_iterations(scene: Scene) -> int:
    """Iterations of continuous collision detection in an environment."""
    mechanisms = joints.mechanisms_of(scene).members
    alone = int(is_dynamic(scene.bodies).sum()) - sum(map(len, mechanisms))
    # Mechanisms that fall together stop one after the other, and each stop changes the motion of all bodies of one.
    return min(max(alone + 2 * len(mechanisms), FEWEST_ITERATIONS), MOST_ITERATIONS)


def _column(layout: Layout, name: str, kind: Any) -> np.ndarray:
    """An attribute of all bodies, (bodies, ...)."""
    return column(layout.scene_bodies, name, kind)[layout.source]


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


def _split_by_size(bodies: list[Body]) -> SizeGroups:
    """Dynamic bodies of ordinary size, the other bodies, and the cell width of the grid for the former."""
    shapes, shape_of = shapes_of(bodies)
    reach = np.array([0.5 * np.linalg.norm(_extent(shape)) for shape in shapes])[shape_of]
    dynamic = is_dynamic(bodies)
    typical = float(np.median(reach[dynamic])) if dynamic.any() else 1.0
    small = dynamic & (reach <= OVERSIZED * typical)
    width = 2.0 * float(reach[small].max()) if small.any() else 1.0
    return SizeGroups(np.flatnonzero(small).astype(np.int32), np.flatnonzero(~small).astype(np.int32), width)


def _extent(shape: Shape) -> np.ndarray:
    """Side lengths of the shape's bounding box [m]."""
    lower, upper = shape.bounds
    return np.clip(upper, -UNBOUNDED, UNBOUNDED) - np.clip(lower, -UNBOUNDED, UNBOUNDED)


def _filtered(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The bodies with which contact is filtered out, body by body, and their number for each body."""
    pairs = np.array(sorted(scene.filtered_pairs), np.int32).reshape(-1, 2)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.lexsort((both[:, 1], both[:, 0]))
    return both[order, 1], np.bincount(both[:, 0], minlength=len(scene.bodies))


def _centers_of_mass(layout: Layout) -> np.ndarray:
    """Centres of mass in the shape's frame, (bodies, 3); zero for static bodies, which may be unbounded."""
    shapes, shape_of = layout.shapes_of_bodies
    moves = column(layout.scene_bodies, "motion", np.int32) != Motion.STATIC
    used = np.bincount(shape_of[moves], minlength=len(shapes)) > 0
    centers = [shape.center_of_mass if used[k] else np.zeros(3) for k, shape in enumerate(shapes)]
    return np.where(moves[:, None], np.array(centers)[shape_of], 0.0).astype(np.float32)


def _upload_fields(layout: Layout, device: Any) -> Any:
    """Write the kinds and parameters of the force fields."""
    found, source = layout.entries(lambda scene: scene.force_fields)
    rows = [field.row() for field in found]
    width = max((len(row) for row in rows), default=0)
    fields = declare.allocate(schema.FieldForces, {**layout.sizes, "field_parameters": width}, device)
    fields.start.assign(layout.starts["fields"].astype(np.int32))
    if layout.sizes["fields"]:
        fields.kind.assign(np.array([int(field.kind) for field in found], np.int32)[source])
        fields.parameters.assign(np.array([np.pad(row, (0, width - len(row))) for row in rows])[source])
    return fields


def _upload_paths(layout: Layout, device: Any) -> Any:
    """Write the distinct paths once, and which body of each environment follows which."""
    found, source = layout.entries(lambda scene: [body.path for body in scene.bodies if body.path])
    distinct: list[PosePath] = list(dict.fromkeys(found))
    first = exclusive_sums(np.array([len(path.times) for path in distinct], np.int64))
    which = np.array([distinct.index(path) for path in found], np.int64)
    follows = np.array([body.path is not None for body in layout.scene_bodies], bool)
    rows: dict[str, Any] = {
        "body": np.flatnonzero(follows[layout.source]).astype(np.int32),
        "first": first[which][source].astype(np.int32),
        "count": np.diff(first)[which][source].astype(np.int32),
        "loop": np.array([path.loop for path in found], np.int32)[source],
    }
    for name in ("times", "positions", "orientations", "turned"):
        keyframes = [getattr(path, name) for path in distinct]
        rows[name.removesuffix("s")] = np.concatenate(keyframes) if keyframes else []
    return declare.upload(schema.Paths, rows, device)


def _upload_bodies(layout: Layout, pool: Pool, device: Any) -> Any:
    """Write the properties of all bodies, those of each scene for all its environments."""
    source = layout.source
    rows = declare.allocate(schema.Bodies, layout.sizes, device)
    rows.env.assign(layout.env_of_row.astype(np.int32))
    others, per_body = zip(*map(_filtered, layout.scenes), strict=True)
    if layout.sizes["filtered"]:
        rows.filtered.assign(np.concatenate(others)[layout.copies([len(some) for some in others])])
    rows.filtered_start.assign(exclusive_sums(np.concatenate(per_body)[source]).astype(np.int32))
    rows.motion.assign(_column(layout, "motion", np.int32))
    rows.center_of_mass.assign(_centers_of_mass(layout)[source])
    for name in (*COEFFICIENTS, *SURFACE_VELOCITIES):
        getattr(rows, name).assign(_column(layout, name, np.float32))
    for name, value in _masses(layout).items():
        getattr(rows, name).assign(value[source])
    rows.shape.assign(pool.shape_of_row)
    return rows


def _masses(layout: Layout) -> dict[str, np.ndarray]:
    """Masses, inertia tensors and their inverses of bodies; zero unless dynamic."""
    bodies = layout.scene_bodies
    tails = {"mass": (), "inverse_mass": (), "inertia": (3, 3), "inverse_inertia": (3, 3)}
    host = {name: np.zeros((len(bodies), *tail), np.float32) for name, tail in tails.items()}
    shapes, shape_of = layout.shapes_of_bodies
    dynamic = np.flatnonzero(is_dynamic(bodies))
    by_shape = dynamic[np.argsort(shape_of[dynamic], kind="stable")]
    mass = column(bodies, "mass")
    for own in np.split(by_shape, np.flatnonzero(np.diff(shape_of[by_shape])) + 1) if len(by_shape) else ():
        for name, value in mass_arrays(shapes[shape_of[own[0]]], mass[own]).items():
            host[name][own] = value
    return host
