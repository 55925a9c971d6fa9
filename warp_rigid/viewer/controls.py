"""Messages that the page may send: the kinds of messages, the values of controls, cameras, and points in the scene."""

import inspect
import logging
import threading
from typing import Any

import numpy as np
import viser
from viser import _messages

from warp_rigid.checks import finite_vector, number_in, one_of, shown

ACCEPTED = (
    _messages.GuiUpdateMessage,
    _messages.CommandTriggerMessage,
    _messages.SceneNodeClickMessage,
    _messages.SceneNodeDragMessage,
)
"""Messages that the viewer's page sends. The others would upload files, open a tunnel or move nodes of the scene."""
FARTHEST = 1.0e6
"""Largest coordinate of a point that the page may send [m]."""
ROUNDING = 1.0e-9
"""A slider's value may leave its range by this part of it: the page adds up steps in floating point."""

log = logging.getLogger(__name__)


def accept_checked_messages(server: viser.ViserServer, inputs: threading.RLock) -> None:
    """Let a server handle only messages that the viewer's page sends, and only checked values and cameras.

    Args:
        server: which.
        inputs: held while a control takes a value from the page and while its callbacks that are coroutines run.
    """
    connection, gui = server._websock_server, server.gui
    for kind in tuple(connection._incoming_handlers):
        if kind not in ACCEPTED:
            connection.unregister_handler(kind)
    connection.unregister_handler(_messages.GuiUpdateMessage)

    async def update(client_id: int, message: _messages.GuiUpdateMessage) -> None:
        widget = None
        try:
            widget = gui._gui_input_handle_from_uuid.get(message.uuid)
            if widget is not None:
                # viser would set any attribute of the control.
                if not isinstance(message.updates, dict) or set(message.updates) != {"value"}:
                    raise ValueError(f"{widget.label}: only its value can be changed")
                check_value(widget, message.updates["value"])
                # Those who hold it do not wait for this thread.
                with inputs:
                    await gui._handle_gui_updates(client_id, message)
        except Exception as error:
            _refuse(server, client_id, widget, error)

    connection.register_handler(_messages.GuiUpdateMessage, update)
    # viser's own callback comes first and registers what handles the cameras of the new page.
    connection.on_client_connect(_accept_checked_cameras)


def _accept_checked_cameras(page: Any) -> None:
    """Let the connection of a page handle only cameras that a page can have; others are ignored."""
    handlers = page._incoming_handlers[_messages.ViewerCameraMessage]

    def checked(handle: Any) -> Any:
        async def move(client_id: int, message: _messages.ViewerCameraMessage) -> None:
            try:
                check_camera(message)
            except ValueError as error:
                log.info("ignored a camera: %s", error)
                return
            done = handle(client_id, message)
            if inspect.isawaitable(done):
                await done

        return move

    handlers[:] = [checked(handle) for handle in handlers]


def check_camera(message: _messages.ViewerCameraMessage) -> None:
    """Refuse a camera that no page has: viser would compute with whatever its fields contain.

    Raises:
        ValueError: A field is not finite, of the wrong type or length, or too large, or the camera looks at itself.
    """
    position, target = (check_point(name, getattr(message, name)) for name in ("position", "look_at"))
    check_point("up_direction", message.up_direction)
    finite_vector("wxyz", message.wxyz, 4)
    if np.array_equal(position, target):
        raise ValueError("camera: has no direction")
    finite_vector("camera", (message.fov, message.near, message.far))
    for size in (message.image_height, message.image_width):
        number_in("image size", size, 1)


def check_value(widget: Any, value: Any) -> None:
    """Refuse a value that a control does not offer.

    Args:
        widget: viser's handle of the control.
        value: as the page sent it.

    Raises:
        ValueError: The value is none of the options, outside the range, not finite, or of the wrong type.
    """
    if isinstance(widget, (viser.GuiDropdownHandle, viser.GuiButtonGroupHandle)):
        one_of(widget.label, value, widget.options)
    elif isinstance(widget, viser.GuiSliderHandle):
        slack = ROUNDING * (widget.max - widget.min)
        number_in(widget.label, value, widget.min - slack, widget.max + slack)
    elif isinstance(widget, viser.GuiCheckboxHandle):
        if not isinstance(value, bool):
            raise ValueError(f"{widget.label}: must be true or false, got {shown(value)}")
    else:
        raise ValueError(f"{widget.label}: takes no value from the page")


def check_point(name: str, value: Any) -> np.ndarray:
    """A point or direction that the page sent, as an array (3,).

    Raises:
        ValueError: It is not three finite numbers, or too far away.
    """
    return np.array([number_in(name, part, -FARTHEST, FARTHEST) for part in finite_vector(name, value)])


def _refuse(server: viser.ViserServer, client_id: int, widget: Any, error: Exception) -> None:
    """Report a refused update to its page, and show the control's actual value there again."""
    expected = isinstance(error, ValueError)
    log.warning("refused an update of a control: %s", error, exc_info=None if expected else error)
    client = server.get_clients().get(client_id)
    if client is not None:
        client.add_notification("Not possible", str(error), color="red")
    if widget is not None:
        widget._queue_update("value", widget.value)
