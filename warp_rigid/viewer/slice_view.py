"""The slice of a signed distance in the 3-D view, carried along by its body."""

import numpy as np
import viser

from warp_rigid.scene.shapes.base import Shape
from warp_rigid.viewer.slicing import cut


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
            ValueError: as slicing.cut.
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
        length = float(size.max()) / 22.0
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
