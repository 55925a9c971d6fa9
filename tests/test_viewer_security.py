"""What the viewer refuses: foreign connections, values that no control offers, messages that its page never sends."""

import contextlib
import http.client
import logging
import threading
import time
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import viser
import websockets
from websockets.sync.client import connect

import warp_rigid as wr
from warp_rigid.commands import cli
from warp_rigid.render.film import film_from_recording
from warp_rigid.viewer import live
from warp_rigid.viewer.live import LiveViewer
from warp_rigid.viewer.playback import FilmViewer
from warp_rigid.viewer.session import Session

PATIENCE = 30.0
ATTACK = "import pathlib\npathlib.Path(__file__).with_suffix('.executed').touch()\n"
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 0.0, 1.0),
    "fov": 0.7,
    "near": 0.1,
    "far": 100.0,
    "image_height": 300,
    "image_width": 400,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class Served:
    """A viewer that runs in a thread, and raw access to its port."""

    def __init__(self, viewer):
        self.viewer = viewer
        # The sockets of these tests draw nothing, so it is no use to wait for their first picture.
        live.LOADING_PATIENCE = 0.1
        self._thread = threading.Thread(target=viewer.run, daemon=True)
        self._thread.start()
        parts = urlsplit(viewer.server.url)
        self.netloc, self.host, self.port, self.path = parts.netloc, parts.hostname, parts.port, parts.path

    def close(self):
        self.viewer.stop()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive(), "the viewer did not stop"

    def socket(self, path=None, **options):
        """A WebSocket as the page opens it."""
        path = self.path.rstrip("/") if path is None else path
        protocol = f"viser-v{viser.__version__}"
        return connect(f"ws://{self.netloc}{path}", subprotocols=[protocol], max_size=None, **options)

    def get(self, path, **headers):
        """Status, headers and text of a page."""
        line = http.client.HTTPConnection(self.host, self.port, timeout=PATIENCE)
        line.request("GET", path, headers=headers)
        answer = line.getresponse()
        return answer.status, answer.headers, answer.read().decode("utf-8", "replace")

    def widget(self, name):
        return self.viewer._panel._widgets[name]

    def done(self):
        """Wait until the viewer has done all that was asked before."""
        finished = threading.Event()
        self.viewer.ask(finished.set)
        assert finished.wait(PATIENCE), "the viewer's loop has ended"

    def alive(self):
        """The loop runs, and the simulation advances while a page is open."""
        self.done()
        assert self._thread.is_alive()
        self.viewer.session.running = True
        before = self.viewer.session.time
        until(lambda: self.viewer.session.time > before)


def until(condition):
    end = time.perf_counter() + PATIENCE
    while not condition():
        assert time.perf_counter() < end
        time.sleep(0.02)


def send(page, **message):
    page.send(msgspec.msgpack.encode(message))


def update(page, widget, value, key="value"):
    send(page, type="GuiUpdateMessage", uuid=widget._impl.uuid, updates={key: value})


def drain(page):
    """Take what the server sends: otherwise the socket fills, and holds the server up."""
    with contextlib.suppress(websockets.exceptions.ConnectionClosed):
        for _ in page:
            pass


def open_page(served, **options):
    """A WebSocket that counts as an open page, and that the viewer no longer waits for: it logs that in a thread."""
    page = served.socket(**options)
    threading.Thread(target=drain, args=(page,), daemon=True).start()
    before = len(served.viewer.server.get_clients())
    page.send(msgspec.msgpack.encode(CAMERA))
    until(lambda: len(served.viewer.server.get_clients()) > before)
    if isinstance(served.viewer, LiveViewer):
        until(lambda: served.viewer._loaded.issuperset(served.viewer.server.get_clients()))
    return page


