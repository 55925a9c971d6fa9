"""What objects show in notebooks, and films of recordings as files and inline."""

import base64
import io
import re
import sys
from html.parser import HTMLParser

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

import warp_rigid as wr
from warp_rigid import notebook

HOSTILE = "<script>alert('&')</script>"


class Page(HTMLParser):
    """Elements, their attributes and the text of some HTML."""

    def __init__(self, shown):
        super().__init__()
        self.tags, self.words = [], []
        self.feed(shown._repr_html_())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(self.words)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


def content_of(attributes):
    """Media type and bytes of a data URI."""
    kind, data = re.fullmatch(r"data:([\w/]+);base64,(.*)", attributes["src"]).groups()
    return kind, base64.b64decode(data)


@pytest.fixture
def scene():
    made = wr.Scene()
    made.add_static(wr.Plane(), name="ground")
    box = made.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.5), name=HOSTILE)
    made.add_joint(wr.DistanceJoint(maximum=2.0), box, None)
    return made


@pytest.fixture
def recording(scene, device):
    sim = wr.Simulator(scene, num_envs=3, device=device)
    sim.set("linear_velocity", np.array([[[0, 0, 0]], [[0, 0, 1]], [[0, 0, 2]]], float), bodies=[HOSTILE])
    return wr.record(sim, frames=6, velocities=True)


@pytest.mark.parametrize("make", ["scene", "simulator", "recording", "result"])
def test_names_are_text_not_markup(make, scene, recording):
    if make == "result":
        shown = wr.SweepResult([{"run": 0, "status": "ok", HOSTILE: HOSTILE}], {"scene": HOSTILE})
    else:
        shown = {"scene": scene, "simulator": wr.Simulator(scene, device="cpu"), "recording": recording}[make]
    page = Page(shown)
    assert HOSTILE in page.text
    assert page.all("script") == []


def test_a_scene_shows_a_picture_of_itself(scene):
    page = Page(scene)
    (image,) = page.all("img")
    kind, data = content_of(image)
    picture = Image.open(io.BytesIO(data))
    assert (kind, picture.width) == ("image/png", notebook.PICTURE_WIDTH)
    # The first colour of dynamic bodies is orange, which nothing else in the scene is.
    pixels = np.asarray(picture).astype(int)
    assert (pixels[..., 0] - pixels[..., 2] > 80).mean() > 0.01
    assert "DistanceJoint" in page.text and "1 dynamic, 1 static" in page.text


def test_a_scene_is_drawn_as_its_simulator_with_its_camera_and_its_looks(scene, device):
    plain = Page(scene).all("img")
    scene.looks[1] = wr.Look((0.8, 0.1, 0.1))
    scene.camera = wr.Camera(position=(1, 1, 1), look_at=(0, 0, 0.5))
    assert Page(scene).all("img") == Page(wr.Simulator(scene, device=device)).all("img") != plain


def test_what_has_nothing_to_draw_or_too_much_has_no_picture(scene, monkeypatch):
    assert Page(wr.Scene()).all("img") == []
    monkeypatch.setattr(notebook, "MAX_TRIANGLES", 5)
    assert Page(scene).all("img") == []


def test_a_simulator_shows_its_state(scene):
    sim = wr.Simulator(scene, num_envs=3, settings=wr.Settings(dt=1 / 120, sleeping=True), device="cpu")
    sim.step(12)
    velocity = np.zeros((3, 1, 3))
    velocity[1] = 3e38
    sim.set("linear_velocity", velocity, bodies=[HOSTILE])
    sim.step(4)
    text = Page(sim).text
    assert "0.133333 s" in text and "cpu" in text and "sleeping True" in text and "1 non-finite" in text


def test_a_recording_shows_its_film_in_a_sandbox(recording):
    (frame,) = Page(recording).all("iframe")
    assert frame["sandbox"] == "allow-scripts"
    assert frame["srcdoc"].lstrip().lower().startswith("<!doctype html>")
    assert len(frame["srcdoc"]) < notebook.MAX_INLINE


def test_a_recording_shows_a_picture_where_there_can_be_no_page(recording, monkeypatch):
    monkeypatch.setattr(notebook, "MAX_INLINE", 1000)
    page = Page(recording)
    assert page.all("iframe") == [] and content_of(page.all("img")[0])[0] == "image/png"
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "viser", None)
    for module in [name for name in sys.modules if name.startswith("warp_rigid.viewer.p")]:
        monkeypatch.delitem(sys.modules, module)
    assert Page(recording).all("iframe") == []
    assert content_of(Page(recording.show()).all("img")[0])[0] == "image/gif"


def test_a_recording_without_environments_shows_its_summary(scene, device):
    empty = wr.record(wr.Simulator(scene, device=device), frames=1, envs=[])
    assert "2 frames" in repr(empty) and Page(empty).all("iframe") == []


