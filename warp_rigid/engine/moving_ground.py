"""Moving height fields as device arrays: each environment has its own copy in the pool of shapes."""

from typing import Any

import numpy as np

from warp_rigid.engine.layout import Layout
from warp_rigid.engine.shape_pool import Pool
from warp_rigid.kernels import declare, schema
from warp_rigid.scene.shapes.heightfield import Heightfield


def build_surfaces(layout: Layout, pool: Pool, device: Any) -> Any:
    """The Surfaces: the vertices of all moving fields, in the order of their nodes in the pool of grids."""
    copies = [_vertices(field, env, int(pool.sample_start[index])) for index, field, env in pool.moving]
    surfaces = declare.allocate(schema.Surfaces, layout.sizes, device)
    for name in copies[0] if copies else ():
        getattr(surfaces, name).assign(np.concatenate([copy[name] for copy in copies]))
    return surfaces


def _vertices(field: Heightfield, env: int, first_sample: int) -> dict[str, np.ndarray]:
    """Columns of one copy of a field."""
    rows, columns = field.heights.shape
    i, j = np.indices((rows, columns))
    left, right = np.maximum(i - 1, 0), np.minimum(i + 1, rows - 1)
    back, front = np.maximum(j - 1, 0), np.minimum(j + 1, columns - 1)
    along_x, along_y = ((left - i) * columns, (right - i) * columns), (back - j, front - j)
    cell = field.extent / (np.array(field.heights.shape) - 1)
    return {
        "env": np.full(rows * columns, env, np.int32),
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
