"""What is recorded is what the simulator had, and it survives the disk."""

import numpy as np
import pytest

from tests.fakes import FakeSimulator
from warp_rigid import Box, Plane, Scene, Sphere, export_usd
from warp_rigid.engine.step_reports import CONTACT_RECORD
from warp_rigid.runs.recording import CAPTURED, VELOCITIES, Recorder, Recording, record
from warp_rigid.viewer.film_files import selected


@pytest.fixture
def scene():
    scene = Scene()
    scene.add_static(Plane(), name="ground")
    scene.add_body(Box((0.1, 0.2, 0.3)), position=(1.0, 2.0, 30.0), name="brick")
    scene.add_body(Sphere(0.1), position=(0.0, 0.0, 20.0), name="ball")
    scene.add_body(Box((0.1, 0.2, 0.3)), position=(-1.0, 0.0, 25.0), name="brick")
    return scene


def test_frames_are_the_simulators_states_at_their_times(scene):
    sim = FakeSimulator(scene, num_envs=3)
    searched = []
    recording = record(sim, frames=30, fps=60.0, on_frame=lambda i, s: searched.append((i, s.steps)))
    assert recording.num_frames == 30
    assert searched == [(i, 4 * i) for i in range(31)]
    time = np.arange(31) / 60.0
    np.testing.assert_allclose(recording.time, time, rtol=0, atol=1e-12)
    height = 30.0 - 0.5 * sim.GRAVITY * time**2
    np.testing.assert_allclose(recording.position[:, 2, 1, 2], height, rtol=1e-6)
    assert (recording.position[:, :, 1, :2] == [1.0, 2.0]).all()
    half = 0.5 * sim.SPIN * 2.0 * time
    np.testing.assert_allclose(np.abs(recording.orientation[:, 1, 2, 3]), np.abs(np.cos(half)), atol=1e-6)
    assert recording.position.dtype == recording.orientation.dtype == np.float32
    assert recording.level[7].tolist() == [[28] * 4] * 3
    assert recording.asleep[:, 0, 0].tolist() == [4 * i > 10 for i in range(31)]


def test_equal_shapes_share_a_surface(scene):
    recording = record(FakeSimulator(scene), frames=0)
    assert recording.surface.tolist() == [0, 1, 2, 1]
    assert [surface.endless for surface in recording.surfaces] == [True, False, False]
    np.testing.assert_allclose(np.ptp(recording.surfaces[1].vertices, axis=0), [0.2, 0.4, 0.6])


def test_some_environments_only(scene):
    whole = record(FakeSimulator(scene, num_envs=4), frames=5)
    some = record(FakeSimulator(scene, num_envs=4), frames=5, envs=[3, 1])
    assert some.envs.tolist() == [3, 1]
    assert (some.position == whole.position[:, [3, 1]]).all()
    assert (some.orientation == whole.orientation[:, [3, 1]]).all()
    assert some.rows([1]).tolist() == [1]
    with pytest.raises(ValueError, match=r"envs: \[0\] were not recorded"):
        some.rows([0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": -1}, "frames: must be a whole number from 0"),
        ({"frames": 2.5}, "frames: must be a whole number from 0"),
        ({"frames": 1, "fps": 0.0}, "fps: must be a finite number > 0"),
        ({"frames": 1, "fps": 100.0}, "nearest valid rate: 120"),
        ({"frames": 1, "fps": 1000.0}, "nearest valid rate: 240"),
        ({"frames": 1, "envs": [2]}, "envs: must be indices from 0 to 1"),
        ({"frames": 1, "envs": [0.7]}, "envs: must be indices from 0 to 1"),
        ({"frames": 1, "envs": [0, 0]}, "envs: must be given once each"),
    ],
)
def test_bad_arguments_are_named(scene, arguments, message):
    with pytest.raises(ValueError, match=message):
        record(FakeSimulator(scene, num_envs=2), **arguments)


def test_a_scene_is_neither_recorded_nor_exported_without_a_simulator(scene, tmp_path):
    """Both were an AttributeError."""
    with pytest.raises(ValueError, match="^sim: must be a Simulator, got Scene"):
        record(scene, frames=1)
    with pytest.raises(ValueError, match="^recording: must be a Recording, as record"):
        export_usd(scene, tmp_path / "scene.usda")


def test_labels_belong_to_environments(scene):
    sim = FakeSimulator(scene, num_envs=2)
    assert Recorder(sim, 60, envs=[False, True]).envs.tolist() == [1]
    assert Recorder(sim, 60, envs=[1], labels=["b"]).labels == ("b",)
    with pytest.raises(ValueError, match="labels: must be 2, one per environment, got 1"):
        Recorder(sim, 60, labels=["a"])


