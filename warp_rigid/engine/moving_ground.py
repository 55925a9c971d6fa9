"""Moving height fields as device arrays: each environment has its own copy in the pool of shapes."""

from typing import Any

import numpy as np

from warp_rigid.kernels import declare, schema
from warp_rigid.scene.shapes.base import Shape
from warp_rigid.scene.shapes.heightfield import Heightfield, moves

FIELDS = ("sample", "around", "per_x", "per_y", "height", "amplitude", "phase", "frequency")


def with_copies(shapes: list[Shape], num_envs: int) -> tuple[list[Shape], np.ndarray, np.ndarray]:
    """Shapes in the order of the pool: first the shared ones, then a copy of the moving ones for each environment.

    Returns:
        The pool's shapes; the index of each of `shapes` (its first copy) in the pool, (n,); and the index increment
        from one environment's copy to the next, (n,): the number of moving shapes, or 0.
    """
    moving = np.array([moves(shape) for shape in shapes], dtype=np.int32)
    alike = [shape for shape in shapes if not moves(shape)]
    copied = [shape for shape in shapes if moves(shape)]
    place = np.where(moving, len(alike) + np.cumsum(moving), np.cumsum(1 - moving)) - 1
    return alike + copied * num_envs, place.astype(np.int32), moving * len(copied)


def build_surfaces(pooled: list[Shape], sample_start: np.ndarray, num_envs: int, device: Any) -> tuple[Any, int]:
    """The vertices of all moving fields, in the order of their nodes in the pool of grids.

    Args:
        pooled: as from `with_copies`.
        sample_start: (shapes + 1,) first sample of each pooled shape.
        num_envs: number of environments, each with its own copy of the fields.
        device: a Warp device.

    Returns:
        The Surfaces, and the number of vertices.
    """
    columns: dict[str, list[np.ndarray]] = {name: [] for name in FIELDS}
    count = 0
    for index, shape in enumerate(pooled):
        if not moves(shape):
            continue
        for name, values in _vertices(shape, int(sample_start[index])).items():
            columns[name].append(values)
        count += shape.heights.size
    surfaces = declare.allocate(schema.Surfaces, {"vertices": count}, device)
    if count:
        surfaces.env.assign(np.repeat(np.arange(num_envs, dtype=np.int32), count // num_envs))
        for name, parts in columns.items():
            getattr(surfaces, name).assign(np.concatenate(parts))
    return surfaces, count


def _vertices(field: Heightfield, first_sample: int) -> dict[str, np.ndarray]:
    """Columns of one copy of a field."""
    rows, columns = field.heights.shape
    i, j = np.indices((rows, columns))
    left, right = np.maximum(i - 1, 0), np.minimum(i + 1, rows - 1)
    back, front = np.maximum(j - 1, 0), np.minimum(j + 1, columns - 1)
    along_x, along_y = ((left - i) * columns, (right - i) * columns), (back - j, front - j)
    cell = field.extent / (np.array(field.heights.shape) - 1)
    return {
        "sample": first_sample + _sample_of_vertex(field),
        "around": np.stack([*along_x, *along_y], axis=-1).reshape(-1, 4).astype(np.int32),
        "per_x": (1.0 / ((right - left) * cell[0])).reshape(-1).astype(np.float32),
        "per_y": (1.0 / ((front - back) * cell[1])).reshape(-1).astype(np.float32),
        "height": field.heights.reshape(-1).astype(np.float32),
        "amplitude": field.amplitude.reshape(-1).astype(np.float32),
        "phase": field.phase.reshape(-1).astype(np.float32),
        "frequency": np.full(rows * columns, field.angular_frequency, np.float32),
    }


def _sample_of_vertex(field: Heightfield) -> np.ndarray:
    """Index of the sample at each vertex, (vertices,) int32; samples are grouped in clusters, not in vertex order."""
    last = np.array(field.heights.shape) - 1
    place = np.rint((field.samples().point[:, :2] / field.extent + 0.5) * last).astype(np.int64)
    vertex = place[:, 0] * field.heights.shape[1] + place[:, 1]
    sample = np.empty(len(vertex), np.int32)
    sample[vertex] = np.arange(len(vertex))
    return sample