def settle(served, page):
    """Wait until the server has handled all that the page sent: it takes messages in their order."""
    rates = [f"{served.viewer.session.speed:g}", "0.5", "0.75"]
    wanted = next(float(rate) for rate in rates[1:] if rate != rates[0])
    update(page, served.widget("speed"), wanted)
    until(lambda: served.viewer.session.speed == wanted)
    served.done()


@pytest.fixture(scope="module")
def served():
    made = Served(LiveViewer(Session("seesaw", device="cpu"), port=8610))
    yield made
    made.close()


@pytest.fixture
def page(served):
    with open_page(served) as opened:
        yield opened
    until(lambda: not served.viewer.server.get_clients())


@pytest.fixture
def attack(tmp_path):
    """A scene file that leaves a trace when it is executed."""
    path = tmp_path / "attack.py"
    path.write_text(ATTACK)
    yield path
    assert not path.with_suffix(".executed").exists(), "a file that the page named was executed"


def refused(served, path=None, **options):
    """The status with which a handshake is refused."""
    with pytest.raises(websockets.exceptions.InvalidStatus) as found:
        served.socket(path, **options).close()
    return found.value.response.status_code


@pytest.mark.parametrize(
    "origin", ["http://attacker.example", "null", "http://127.0.0.1:1", "https://{netloc}", "http://localhost:{port}"]
)
def test_foreign_origin_is_refused(served, origin):
    origin = origin.format(netloc=served.netloc, port=served.port)
    assert refused(served, origin=origin) == 403
    assert served.get(served.path, Origin=origin)[0] == 403


@pytest.mark.parametrize("host", ["attacker.example", "attacker.example:{port}", "127.0.0.1:1", "127.0.0.1", ""])
def test_foreign_host_is_refused(served, host):
    host = host.format(port=served.port)
    status, _, text = served.get(served.path, Host=host)
    assert status == 403 and "is not an address of this viewer" in text
    assert served.path.strip("/") not in text
    assert refused(served, additional_headers={"Host": host}) == 403


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LOCALHOST", "[::1]"])
def test_every_name_of_the_loopback_address_is_accepted(served, name):
    netloc = f"{name}:{served.port}"
    status, _, text = served.get(served.path, Host=netloc)
    assert status == 200 and "<html" in text


@pytest.mark.parametrize("path", ["", "/", "/wrong", "/wrong/index.html", "/?token=", "/index.html", "/%"])
def test_missing_or_wrong_token_is_refused(served, path):
    assert refused(served, path or "/") == 403
    status, _, text = served.get(path or "/")
    assert status == 403 and "token" in text and "<html" not in text


def test_token_is_long_and_new_for_each_server_and_is_kept_from_other_sites(served):
    token = served.path.strip("/")
    assert len(token) >= 32
    assert served.viewer.server._guard.token == token
    status, headers, _ = served.get(f"/{token}")
    assert status == 200
    assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
    assert served.get(f"/{token[:-1]}/")[0] == 403
    assert served.get(f"/{token}/../{token}/")[0] == 404


def test_refused_connections_are_logged_once_each(served, caplog):
    with caplog.at_level(logging.WARNING, logger="warp_rigid"):
        for _ in range(3):
            served.get(served.path, Host="logged.example'")
    found = [record.getMessage() for record in caplog.records]
    assert len(found) == 1 and "logged.example'" in found[0]


def test_page_with_the_token_and_its_own_origin_controls_the_viewer(served):
    with open_page(served, origin=f"http://{served.netloc}") as page:
        settle(served, page)
        served.alive()