def test_disk_keeps_every_bit(scene, tmp_path):
    sim = FakeSimulator(scene, num_envs=2)
    recorder = Recorder(sim, 60.0, labels=["off", "on"])
    for _ in range(4):
        recorder.capture(sim)
        sim.step(4)
    before = recorder.recording()
    path = tmp_path / "new" / "run.npz"
    before.save(path)
    after = Recording.load(path)
    for name in ("time", "position", "orientation", "asleep", "level", "envs", "motion", "surface"):
        one, other = getattr(before, name), getattr(after, name)
        assert one.dtype == other.dtype and one.tobytes() == other.tobytes(), name
    assert (after.fps, after.labels, after.names) == (60.0, ("off", "on"), before.names)
    for one, other in zip(before.surfaces, after.surfaces, strict=True):
        assert one.vertices.tobytes() == other.vertices.tobytes()
        assert one.faces.tobytes() == other.faces.tobytes()
        assert one.endless == other.endless


def test_a_selection_keeps_the_times_of_its_environments(scene):
    """As of moving ground after some environments were reset: those of environment 0 were taken."""

    class Reset(FakeSimulator):
        @property
        def times(self):
            return self.time + np.arange(self.num_envs)

    whole = record(Reset(scene, num_envs=3), frames=2)
    np.testing.assert_array_equal(selected(whole, [2]).times, whole.times[:, [2]])


class Touching(FakeSimulator):
    """Moves as it falls, and has as many contacts as it has made frames, none at the start."""

    def contacts(self):
        records = np.zeros(self.steps // 4, CONTACT_RECORD)
        for name in CONTACT_RECORD.names:
            shape = records[name].shape
            records[name] = np.arange(np.prod(shape), dtype=int).reshape(shape) + self.steps
        records["env"] = 0
        return records

    def linear_velocity(self):
        return self.position() * np.float32(1.5)

    def angular_velocity(self):
        return self.position() * np.float32(2.5)


def bits(recording):
    return [getattr(recording, name).tobytes() for name in (*CAPTURED, *VELOCITIES, "time")] + [
        (records.dtype, records.tobytes()) for records in recording.contacts
    ]


def test_disk_keeps_velocities_and_contacts(scene, tmp_path):
    before = record(Touching(scene, num_envs=2), 3, velocities=True, contacts=True)
    before.save(tmp_path / "run.npz")
    after = Recording.load(tmp_path / "run.npz")
    assert [len(records) for records in after.contacts] == [0, 1, 2, 3]
    assert after.contacts[3]["position"].tolist() == [[12, 13, 14], [15, 16, 17], [18, 19, 20]]
    assert bits(after) == bits(before)
    record(Touching(scene), 3).save(tmp_path / "run.npz")
    bare = Recording.load(tmp_path / "run.npz")
    assert bare.contacts is None and bare.linear_velocity is None and bare.angular_velocity is None


def test_recorder_goes_on_with_velocities_and_contacts(scene):
    whole = record(Touching(scene), 4, velocities=True, contacts=True)
    sim = Touching(scene)
    first, second = (Recorder(sim, 60.0, velocities=True, contacts=True) for _ in range(2))
    for _ in range(2):
        first.capture(sim)
        sim.step(4)
    second.restore(first.arrays())
    for _ in range(3):
        second.capture(sim)
        sim.step(4)
    assert bits(second.recording()) == bits(whole)
    without = Recorder(sim, 60.0)
    without.capture(sim)
    with pytest.raises(ValueError, match="contact_count is missing"):
        second.restore(without.arrays())


@pytest.mark.parametrize("counts", [[0, 1, 2, 4], [0, -1, 2, 5], [0, 1, 2], [2**62, 2**62, 2**62, 2**62 + 6]])
def test_contacts_that_do_not_add_up_are_refused(scene, tmp_path, counts):
    record(Touching(scene), 3, contacts=True).save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as file:
        arrays = dict(file)
    arrays["contact_count"] = np.array(counts, np.int64)
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(ValueError, match="not a recording.*contact_count"):
        Recording.load(tmp_path / "run.npz")


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x03\x04 broken"])
def test_foreign_file_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "run.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"run.npz: not a recording") as error:
        Recording.load(path)
    assert "\n" not in str(error.value)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        Recording.load(tmp_path / "none.npz")
