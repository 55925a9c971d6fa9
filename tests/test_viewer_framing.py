"""What the pages of the viewer show at first, what a ray hits, and what overlays do to bodies; without a page."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.render.film import film_from_recording
from warp_rigid.viewer.live import LiveViewer
from warp_rigid.viewer.overlays import CONTACTS
from warp_rigid.viewer.page import follow_with_pages, keep_framed, look_from, look_from_page, widen_views
from warp_rigid.viewer.picking import first_hit
from warp_rigid.viewer.session import Session


def on_page(view, point, width, height):
    """Where a point is on a page, from -1 to 1, right and up."""
    away = np.subtract(view.look_at, view.position)
    forward = away / np.linalg.norm(away)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    to = np.subtract(point, view.position)
    tall = np.tan(0.5 * view.fov) * (to @ forward)
    return np.array([to @ right / (tall * width / height), to @ np.cross(right, forward) / tall])


def tower(camera=None, frames=0):
    scene = wr.Scene(camera=camera)
    scene.add_static(wr.Plane())
    scene.add_static(wr.Box((5, 5, 0.1)), position=(0, 0, 0.1), name="slab")
    for i in range(4):
        scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.3 + 0.2 * i))
    return wr.record(wr.Simulator(scene, device="cpu"), frames=frames)


@pytest.mark.parametrize(("width", "height"), [(1280, 900), (360, 420), (1600, 300), (480, 700)])
@pytest.mark.parametrize("frames", [0, 3])
def test_bodies_fill_the_part_of_the_page_that_the_panel_leaves(width, height, frames):
    """A slab of 10 m changes nothing. The panel covers the lower three fifths of a narrow page."""
    recording, view = tower(frames=frames), SimpleNamespace()
    look_from(view, film_from_recording(recording), width, height)
    at = np.array([on_page(view, place, width, height) for place in recording.position[0, 0, 2:]])
    assert np.abs(at[:, 0]).max() < 1.0 and at[:, 1].max() < 1.0
    lowest = 0.2 if (width, height) == (480, 700) else -1.0
    assert at[:, 1].min() > lowest
    # The middles of the lowest and the highest box are three quarters of the tower apart.
    part = 0.5 * np.ptp(at[:, 1]) / (0.4 if lowest > 0 else 1.0)
    assert part > 0.3 or np.ptp(at[:, 1]) * height / width > 0.3


def test_a_page_shows_a_kinematic_body_that_does_not_move_yet():
    """A gate at the end of a belt, which is apart from the parcels; a film shows it once it moves."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for i in range(5):
        scene.add_body(wr.Box((0.08, 0.08, 0.08)), position=(-1.3 + 0.3 * i, 0, 0.08))
    path = wr.PosePath([0, 2, 2.5], [(1, 0, 0.16), (1, 0, 0.16), (1, 0, 0.6)])
    scene.add_kinematic(wr.Box((0.02, 0.25, 0.15)), path=path)
    view, far = SimpleNamespace(), wr.Box((0.02, 0.25, 0.15))
    film = film_from_recording(wr.record(wr.Simulator(scene, device="cpu"), frames=0))
    look_from(view, film, 1280, 900)
    assert np.abs(on_page(view, (1, 0, 0.16), 1280, 900)).max() < 1.0
    scene.add_kinematic(far, position=(30, 0, 0.16))
    beside = SimpleNamespace()
    look_from(beside, film_from_recording(wr.record(wr.Simulator(scene, device="cpu"), frames=0)), 1280, 900)
    assert np.allclose(beside.position, view.position)


def test_the_page_shows_the_camera_of_the_scene():
    view = SimpleNamespace()
    look_from(view, film_from_recording(tower(wr.Camera((3, -1, 2), (0, 0, 0.5), 50.0))), 1000, 800)
    assert np.allclose(view.position, (3, -1, 2)) and np.allclose(view.look_at, (0, 0, 0.5))
    assert view.fov == pytest.approx(np.radians(50.0))


