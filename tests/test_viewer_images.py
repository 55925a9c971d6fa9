"""Images of bodies on the page: what is sent to it. tests/browser looks at the page itself."""

import io

import numpy as np
import pytest
import trimesh
from PIL import Image

import warp_rigid as wr
from tests.textured_scene import MAP, textured_scene
from tests.usd_tools import start_of
from warp_rigid.render.film import film_from_recording
from warp_rigid.scene.look import Look
from warp_rigid.viewer.instances import Instances, textured_mesh
from warp_rigid.viewer.page import opacity_of_walls, start_server, stop_server


def film_with_images(folder, size=(8, 4)):
    """Two bodies with an image, one without and a compound of which a part has texture coordinates; and the pixels."""
    scene, pixels = textured_scene(folder, size)
    return film_from_recording(start_of(scene)), pixels


def parts_of(content):
    """Meshes of a file, by trimesh."""
    return list(trimesh.load(io.BytesIO(content), file_type="glb", process=False).geometry.values())


def test_a_mesh_with_an_image_keeps_both(tmp_path):
    film, pixels = film_with_images(tmp_path)
    (part,) = parts_of(textured_mesh(film.meshes[0], film.images[0], np.array([9, 9, 9])))
    np.testing.assert_allclose(part.visual.uv, part.vertices @ MAP.T, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(part.visual.material.baseColorTexture.convert("RGB")), pixels)
    pictured, plain = parts_of(textured_mesh(film.meshes[1], film.images[0], np.array([9, 99, 199], np.uint8)))
    assert len(pictured.faces) == len(plain.faces) == 12 and pictured.visual.material.baseColorTexture is not None
    np.testing.assert_allclose(pictured.visual.uv, pictured.vertices @ MAP.T, atol=1e-6)
    assert plain.vertices[:, 2].min() > 1.5 and plain.visual.material.baseColorFactor.tolist() == [9, 99, 199, 255]


def test_large_images_are_reduced(tmp_path):
    film, _ = film_with_images(tmp_path, (3000, 30))
    (part,) = parts_of(textured_mesh(film.meshes[0], film.images[0], np.array([9, 9, 9])))
    assert part.visual.material.baseColorTexture.size == (1024, 10)


def test_walls_with_an_image_are_opaque(tmp_path):
    Image.new("RGB", (2, 2)).save(tmp_path / "image.png")
    wall = trimesh.creation.box((2, 0.02, 2))
    scene = wr.Scene()
    for place in range(2):
        scene.add_static(wr.Mesh(wall.vertices, wall.faces, 16, uv=wall.vertices[:, ::2]), position=(0, place, 1))
    scene.looks[1] = Look(image=tmp_path / "image.png")
    assert opacity_of_walls(film_from_recording(start_of(scene))).tolist() == [0.35, 1.0]


@pytest.fixture
def instances(tmp_path):
    server = start_server("127.0.0.1", 8700)
    film, _ = film_with_images(tmp_path)
    yield Instances(server, film, np.ones(4, bool)), film
    stop_server(server)


def shown(instances):
    """For each kind of drawing the bodies that it draws."""
    found = {"plain": [], "pictured": []}
    for handle, chosen in instances.handles:
        scales = handle.batched_scales
        drawn = np.full(len(chosen), handle.visible) & (True if scales is None else scales == 1.0)
        kind = "pictured" if hasattr(handle._impl.props, "glb_data") else "plain"
        found[kind] += chosen[drawn].tolist()
    return {kind: sorted(bodies) for kind, bodies in found.items()}


def test_opaque_bodies_of_their_own_colour_show_their_image(instances):
    made, film = instances
    images, rest = [0, 1, 3], [2]
    own = made._own
    assert shown(made) == {"pictured": images, "plain": rest}
    made.fade(np.array([1.0, 0.35, 1.0, 1.0]))
    assert shown(made) == {"pictured": [0, 3], "plain": [1, 2]}
    made.fade(np.ones(4))
    made.color(np.where(np.arange(4)[:, None] == 3, 7, own).astype(np.uint8))
    assert shown(made) == {"pictured": [0, 1], "plain": [2, 3]}
    made.color(own)
    made.wire(True)
    assert shown(made) == {"pictured": [], "plain": [0, 1, 2, 3]}
    made.wire(False)
    assert shown(made) == {"pictured": images, "plain": rest}


def test_what_is_hidden_is_not_moved_until_it_is_shown(instances):
    made, film = instances

    def heights():
        return {float(handle.batched_positions[0, 2]) for handle, _ in made.handles if handle.visible}

    assert sorted(handle.visible for handle, _ in made.handles) == [False, False, True, True, True]
    for step, on in enumerate((False, True, True, False), start=1):
        made.wire(on)
        assert heights() == {step - 1.0}
        made.pose(film.position[0] + (0, 0, step), film.orientation[0])
        assert heights() == {float(step)}
    assert {float(handle.batched_positions[0, 2]) for handle, _ in made.handles} == {3.0, 4.0}
