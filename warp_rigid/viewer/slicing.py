"""A plane through a body's signed distance, carried along by its body: colours, the zero line and the gradient."""

from typing import NamedTuple

import numpy as np
import viser

from warp_rigid.scene.shapes.base import Shape

AXES = ("x", "y", "z")
POINTS = 200
"""Points along the longer side of a slice."""
ARROWS = 22
MARGIN = 0.15
"""How far the plane reaches beyond the body, as part of its size."""
INSIDE, ZERO, OUTSIDE = np.array([178, 60, 50]), np.array([247, 247, 244]), np.array([40, 100, 175])
BANDS = 12


class Slice(NamedTuple):
    """What is seen in a plane through a body, in the body's own frame.

    Attributes:
        image: (height, width, 3) uint8; rows run downward along the second axis of the plane.
        lower: (2,) and `upper`: (2,) ends of the plane along its two axes [m].
        arrows: (n, 2, 3) from a point of the plane along the distance's gradient in the plane [m].
        axes: numbers of the plane's two axes, then of the one across it.
        place: where it cuts that axis [m].
    """

    image: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    arrows: np.ndarray
    axes: tuple[int, int, int]
    place: float


def cut(shape: Shape, axis: int, part: float) -> Slice:
    """Cut a body's signed distance.

    Args:
        shape: of the body; one that has ends.
        axis: 0, 1 or 2: which axis the plane is across.
        part: where, from 0 at its lower end to 1 at its upper end.

    Raises:
        ValueError: The shape has no ends, as a plane has none.
    """
    lower, upper = np.asarray(shape.bounds)
    if not np.isfinite([lower, upper]).all():
        raise ValueError("slice: a body without ends cannot be cut")
    place = float(lower[axis] + part * (upper - lower)[axis])
    # The axes of the plane follow each other so that, with the one across, they make a right-handed frame.
    u, v = (axis + 1) % 3, (axis + 2) % 3
    margin = MARGIN * float((upper - lower).max())
    low = np.array([lower[u], lower[v]]) - margin
    high = np.array([upper[u], upper[v]]) + margin

    def plane(points):
        step = (high - low).max() / points
        us, vs = (np.arange(low[k] + step / 2.0, high[k], step) for k in range(2))
        where = np.full((len(vs), len(us), 3), place)
        where[..., u], where[..., v] = us[None, :], vs[:, None]
        distance, gradient = shape.signed_distance(where.reshape(-1, 3))
        return step, where, distance.reshape(where.shape[:2]), gradient.reshape(where.shape)

    step, _, distance, _ = plane(POINTS)
    image = _colors(distance, step)[::-1]
    step, where, _, gradient = plane(ARROWS)
    gradient[..., axis] = 0.0
    arrows = np.stack([where, where + 0.7 * step * gradient], axis=2).reshape(-1, 2, 3)
    return Slice(image, low, high, arrows, (u, v, axis), place)


def _colors(distance: np.ndarray, step: float) -> np.ndarray:
    """Red inside, blue outside, bands of equal distance, a black line where it is zero."""
    most = np.abs(distance).max() or 1.0
    part = np.abs(distance)[..., None] / most
    image = ZERO + np.where(distance[..., None] < 0.0, INSIDE - ZERO, OUTSIDE - ZERO) * part**0.8
    band = np.floor(distance / most * BANDS)
    edge = np.zeros(distance.shape, bool)
    edge[1:] |= band[1:] != band[:-1]
    edge[:, 1:] |= band[:, 1:] != band[:, :-1]
    image[edge] *= 0.85
    image[np.abs(distance) < 0.9 * step] = 15
    return np.clip(image, 0, 255).astype(np.uint8)


class SliceView:
    """A picture in the plane of the slice, and arrows along the gradient.

    Args:
        server: the viser server.
    """

    def __init__(self, server: viser.ViserServer):
        """Nothing is shown yet."""
        self._scene = server.scene
        self._frame = self._scene.add_frame("/slice", show_axes=False, visible=False)

    def cut(self, shape: Shape, axis: int, part: float) -> np.ndarray:
        """Show a slice of a shape; returns it as a picture, (height, width, 3) uint8.

        Raises:
            ValueError: as the function cut.
        """
        found = cut(shape, axis, part)
        u, v, w = found.axes
        size = found.upper - found.lower
        center = np.zeros(3)
        center[[u, v]] = 0.5 * (found.lower + found.upper)
        center[w] = found.place
        turned = np.zeros((3, 3))
        # The picture's own frame: x to its right, y down, z into it.
        turned[u, 0], turned[v, 1], turned[w, 2] = 1.0, -1.0, -1.0
        wxyz = viser.transforms.SO3.from_matrix(turned).wxyz
        self._scene.add_image(
            "/slice/plane",
            found.image,
            render_width=float(size[0]),
            render_height=float(size[1]),
            position=tuple(center),
            wxyz=tuple(wxyz),
            cast_shadow=False,
            receive_shadow=False,
        )
        length = float(size.max()) / ARROWS
        self._scene.add_arrows(
            "/slice/gradient",
            found.arrows,
            (40, 42, 46),
            shaft_radius=0.025 * length,
            head_radius=0.09 * length,
            head_length=0.22 * length,
        )
        self._frame.visible = True
        return found.image

    def follow(self, position: np.ndarray, orientation: np.ndarray) -> None:
        """Move with the body."""
        if self._frame.visible:
            self._frame.position = tuple(position)
            self._frame.wxyz = tuple(orientation[[3, 0, 1, 2]])

    def hide(self) -> None:
        """Take the slice off the page."""
        self._frame.visible = False