class FakeCamera(SimpleNamespace):
    """A camera of an open page, which reports its size as viser does."""

    def on_update(self, function):
        self.report = lambda width, height: (
            setattr(self, "image_width", width),
            setattr(self, "image_height", height),
            function(None),
        )


class FakeClient:
    """An open page."""

    def __init__(self, **values):
        self.camera = FakeCamera(**values)


def test_views_are_widened_when_bodies_leave_them_unless_the_user_has_moved_the_camera():
    film = film_from_recording(tower())
    client = FakeClient(image_width=800, image_height=600)
    server = SimpleNamespace(get_clients=lambda: {0: client})
    look_from_page(client, film)
    camera = client.camera
    camera.position, camera.look_at = np.array(camera.position), np.array(camera.look_at)
    first = camera.position.copy()
    widen_views(server, film)
    assert np.array_equal(camera.position, first)
    fallen = film.position.copy()
    fallen[:, 5] += np.float32((2.0, 0.0, 0.0))
    widen_views(server, replace(film, position=fallen))
    assert not np.array_equal(camera.position, first)
    assert np.abs(on_page(camera, fallen[0, 5], 800, 600)).max() < 1.0
    camera.position, camera.look_at = first + (0.5, 0.0, 0.0), np.array((0.0, 0.0, 0.5))
    widen_views(server, replace(film, position=fallen))
    assert np.array_equal(camera.position, first + (0.5, 0.0, 0.0))


def test_a_page_that_the_panel_narrows_is_framed_again():
    film = film_from_recording(tower())
    client = FakeClient(image_width=1100, image_height=600)
    camera = client.camera
    keep_framed(client, lambda: film)
    wide = camera.position
    camera.report(300, 600)
    narrow, expected = camera.position, SimpleNamespace()
    look_from(expected, film, 300, 600)
    assert narrow == expected.position != wide
    camera.position = (1.0, 2.0, 3.0)
    camera.report(300, 600)
    assert camera.position == (1.0, 2.0, 3.0)


def test_pages_follow_a_body_and_keep_how_they_look_at_it():
    recording = tower(wr.Camera.follow(5, distance=2.0))
    film = film_from_recording(recording)
    moved = replace(film, position=film.position + np.float32((0.5, -1.0, 0.25)))
    camera = SimpleNamespace(position=np.array((0.0, -3.0, 2.0)), look_at=np.array((0.0, 0.0, 1.0)))
    server = SimpleNamespace(get_clients=lambda: {0: SimpleNamespace(camera=camera)})
    follow_with_pages(server, moved, 0)
    assert np.allclose(camera.look_at, np.add((0, 0, 0.9), (0.5, -1.0, 0.25)), atol=1e-6)
    assert np.allclose(camera.position - camera.look_at, (0, -3, 1))


def test_a_ray_hits_the_nearest_body_that_is_chosen():
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    for shape, position in (
        (wr.Sphere(0.5), (3.0, 0, 1.0)),
        (wr.Box((0.5, 0.5, 0.5)), (1.0, 0, 1.0)),
        (wr.Box((0.1, 5.0, 0.1)), (-1.0, 3.0, 1.0)),
    ):
        scene.add_static(shape, position=position)
    film = film_from_recording(wr.record(wr.Simulator(scene, device="cpu"), frames=0))
    body, point = first_hit(film, np.arange(4), np.array((-5.0, 0, 1.2)), np.array((2.0, 0, 0)))
    # The bounding sphere of the long box is met first, the box itself is not.
    assert body == 2 and np.allclose(point, (0.5, 0, 1.2), atol=2e-3)
    assert first_hit(film, np.arange(1, 4), np.array((-5.0, 0, 5.0)), np.array((0, 0, -1.0))) is None


@pytest.fixture
def viewer():
    made = LiveViewer(Session("seesaw", device="cpu"), port=8790, fast=True)
    yield made
    made.stop()
    made.run()


