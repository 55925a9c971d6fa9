"""The viewer's server: viser's, with checks of every connection and every message from the page."""

import contextlib
import errno
import http
import logging
import socket
import threading

import viser
import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from warp_rigid.viewer.branding import with_own_title
from warp_rigid.viewer.controls import accept_checked_messages
from warp_rigid.viewer.guard import Guard

PORTS = range(1, 65536)
PORTS_TRIED = 1000
MOST_REPORTED = 20
"""Kinds of refused connections that are logged; a page that keeps trying must not fill the log."""
PRIVACY = {"Referrer-Policy": "no-referrer", "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
"""Headers of every answer: they keep the address, which contains the token, from other sites and from caches."""

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
        logging.getLogger("websockets.server").addFilter(one_line)
        with _STARTING, _every_request(_Checks(self._guard)) as checks:
            super().__init__(host=host, port=check_address(host, port), label="warp_rigid", verbose=False)
        if not checks.installed:
            self.stop()
            raise RuntimeError(f"viser {viser.__version__}: its connections cannot be checked; viser 1.1.1 works")
        self.inputs = threading.RLock()
        accept_checked_messages(self, self.inputs)

    @property
    def url(self) -> str:
        """Address of the page, with the token."""
        return self._guard.url(self.get_port())


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


class _Checks:
    """Puts a guard before the function that answers viser's requests."""

    def __init__(self, guard: Guard):
        self._guard = guard
        self._reported: set[str] = set()
        self.installed = False

    def before(self, answer):
        """The function that is called instead of `answer`."""

        def process_request(connection: ServerConnection, request: Request) -> Response | None:
            reason = self._guard.refusal(request, connection.local_address)
            if reason is not None:
                return self._refuse(connection, reason)
            response = answer(connection, self._guard.strip_token(request))
            if response is not None:
                response.headers.update(PRIVACY)
                response = with_own_title(response)
            return response

        self.installed = True
        return process_request

    def _refuse(self, connection: ServerConnection, reason: str) -> Response:
        if reason not in self._reported and len(self._reported) < MOST_REPORTED:
            self._reported.add(reason)
            log.warning("refused a connection from %s: %s", connection.remote_address[0], reason)
        text = f"{reason}.\nOpen the address that the viewer printed when it started.\n".encode()
        headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(text)), **PRIVACY})
        return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, text)


@contextlib.contextmanager
def _every_request(checks: _Checks):
    """Check the requests of a server that viser starts meanwhile: viser itself offers no hook for them."""
    original = websockets.asyncio.server.serve

    def serve(handler, *arguments, process_request=None, **options):
        if not handler.__module__.startswith("viser."):
            return original(handler, *arguments, process_request=process_request, **options)
        return original(handler, *arguments, process_request=checks.before(process_request), **options)

    websockets.asyncio.server.serve = serve
    try:
        yield checks
    finally:
        websockets.asyncio.server.serve = original
