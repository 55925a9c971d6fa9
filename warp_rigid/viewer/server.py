"""The viewer's server: viser's, with checks of every connection and every message from the page."""

import contextlib
import errno
import functools
import gzip
import http
import logging
import re
import socket
import threading

import viser
import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from warp_rigid.viewer.controls import accept_checked_messages
from warp_rigid.viewer.guard import Guard

PORTS = range(1, 65536)
PORTS_TRIED = 1000
MOST_REPORTED = 20
"""Kinds of refused connections that are logged; a page that keeps trying must not fill the log."""
PRIVACY = {"Referrer-Policy": "no-referrer", "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
"""Headers of every answer: they keep the address, which contains the token, from other sites and from caches."""
ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E"
    "%3Crect x='4' y='20' width='11' height='9' fill='%23e07a3f'/%3E%3Crect x='17' y='20' width='11' height='9' "
    "fill='%233f7fbf'/%3E%3Crect x='10' y='10' width='11' height='9' fill='%23f2c14e'/%3E"
    "%3Crect x='15' y='1' width='9' height='8' fill='%234b9e86' transform='rotate(14 19 5)'/%3E%3C/svg%3E"
)
"""Icon of the pages, in place of that of viser."""

_STARTING = threading.Lock()

log = logging.getLogger(__name__)


class CheckedServer(viser.ViserServer):
    """A viser server that accepts only its own page.

    Args:
        host: address to listen on.
        port: the first to try.

    Attributes:
        inputs: lock, held while a control takes a value from the page and while its callbacks that are coroutines run.

    Raises:
        ValueError: No port from `port` on is free, or the host is not an address of this machine.
        RuntimeError: The installed viser starts in a way that cannot be checked.
    """

    def __init__(self, host: str, port: int):
        """Start to listen."""
        self._guard = Guard(host)
        self._reported: set[str] = set()
        self._is_checked = False
        logging.getLogger("websockets.server").addFilter(one_line)
        with _STARTING, self._checked_requests():
            super().__init__(host=host, port=check_address(host, port), label="warp_rigid", verbose=False)
        if not self._is_checked:
            self.stop()
            raise RuntimeError(f"viser {viser.__version__}: its connections cannot be checked; viser 1.1.1 works")
        self.inputs = threading.RLock()
        accept_checked_messages(self, self.inputs)

    @property
    def url(self) -> str:
        """Address of the page, with the token."""
        return self._guard.url(self.get_port())

    @contextlib.contextmanager
    def _checked_requests(self):
        """Check the requests of the server that viser starts meanwhile: viser itself offers no hook for them."""
        original = websockets.asyncio.server.serve

        def serve(handler, *arguments, process_request=None, **options):
            if handler.__module__.startswith("viser."):
                self._is_checked = True
                process_request = functools.partial(self._answered, process_request)
            return original(handler, *arguments, process_request=process_request, **options)

        websockets.asyncio.server.serve = serve
        try:
            yield
        finally:
            websockets.asyncio.server.serve = original

    def _answered(self, answer, connection: ServerConnection, request: Request) -> Response | None:
        """The answer of a function of viser's to a request, if the guard accepts it."""
        reason = self._guard.refusal(request, connection.local_address)
        if reason is not None:
            return self._refuse(connection, reason)
        response = answer(connection, self._guard.strip_token(request))
        if response is not None:
            response.headers.update(PRIVACY)
            response = with_own_title(response)
        return response

    def _refuse(self, connection: ServerConnection, reason: str) -> Response:
        if reason not in self._reported and len(self._reported) < MOST_REPORTED:
            self._reported.add(reason)
            log.warning("refused a connection from %s: %s", connection.remote_address[0], reason)
        text = f"{reason}.\nOpen the address that the viewer printed when it started.\n".encode()
        headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(text)), **PRIVACY})
        return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, text)


def own_title(page: str) -> str:
    """The text of one of viser's pages with another title and icon."""
    page = page.replace("<title>Viser</title>", "<title>warp_rigid</title>", 1)
    return re.sub(r'(rel="icon"\s+href=")[^"]*', lambda found: found[1] + ICON, page, count=1)


def with_own_title(response: Response) -> Response:
    """A response of viser's server; if it is the page, with another title and icon."""
    if "text/html" not in response.headers.get("Content-Type", "") or not response.body:
        return response
    body = _replaced(bytes(response.body), response.headers.get("Content-Encoding") == "gzip")
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(body))
    return Response(response.status_code, response.reason_phrase, response.headers, body)


@functools.lru_cache(maxsize=4)
def _replaced(body: bytes, zipped: bool) -> bytes:
    text = own_title((gzip.decompress(body) if zipped else body).decode())
    return gzip.compress(text.encode()) if zipped else text.encode()


def one_line(record: logging.LogRecord) -> bool:
    """Log filter: the error that ended a connection as one line, without a traceback."""
    if record.exc_info and record.exc_info[1] is not None:
        error = record.exc_info[1]
        reason = " ".join(str(error).split())[:200]
        record.msg, record.args = "closed a connection: %s: %s", (type(error).__name__, reason)
        record.levelno, record.levelname, record.exc_info = logging.WARNING, "WARNING", None
    return True


def check_address(host: str, port: int) -> int:
    """The first free port of an address.

    Args:
        host: address to listen on.
        port: the first to try.

    Raises:
        ValueError: No port from `port` on is free, or the host is not an address of this machine.
    """
    if port not in PORTS:
        raise ValueError(f"port: must be in [{PORTS[0]}, {PORTS[-1]}], got {port}")
    try:
        kinds = {(family, address[0]) for family, _, _, _, address in socket.getaddrinfo(host, port)}
    except (OSError, UnicodeError) as error:
        raise ValueError(f"host: {host} is not an address of this machine: {error}") from None
    last = min(port + PORTS_TRIED, len(PORTS) + 1)
    for candidate in range(port, last):
        if all(_is_free(family, address, candidate) for family, address in kinds):
            return candidate
    raise ValueError(f"port: none of {port} to {last - 1} is free on {host}")


def _is_free(family: int, address: str, port: int) -> bool:
    try:
        with socket.create_server((address, port), family=family):
            return True
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            return False
        raise ValueError(f"host: cannot listen on {address}: {error.strerror}") from None