def test_scene_drop_down_takes_no_path(served, page, attack):
    update(page, served.widget("scene"), str(attack))
    settle(served, page)
    assert served.viewer.session.source == "seesaw"
    assert served.widget("scene").value == "seesaw"
    served.alive()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scene", 3),
        ("scene", ["seesaw"]),
        ("variant", "no such variant"),
        ("dt", "0.0"),
        ("dt", "nan"),
        ("dt", "7"),
        ("friction", -0.5),
        ("friction", float("nan")),
        ("friction", float("inf")),
        ("friction", "0.5"),
        ("friction", True),
        ("friction", None),
        ("collision_iterations", 2_000_000_000),
        ("gravity", 1e30),
        ("speed", 0.0),
        ("strength", float("-inf")),
        ("sleeping", "yes"),
        ("sleeping", 7),
        ("coloring", "no such colouring"),
        ("body", "999 nobody"),
        ("axis", "w"),
        ("shown_envs", 1e9),
    ],
)
def test_value_that_a_control_does_not_offer_changes_nothing(served, page, name, value):
    widget = served.widget(name)
    before, dt = widget.value, served.viewer.session.sim.settings.dt
    update(page, widget, value)
    settle(served, page)
    if name != "speed":
        assert widget.value == before
    assert served.viewer.session.speed > 0.0
    assert served.viewer.session.sim.settings.dt == dt
    served.alive()


@pytest.mark.parametrize("key", ["props", "update_cb", "removed", "uuid"])
def test_only_the_value_of_a_control_can_be_changed(served, page, key):
    widget = served.widget("friction")
    before = getattr(widget._impl, key)
    update(page, widget, "x", key)
    settle(served, page)
    assert getattr(widget._impl, key) is before
    served.alive()


def test_upload_cannot_set_a_control_and_no_tunnel_opens(served, page, monkeypatch):
    widget = served.widget("scene")
    before = widget.value
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_: pytest.fail("a tunnel was opened"))
    send(
        page,
        type="FileTransferStartUpload",
        source_component_uuid=widget._impl.uuid,
        transfer_uuid="1",
        filename="attack.py",
        mime_type="text/plain",
        part_count=0,
        size_bytes=0,
    )
    send(page, type="ShareUrlRequest")
    settle(served, page)
    assert widget.value == before
    served.alive()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        msgspec.msgpack.encode({"type": "NoSuchMessage"}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage"}),
        msgspec.msgpack.encode({**CAMERA, "fov": "wide"}),
        "text",
    ],
)
def test_message_that_cannot_be_read_ends_its_connection_only(served, page, caplog, data):
    with open_page(served) as broken:
        broken.send(data)
        until(lambda: len(served.viewer.server.get_clients()) == 1)
    served.alive()
    lines = [record for record in caplog.records if record.name == "websockets.server"]
    assert "Traceback" not in caplog.text and all("\n" not in record.getMessage() for record in lines)


def test_wrong_cameras_do_not_hinder_loading_a_scene(served, page):
    for wrong in ({"position": (float("nan"),) * 3}, {"position": (1.0,)}, {"wxyz": ()}, {"look_at": (3.0, 0.0, 1.0)}):
        page.send(msgspec.msgpack.encode({**CAMERA, **wrong}))
    settle(served, page)
    for name in ("incline", "seesaw"):
        update(page, served.widget("scene"), name)
        until(lambda name=name: served.viewer.session.source == name)
        served.done()
        served.alive()
        rows = len(served.viewer.rows) * served.viewer.session.sim.num_bodies
        assert len(served.viewer._film.mesh) == rows and served.widget("scene").value == name


@pytest.mark.parametrize(
    "wrong",
    [
        {"look_at": {"x": 1.0}},
        {"position": "abc"},
        {"up_direction": (0.0, 0.0)},
        {"wxyz": "abcd"},
        {"near": float("nan")},
        {"image_height": 0},
    ],
)
def test_camera_that_no_page_has_is_ignored_in_every_thread(served, page, monkeypatch, wrong):
    failed = []
    monkeypatch.setattr(threading, "excepthook", failed.append)
    with served.socket() as other:
        threading.Thread(target=drain, args=(other,), daemon=True).start()
        with contextlib.suppress(websockets.exceptions.ConnectionClosed):
            other.send(msgspec.msgpack.encode(CAMERA | wrong))
            other.send(msgspec.msgpack.encode(CAMERA | {"fov": 0.8} | wrong))
        settle(served, page)
        assert len(served.viewer.server.get_clients()) == 1  # a page counts as open from its first camera on
    assert failed == []


