"""Title and icon of the viewer's pages, in place of those of viser."""

import gzip
import re
from functools import lru_cache

from websockets.http11 import Response

ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E"
    "%3Crect x='4' y='20' width='11' height='9' fill='%23e07a3f'/%3E%3Crect x='17' y='20' width='11' height='9' "
    "fill='%233f7fbf'/%3E%3Crect x='10' y='10' width='11' height='9' fill='%23f2c14e'/%3E"
    "%3Crect x='15' y='1' width='9' height='8' fill='%234b9e86' transform='rotate(14 19 5)'/%3E%3C/svg%3E"
)


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


@lru_cache(maxsize=4)
def _replaced(body: bytes, zipped: bool) -> bytes:
    text = own_title((gzip.decompress(body) if zipped else body).decode())
    return gzip.compress(text.encode()) if zipped else text.encode()
