"""Rewinding, spawning and titles of the viewer, without a browser."""

import gzip

import numpy as np
import pytest
import viser
from websockets import Headers
from websockets.http11 import Response

from warp_rigid.engine.simulator import Simulator
from warp_rigid.render.film import film_from_recording
from warp_rigid.runs.recording import record
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Plane, Sphere
from warp_rigid.viewer.history import LENGTH, RATE, History
from warp_rigid.viewer.page import ground_heights, keep_above_ground, look_from
from warp_rigid.viewer.server import own_title, with_own_title
from warp_rigid.viewer.session import Session


@pytest.fixture
def session():
    return Session("box_stack", device="cpu", assignments=["height=2"])


def test_a_session_continues_from_an_earlier_moment(session):
    history = History()
    for _ in range(60):
        session.step(8)
        history.add(session.time, session.sim)
    assert len(history.moments) == 60 and history.length == pytest.approx(59 / 30)
    moment = history.at(1.0)
    assert moment.time == pytest.approx(1.0, abs=0.5 / RATE)
    session.show(moment)
    np.testing.assert_array_equal(session.sim.get("position"), moment.state["position"])
    assert session.time == pytest.approx(moment.time)
    history.forget_after(moment.time)
    assert history.at(0.0) is moment
    session.step(2)
    assert session.time == pytest.approx(moment.time + 2 * session.sim.settings.dt)


def test_rewinding_keeps_the_full_turns_of_hinges(tmp_path):
    (tmp_path / "wheel.py").write_text(
        "import warp_rigid as wr\n\n\ndef scene():\n    made = wr.Scene(gravity=(0, 0, 0))\n"
        "    made.add_body(wr.Sphere(0.1), angular_velocity=(0, 0, 20.0))\n"
        "    made.add_joint(wr.RevoluteJoint((0, 0, 1)), 0)\n    return made\n"
    )
    session, history = Session(str(tmp_path / "wheel.py"), device="cpu"), History()
    session.step(240)
    history.add(session.time, session.sim)
    angle = session.sim.get("joint_position")
    session.step(240)
    last = session.sim.get("joint_position")
    session.show(history.at(0.0))
    np.testing.assert_allclose(session.sim.get("joint_position"), angle, rtol=1e-6)
    session.step(240)
    np.testing.assert_allclose(session.sim.get("joint_position"), last, rtol=1e-6)


def test_only_the_last_seconds_are_kept(session):
    history = History()
    for step in range(int(40 * RATE)):
        history.add(step / RATE, session.sim)
        history.add(step / RATE + 0.1 / RATE, session.sim)
    assert LENGTH - 2.0 / RATE < history.length <= LENGTH
    assert len(history.moments) == pytest.approx(LENGTH * RATE, abs=1)


def test_a_body_is_added_and_the_others_go_on(session):
    session.step(24)
    session.change("friction", 0.3)
    before = {name: session.sim.get(name) for name in ("position", "linear_velocity", "friction")}
    time = session.time
    place = before["position"].max(axis=1) + [0, 0, 2.0]
    body = session.spawn(Sphere(0.1), place)
    for name, values in before.items():
        np.testing.assert_array_equal(session.sim.get(name)[:, :body], values)
    np.testing.assert_allclose(session.sim.get("position")[:, body], place, rtol=1e-6)
    assert session.time == pytest.approx(time) and session.plan.scene.bodies[body].name == f"added_{body}"
    session.step(24)
    assert (session.sim.get("position")[:, body, 2] < place[:, 2]).all()
    session.restart()
    np.testing.assert_allclose(session.sim.get("position")[:, body], place, rtol=1e-6)


@pytest.mark.parametrize("zipped", [False, True])
def test_pages_have_their_own_title_and_icon(zipped):
    page = '<link\n      rel="icon"\n      href="data:theirs"\n    /><title>Viser</title>'
    body = gzip.compress(page.encode()) if zipped else page.encode()
    encoding = "gzip" if zipped else "identity"
    headers = Headers({"Content-Type": "text/html", "Content-Length": str(len(body)), "Content-Encoding": encoding})
    made = with_own_title(Response(200, "OK", headers, body))
    text = (gzip.decompress(made.body) if zipped else made.body).decode()
    assert "<title>warp_rigid</title>" in text and "theirs" not in text and "data:image/svg" in text
    assert made.headers["Content-Length"] == str(len(made.body)) and len(made.headers.get_all("Content-Length")) == 1
    assert "<title>warp_rigid</title>" in own_title(page)
    other = Response(200, "OK", Headers({"Content-Type": "text/css"}), b"<title>Viser</title>")
    assert with_own_title(other) is other


def test_the_page_of_the_installed_viser_has_the_title_that_is_replaced():
    page = viser.__path__[0] + "/client/build/index.html"
    with open(page) as file:
        assert "<title>Viser</title>" in file.read()


class View:
    """Takes what is set of a camera."""

    position, look_at = np.array([5.0, 0.0, -3.0]), np.zeros(3)


class Page:
    camera = View()


def test_the_camera_stays_above_the_ground():
    scene = Scene()
    scene.add_static(Plane((0, 0, 1), 0.5))
    scene.add_body(Sphere(0.5), position=(0, 0, 3))
    film = film_from_recording(record(Simulator(scene, device="cpu"), 0))
    assert ground_heights(film) == [0.5]
    page = Page()
    keep_above_ground(page, ground_heights(film))
    assert page.camera.position[2] > 0.5 and tuple(page.camera.position[:2]) == (5.0, 0.0)
    look_from(page.camera, film, 600, 400)
    wide = np.linalg.norm(np.array(page.camera.position) - page.camera.look_at)
    look_from(page.camera, film, 300, 400)
    assert np.linalg.norm(np.array(page.camera.position) - page.camera.look_at) > wide
