"""Pages of other sites in a real browser: none of them reaches the viewer."""

import http.server
import threading
from urllib.parse import urlsplit

import pytest
import viser

from tests.browser.conftest import CHROMIUM, FLAGS

CONNECT = """
([address, protocol]) => new Promise(resolve => {
    const socket = new WebSocket(address, [protocol]);
    socket.onopen = () => resolve("connected");
    socket.onclose = event => resolve("closed " + event.code);
})
"""
READ = "address => fetch(address).then(answer => 'read ' + answer.status, () => 'blocked')"


class Blank(http.server.BaseHTTPRequestHandler):
    """A page of another site."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>another site</title>")

    def log_message(self, *_):
        pass


@pytest.fixture
def site():
    """Address of another site on this machine."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Blank)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://localhost:{server.server_port}/"
    server.shutdown()
    server.server_close()


def socket_addresses(url):
    """Of the viewer's WebSocket: as an attacker may guess it, and with the token."""
    parts = urlsplit(url)
    return [f"ws://{parts.netloc}", f"ws://{parts.netloc}{parts.path.rstrip('/')}"]


def attempts(page, live):
    """What a page reaches of a viewer."""
    protocol = f"viser-v{viser.__version__}"
    return [page.evaluate(CONNECT, [address, protocol]) for address in socket_addresses(live.viewer.server.url)]


def test_page_from_another_origin_cannot_connect(stage, page, site):
    live = stage("seesaw")
    page.goto(site)
    # 1006: the handshake was refused.
    assert attempts(page, live) == ["closed 1006", "closed 1006"]
    assert page.evaluate(READ, live.viewer.server.url) == "blocked"
    assert len(live.viewer.server.get_clients()) == 1


def test_viewers_own_page_connects_only_with_the_token(stage):
    live = stage("seesaw")
    assert attempts(live.page, live) == ["closed 1006", "connected"]


def test_page_without_the_token_is_not_served(stage, page):
    live = stage("seesaw")
    parts = urlsplit(live.viewer.server.url)
    for path in ("/", "/wrong-token/"):
        answer = page.goto(f"http://{parts.netloc}{path}")
        assert answer.status == 403 and "token" in page.inner_text("body")
    assert page.evaluate("document.cookie") == ""


def test_name_that_resolves_to_this_machine_is_refused(stage, browser):
    """DNS rebinding: the attacker's own name leads to the viewer, so the browser sees one origin."""
    live = stage("seesaw")
    parts = urlsplit(live.viewer.server.url)
    rule = "--host-resolver-rules=MAP attacker.example 127.0.0.1"
    rebound = browser.browser_type.launch(executable_path=CHROMIUM, args=[*FLAGS, rule])
    try:
        page = rebound.new_page()
        answer = page.goto(f"http://attacker.example:{parts.port}{parts.path or '/'}")
        assert answer.status == 403 and page.locator("canvas").count() == 0
        address = f"ws://attacker.example:{parts.port}{parts.path.rstrip('/')}"
        assert page.evaluate(CONNECT, [address, f"viser-v{viser.__version__}"]) == "closed 1006"
    finally:
        rebound.close()
