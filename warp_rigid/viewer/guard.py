"""Which connections the viewer accepts: the headers Host and Origin and a secret token decide."""

import ipaddress
import secrets
import socket

from websockets.http11 import Request

LOOPBACK = ("localhost", "127.0.0.1", "::1")
WILDCARDS = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}
"""Addresses that stand for all interfaces, and the one under which this machine reaches them."""
TOKEN_BYTES = 24
MOST_QUOTED = 80
"""Characters of a header that a message repeats."""


class Guard:
    """Checks requests before the server answers them.

    The token is the first part of the path: the page derives the address of its WebSocket from its own address, so the
    token reaches every request. A cookie would also be sent to other servers on this machine, as cookies ignore ports.

    Args:
        host: the address that the server listens on.

    Attributes:
        token: secret part of the address; a new one for each guard.
    """

    def __init__(self, host: str):
        """Make a token, and collect the names under which the server may be addressed."""
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self._host = host
        self._names = {*LOOPBACK, host.lower()}
        if not is_loopback(host):
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}

    def url(self, port: int) -> str:
        """Address of the page, with the token."""
        host = WILDCARDS.get(self._host, self._host)
        return f"http://{_netloc(host, port)}/{self.token}/"

    def refusal(self, request: Request, local: tuple) -> str | None:
        """Why a request is refused; None if it is accepted.

        Args:
            request: a page's request, or the opening handshake of a WebSocket.
            local: address and port at which it arrived.
        """
        address, port = local[:2]
        names = {*self._names, address.partition("%")[0].lower()}
        served = {_netloc(name, port) for name in names} | ({_netloc(name) for name in names} if port == 80 else set())
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        # A page of another site whose name was made to resolve to this machine sends that name as Host.
        if len(hosts) != 1 or hosts[0].lower() not in served:
            return f"Host {_quote(hosts)} is not an address of this viewer"
        # Browsers send Origin with every WebSocket handshake; programs that are not browsers need not.
        if origins and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
            return f"Origin {_quote(origins)} is not the viewer's own page"
        first = request.path.partition("?")[0].removeprefix("/").partition("/")[0]
        if not secrets.compare_digest(first.encode("utf-8", "surrogateescape"), self.token.encode()):
            return "the address lacks the viewer's token"
        return None

    def strip_token(self, request: Request) -> Request:
        """The request as the server behind the guard expects it."""
        return Request("/" + request.path.removeprefix(f"/{self.token}").lstrip("/"), request.headers)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server that listens on an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _netloc(host: str, port: int | None = None) -> str:
    """Host and port as they are written in a URL."""
    name = f"[{host}]" if ":" in host else host
    return name if port is None else f"{name}:{port}"


def _quote(values: list[str]) -> str:
    """Headers as text that is safe to print."""
    return ascii(", ".join(values)[:MOST_QUOTED])