@pytest.mark.parametrize("updates", [{}, {"value": {}}, [], "value", None])
def test_malformed_update_is_ignored(served, page, updates):
    for uuid in ("no such control", 3, [], {}, None):
        send(page, type="GuiUpdateMessage", uuid=uuid, updates=updates)
    settle(served, page)


@pytest.mark.parametrize(
    ("index", "origin", "direction"),
    [
        (99999, (0, 0, 5), (0, 0, -1)),
        (-1, (0, 0, 5), (0, 0, -1)),
        (0, (0, 0, 5), (0, 0, 0)),
        (0, (0, 0, float("nan")), (0, 0, -1)),
        (0, (0, 0, 5), (1e300, 0, -1)),
        (0, (0, 0), (0, 0, -1)),
    ],
)
def test_click_with_a_bad_ray_or_body_changes_nothing(served, page, index, origin, direction):
    served.viewer.ask(served.viewer.restart)
    served.viewer.session.running = False
    served.done()
    before = served.viewer.session.sim.get("linear_velocity").copy()
    handle, _ = next(pair for pair in served.viewer._instances.handles if served.viewer._film.dynamic[pair[1]].any())
    send(
        page,
        type="SceneNodeClickMessage",
        name=handle._impl.name,
        instance_index=index,
        ray_origin=origin,
        ray_direction=direction,
        screen_pos=(0.5, 0.5),
        modifier=None,
    )
    settle(served, page)
    # The click is handled by a pool of threads, in no fixed order.
    time.sleep(0.2)
    served.done()
    assert np.array_equal(served.viewer.session.sim.get("linear_velocity"), before)
    assert (served.viewer.session.sim.status()["status"] == "ok").all()
    served.alive()


def test_exception_in_a_request_is_reported_and_the_viewer_lives_on(served, page, caplog, monkeypatch):
    told = []
    monkeypatch.setattr(viser.ClientHandle, "add_notification", lambda _, title, body, **__: told.append((title, body)))

    def fail():
        raise ZeroDivisionError("a mistake in a request")

    with caplog.at_level(logging.ERROR, logger="warp_rigid"):
        served.viewer.ask(fail)
        served.done()
    assert "a mistake in a request" in caplog.text and "Traceback" in caplog.text
    assert any("a mistake in a request" in body for _, body in told)
    served.alive()


@pytest.mark.parametrize("place", ["advance", "_publish"])
def test_exception_in_the_loop_pauses_the_simulation(served, page, caplog, monkeypatch, place):
    owner = served.viewer.session if place == "advance" else served.viewer

    def fail(*_):
        raise IndexError("a mistake in the loop")

    with monkeypatch.context() as patched, caplog.at_level(logging.ERROR, logger="warp_rigid"):
        patched.setattr(owner, place, fail)
        served.viewer.session.running = True
        until(lambda: not served.viewer.session.running and "a mistake in the loop" in caplog.text)
    served.alive()


def test_choice_that_no_longer_exists_is_refused(served, page):
    """A choice of the last scene's body may arrive after another scene was loaded."""
    chosen = served.viewer.chosen
    served.viewer.ask(served.viewer._panel._changed, "body", "57 gone")
    served.done()
    assert served.viewer.chosen == chosen
    served.alive()