def test_what_the_page_picks_without_an_index_is_what_the_ray_hits(viewer):
    """The page reports no index where it picks the outline of another body in front of the pivot."""
    bodies = viewer.session.plan.scene.bodies
    pivot = next(i for i, body in enumerate(bodies) if body.name == "pivot")
    middle = np.asarray(bodies[pivot].position) + (0.0, 0.0, 0.1)
    eye, chosen = middle + (0.0, -4.0, 0.2), np.array([len(bodies) - 1])
    with pytest.raises(ValueError, match="^pivot: is static"):
        viewer._drag("start", chosen, None, eye, (np.nan,) * 3, middle)
    viewer._push(chosen, None, eye, middle - eye)
    assert "pivot" in viewer._panel._said.content and viewer.chosen == (0, pivot)
    assert viewer.session.pull_ends is None
    with pytest.raises(ValueError, match="^body: there is none"):
        viewer._drag("start", chosen, None, eye, (np.nan,) * 3, eye + (0, 0, 1.0))


def test_a_body_that_is_switched_off_is_not_picked(viewer):
    """It is not drawn, and lies between the eye and the pivot."""
    bodies, sim = viewer.session.plan.scene.bodies, viewer.session.sim
    pivot, large = (next(i for i, body in enumerate(bodies) if body.name == name) for name in ("pivot", "large"))
    middle = np.asarray(bodies[pivot].position) + (0.0, 0.0, 0.1)
    eye = middle + (0.0, -4.0, 0.2)
    sim.set("position", 0.5 * (eye + middle), bodies=[large])
    for active, hit in ((False, pivot), (True, large)):
        sim.set("active", active, bodies=[large])
        viewer._push(np.array([0]), None, eye, middle - eye)
        assert viewer.chosen == (0, hit)


def test_a_drag_without_an_index_pulls_the_body_under_the_pointer(viewer):
    bodies = viewer.session.plan.scene.bodies
    large = next(i for i, body in enumerate(bodies) if body.name == "large")
    middle = viewer.session.sim.get("position")[0, large].astype(float)
    eye, nowhere = middle + (0.0, -4.0, 0.5), (np.nan,) * 3
    viewer._drag("start", np.array([0]), None, eye, nowhere, middle)
    viewer._drag("update", np.array([0]), None, eye, nowhere, middle + (0, 0, 0.3))
    env, _, target = viewer.session.pull_ends
    assert viewer.session._pull.body == large and env == 0 and np.allclose(target, middle + (0, 0, 0.3))
    viewer._drag("end", np.array([0]), None, eye, nowhere, middle)
    assert viewer.session.pull_ends is None


def test_contacts_leave_bodies_solid(viewer):
    """Only moving bodies with contacts are seen through, a little; fixed ones and others stay as they were."""
    viewer.session.step(40)
    plain = viewer._opacity()
    viewer.overlay(CONTACTS, True)
    shown = viewer._opacity()
    contacts = viewer.session.sim.contacts()
    touching = np.union1d(contacts["body_a"], contacts["body_b"])
    dynamic = [i for i, body in enumerate(viewer.session.plan.scene.bodies) if body.motion == wr.Motion.DYNAMIC]
    assert len(touching)
    for body in range(len(plain)):
        faded = body in touching and body in dynamic
        assert shown[body] < plain[body] if faded else shown[body] == plain[body]
    assert shown[dynamic].min() > 0.6


def test_the_viewer_hides_bodies_that_are_switched_off(viewer):
    """Also in the past seconds, as a film and when the session goes on from there."""
    sim, last = viewer.session.sim, len(viewer.session.plan.scene.bodies) - 1

    def opacity():
        viewer._publish()
        return {i: viewer._instances._opacity[i] for i in range(len(viewer._film.mesh))}[last]

    viewer.history.add(0.0, sim)
    sim.set("active", False, bodies=[last])
    viewer.history.add(1.0, sim)
    assert opacity() == 0.0
    assert viewer.film().present[:, last].tolist() == [True, False]
    viewer._past = viewer.history.moments[0]
    assert opacity() == 1.0
    viewer.session.show(viewer._past)
    assert sim.get("active")[0, last]
