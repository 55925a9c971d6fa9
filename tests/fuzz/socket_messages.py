"""The viewer's socket: messages that no page sends, values that no control offers, and handshakes of others."""

import atexit
import contextlib
import functools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import websockets
from hypothesis import strategies as st

from tests import test_viewer_security as pages
from tests.fuzz.harness import Target
from warp_rigid.viewer.live import LiveViewer
from warp_rigid.viewer.session import Session

WIRE = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**63), 2**63 - 1),
        st.floats(allow_nan=True, allow_infinity=True),
        st.text(max_size=5),
        st.binary(max_size=5),
        st.sampled_from(["../attack.py", "/etc/passwd", "a.usda", -1, 0.0, 1e30]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=3)),
    max_leaves=6,
)
"""What msgpack carries."""

KINDS = (
    "GuiUpdateMessage",
    "GuiCommandTriggeredMessage",
    "ViewerCameraMessage",
    "SceneNodeClickMessage",
    "ScenePointerMessage",
    "TransformControlsUpdateMessage",
    "FileTransferStartUpload",
    "FileTransferPart",
    "ShareUrlRequest",
    "GuiCloseModalMessage",
    "what",
)
MESSAGE = st.one_of(
    st.tuples(st.just("update"), st.integers(0, 40), st.sampled_from(["value", "value", "options", "what"]), WIRE),
    st.tuples(
        st.just("message"),
        st.sampled_from(KINDS),
        st.dictionaries(
            st.sampled_from(["uuid", "updates", "name", "position", "wxyz", "ray_origin", "instance_index", "x"]),
            WIRE,
            max_size=4,
        ),
    ),
    st.tuples(st.just("camera"), st.sampled_from(sorted(pages.CAMERA)), WIRE),
    st.tuples(st.just("bytes"), st.binary(max_size=40)),
    st.tuples(st.just("value"), WIRE),
)
HEADER = st.text("abcdefghijklmnopqrstuvwxyz0123456789.:/-[]%@", max_size=20)
HANDSHAKE = st.tuples(
    st.one_of(st.just("/"), st.just(""), HEADER.map(lambda text: f"/{text}")),
    st.dictionaries(st.sampled_from(["Host", "Origin", "Cookie", "Sec-WebSocket-Protocol"]), HEADER, max_size=3),
)


@functools.cache
def served() -> pages.Served:
    """One viewer for all cases; it must outlive each of them."""
    made = pages.Served(LiveViewer(Session("seesaw", device="cpu"), port=8710))
    atexit.register(made.viewer.stop)
    return made


@functools.cache
def elsewhere() -> ThreadPoolExecutor:
    """The thread of the pages: what a page does is not what a case does to the system."""
    return ThreadPoolExecutor(1)


def encoded(message: tuple, widgets: list) -> bytes:
    kind, *rest = message
    if kind == "bytes":
        return rest[0]
    if kind == "value":
        return msgspec.msgpack.encode(rest[0])
    if kind == "camera":
        return msgspec.msgpack.encode(pages.CAMERA | {rest[0]: rest[1]})
    if kind == "message":
        return msgspec.msgpack.encode({"type": rest[0], **rest[1]})
    place, key, value = rest
    uuid = widgets[place % len(widgets)]._impl.uuid
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {key: value}})


def send_all(case: list) -> None:
    """Messages of one page, some of which end its connection; another page must find the viewer as it was."""
    viewer = served()
    scene = viewer.viewer.session.plan.demo.name
    widgets = list(viewer.viewer._panel._widgets.values())
    with contextlib.suppress(websockets.exceptions.ConnectionClosed), pages.open_page(viewer) as page:
        for message in case:
            page.send(encoded(message, widgets))
    pages.until(lambda: not viewer.viewer.server.get_clients())
    with pages.open_page(viewer) as page:
        pages.settle(viewer, page)
        viewer.alive()
    pages.until(lambda: not viewer.viewer.server.get_clients())
    assert viewer.viewer.session.plan.demo.name == scene, "the page loaded what no control offers"


def try_messages(case: list, folder: Path) -> None:
    elsewhere().submit(send_all, case).result(60.0)


def shake_hands(case: tuple[str, dict[str, str]]) -> None:
    viewer = served()
    path, headers = case
    status, _, text = viewer.get(path, **headers)
    assert status in (400, 403, 404, 421, 426) and viewer.path.strip("/") not in text
    viewer.done()


def try_handshake(case: Any, folder: Path) -> None:
    elsewhere().submit(shake_hands, case).result(60.0)


TARGETS = [
    Target("messages to the viewer", st.lists(MESSAGE, min_size=1, max_size=20), try_messages),
    Target("handshakes with the viewer", HANDSHAKE, try_handshake),
]