def test_file_of_the_command_line_stays_on_offer(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(
        "import warp_rigid as wr\n\n"
        "def scene():\n    made = wr.Scene()\n    made.add_body(wr.Sphere(0.1), position=(0, 0, 1))\n    return made\n"
    )
    served = Served(LiveViewer(Session(str(path), device="cpu"), port=8630))
    try:
        with open_page(served) as page:
            update(page, served.widget("scene"), "seesaw")
            until(lambda: served.viewer.session.source == "seesaw")
            served.done()
            assert str(path) in served.widget("scene").options
            update(page, served.widget("scene"), str(path))
            until(lambda: served.viewer.session.source == str(path))
    finally:
        served.close()


@pytest.fixture(scope="module")
def film():
    scene = wr.Scene()
    scene.add_body(wr.Sphere(0.1), position=(0, 0, 1))
    return film_from_recording(wr.record(wr.Simulator(scene, device="cpu"), frames=10, fps=30))


def test_film_viewer_checks_connections_and_values_too(film):
    viewer = FilmViewer(film, port=8640)
    viewer.playing = False
    served = Served(viewer)
    try:
        assert refused(served, "/") == 403
        assert refused(served, origin="http://attacker.example") == 403
        with open_page(served) as page:
            for value in (1e9, float("nan"), "3"):
                update(page, viewer._scrubber, value)
            update(page, viewer._scrubber, 4)
            until(lambda: viewer.frame == 4)
            assert np.isfinite(viewer._at) and not viewer.playing
    finally:
        served.close()


def test_all_interfaces_need_the_token_and_an_own_address(film):
    served = Served(FilmViewer(film, host="0.0.0.0", port=8650))
    try:
        assert served.host == "127.0.0.1" and served.get(served.path)[0] == 200
        assert served.get("/")[0] == 403
        assert served.get(served.path, Host=f"attacker.example:{served.port}")[0] == 403
    finally:
        served.close()


@pytest.mark.parametrize("port", ["99999999", "65536", "0", "-1"])
def test_port_out_of_range_is_one_line_that_names_the_range(port, capfd):
    assert cli.main(["view", "seesaw", "--device", "cpu", "--port", port]) == 2
    told = capfd.readouterr()
    assert told.err == f"warp-rigid: port: must be in [1, 65535], got {port}\n" and told.out == ""


@pytest.mark.parametrize("host", ["no.such.host.invalid", "300.1.1.1", "192.0.2.1"])
def test_host_that_is_not_of_this_machine_is_one_line(host, capsys):
    assert cli.main(["view", "seesaw", "--device", "cpu", "--host", host]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and "host" in told[0] and host in told[0]


def test_host_beyond_this_machine_is_told(capsys, monkeypatch):
    monkeypatch.setattr(LiveViewer, "run", lambda viewer: viewer.server.stop())
    assert cli.main(["view", "seesaw", "--device", "cpu", "--port", "8660", "--host", "0.0.0.0"]) == 0
    told = capsys.readouterr().err
    assert "other machines" in told and "token" in told and "http://127.0.0.1:" in told
    assert cli.main(["view", "seesaw", "--device", "cpu", "--port", "8670"]) == 0
    assert "other machines" not in capsys.readouterr().err


def test_sliders_of_the_scene_restart_it_and_refuse_what_it_does_not_allow():
    served = Served(LiveViewer(Session("leaning_tower", device="cpu"), port=8690))
    try:
        with open_page(served) as page:
            sliders = served.viewer._panel._inputs
            assert {name: (slider.min, slider.max) for name, slider in sliders.items()} == {
                "height": (0, 30),
                "offset": (0, pytest.approx(0.45)),
            }
            update(page, sliders["height"], 4)
            until(lambda: sliders["height"].value == 4)
            served.viewer.ask(served.viewer._panel._restart_with_parameters)
            served.done()
            assert served.viewer.session.plan.parameters["height"] == 4
            assert len(served.viewer.session.plan.scene.bodies) == 6
            update(page, sliders["height"], 1)
            until(lambda: sliders["height"].value == 1)
            served.viewer.ask(served.viewer._panel._restart_with_parameters)
            served.alive()
            assert served.viewer.session.plan.parameters["height"] == 4, "2 boxes are the fewest"
    finally:
        served.close()