def test_films_are_written_to_paths_and_shown_without(recording, tmp_path):
    assert recording.to_gif(tmp_path / "new" / "a.gif", width=48) is None
    ((_, image),) = [(tag, a) for tag, a in Page(recording.to_gif(width=48)).tags if tag == "img"]
    kind, data = content_of(image)
    assert kind == "image/gif" and data == (tmp_path / "new" / "a.gif").read_bytes()
    film = Image.open(io.BytesIO(data))
    assert (film.width, film.height) == (3 * 48, 27)  # a panel each

    recording.to_mp4(tmp_path / "a.mp4", width=64, envs=[2])
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert next(frames)["source_size"] == (64, 36)
    (video,) = Page(recording.to_mp4(width=64, envs=[2])).all("video")
    assert content_of(video)[0] == "video/mp4"

    assert recording.to_html(tmp_path / "a.html") is None
    assert (tmp_path / "a.html").read_text().lstrip().lower().startswith("<!doctype html>")
    assert "iframe" in recording.to_html().html and "iframe" in recording.show(envs=[1]).html


def test_the_environment_that_is_chosen_is_drawn(recording, tmp_path):
    """The box of environment 2 starts upwards, that of 0 downwards: their films differ."""
    from warp_rigid.viewer.film_files import selected

    for env in (0, 2):
        recording.to_gif(tmp_path / f"{env}.gif", envs=[env], width=64)
        selected(recording, [env]).to_gif(tmp_path / "same.gif", width=64)
        assert (tmp_path / f"{env}.gif").read_bytes() == (tmp_path / "same.gif").read_bytes()
        np.testing.assert_array_equal(selected(recording, [env]).position[:, 0], recording.position[:, env])
    assert (tmp_path / "0.gif").read_bytes() != (tmp_path / "2.gif").read_bytes()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r, at: r.to_gif(at / "a.png"), "path: must end in .gif, got"),
        (lambda r, at: r.to_html(at / "a.gif"), "path: must end in .html, got"),
        (lambda r, at: r.to_gif(envs=[7]), "envs: [7] were not recorded; recorded: [0, 1, 2]"),
        (lambda r, at: r.to_gif(color="weight"), "color: must be one of"),
        (lambda r, at: r.to_gif(width=0), "width: must be"),
        (lambda r, at: r.to_mp4(height=1.5), "height: must be"),
    ],
)
def test_wrong_arguments_are_named(call, message, recording, tmp_path):
    with pytest.raises(ValueError) as error:
        call(recording, tmp_path)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("suffix", "module", "extra"),
    [("gif", "PIL", "picture"), ("mp4", "imageio_ffmpeg", "picture"), ("html", "viser", "viewer")],
)
def test_a_missing_package_is_one_line_that_names_the_extra(suffix, module, extra, recording, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ModuleNotFoundError) as error:
        getattr(recording, f"to_{suffix}")()
    assert str(error.value) == f"{module} is not installed; install it with: pip install 'warp-rigid[{extra}]'"


def test_the_film_of_many_environments_has_those_that_fit(recording, monkeypatch):
    page = Page(recording)
    assert page.all("iframe") and "film environments" not in page.text
    monkeypatch.setattr(notebook, "MAX_ENVS", 2)
    page = Page(recording)
    assert page.all("iframe") and "film environments 0, 1" in page.text


def test_a_film_too_large_for_a_notebook_is_refused(recording, monkeypatch):
    monkeypatch.setattr(notebook, "MAX_INLINE", 1000)
    with pytest.raises(ValueError, match="to_gif: the film has .* give a path"):
        recording.to_gif(width=48)


def test_the_command_line_writes_the_same_film(tmp_path, monkeypatch):
    """One pipeline: bytes of a GIF of the same run."""
    from warp_rigid.commands import cli
    from warp_rigid.runs import runner

    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "linkages", "--frames", "3", "--device", "cpu", "--film", "a.gif", "--envs", "1"]) == 0
    plan = runner.plan_run(runner.find_scene("linkages"), (), frames=3, device="cpu", num_envs=1)
    runner.execute(plan, None).recording.to_gif("b.gif")
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_a_result_shows_units_and_says_what_it_leaves_out():
    result = wr.sweep("incline", {"friction": np.linspace(0.1, 0.9, 12)}, duration=0.02, device="cpu")
    page = Page(result)
    assert len(page.all("tr")) == 1 + notebook.MAX_ROWS
    assert "drift [m]" in page.text and "2 more rows" in page.text


def test_a_plot_is_a_figure_that_is_shown_once(tmp_path):
    from matplotlib import pyplot as plt

    result = wr.sweep("incline", {"friction": [0.1, 0.5, 0.9]}, duration=0.1, device="cpu")
    before = plt.get_fignums()
    figure = result.plot(x="friction", y="drift")
    assert plt.get_fignums() == before  # pyplot would show it a second time
    shown = Image.open(io.BytesIO(figure._repr_png_()))
    written = result.plot(tmp_path / "a.png", x="friction", y="drift")
    assert Image.open(tmp_path / "a.png").size == shown.size
    np.testing.assert_array_equal(written.axes[0].lines[0].get_ydata(), figure.axes[0].lines[0].get_ydata())
