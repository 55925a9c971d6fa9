"""Films written while the simulation runs, films in several files, contacts, colours and velocities."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warp_rigid as wr
from tests.fakes import FakeSimulator
from warp_rigid.engine.step_reports import CONTACT_RECORD
from warp_rigid.runs.recording import Recorder
from warp_rigid.usd.check import check_usd
from warp_rigid.usd.writer import FLUSH_EVERY

ROOT = Path(__file__).resolve().parents[1]
FRAMES = 60


class Touching(FakeSimulator):
    """Two contacts in every environment but the second; none in every fifth frame; bodies have velocities."""

    def contacts(self):
        count = 0 if self.steps % 20 == 0 else 2
        records = np.zeros(3 * count, CONTACT_RECORD)
        records["env"] = np.repeat([0, 0, 2], count)
        records["position"] = np.arange(len(records))[:, None] + [0.0, 0.5, 0.25]
        records["impulse"] = (0.0, 0.0, 1.0 + self.steps)
        return records

    def linear_velocity(self):
        speed = np.zeros((self.num_envs, self.num_bodies, 3), dtype=np.float32)
        speed[:, 1:] = (0.0, 0.0, -self.GRAVITY * self.time)
        return speed

    def angular_velocity(self):
        spin = np.zeros((self.num_envs, self.num_bodies, 3), dtype=np.float32)
        spin[:, 1:, 1] = self.SPIN * (1.0 + np.arange(self.num_envs))[:, None]
        return spin


def simulator():
    scene = wr.Scene()
    scene.add_static(wr.Plane(normal=(0.3, 0, 1)), name="ground")
    scene.add_body(wr.Box((0.1, 0.2, 0.3)), position=(1.0, 0.0, 2.0), name="brick")
    scene.add_body(wr.Compound([(wr.Sphere(0.2), (0.5, 0, 0), (0, 0, 0, 1))]), position=(0, 1.0, 3.0), name="ball")
    return Touching(scene, num_envs=3)


@pytest.fixture(scope="module")
def recording():
    sim = simulator()
    recorder = Recorder(sim, 60.0, velocities=True, contacts=True)
    recorder.capture(sim)
    for _ in range(FRAMES):
        sim.step(4)
        recorder.capture(sim)
    return recorder.recording()


def world_poses(path, frame):
    """Matrices of all bodies in the world, by environment and name."""
    stage = Usd.Stage.Open(str(path))
    places, found = UsdGeom.XformCache(frame), {}
    for env in stage.GetDefaultPrim().GetChildren():
        if not env.IsA(UsdGeom.Xform):
            continue
        for prim in env.GetChildren():
            if prim.IsA(UsdGeom.PointInstancer):
                outer = places.GetLocalToWorldTransform(prim)
                instancer = UsdGeom.PointInstancer(prim)
                for body, matrix in zip(
                    instancer.GetIdsAttr().Get(), instancer.ComputeInstanceTransformsAtTime(frame, frame), strict=True
                ):
                    found[env.GetName(), body] = np.array(matrix * outer)
            elif prim.HasAttribute("xformOp:orient"):
                found[env.GetName(), len([key for key in found if key[0] == env.GetName()])] = np.array(
                    places.GetLocalToWorldTransform(prim)
                )
    return found


@pytest.mark.parametrize("profile", ["animation", "scene"])
@pytest.mark.parametrize("layout", ["single", "payloads", "clips"])
def test_all_ways_of_writing_give_the_same_film(recording, profile, layout, tmp_path):
    options = {"profile": profile, "layout": layout}
    wr.export_usd(recording, tmp_path / "all.usdc", profile=profile)
    wr.export_usd(recording, tmp_path / "film.usdc", **options)
    sim = simulator()
    with wr.UsdStream(sim, tmp_path / "live.usdc", fps=60.0, **options) as stream:
        for _ in range(FRAMES):
            sim.step(4)
            stream.capture(sim)
    for name in ("film.usdc", "live.usdc"):
        assert check_usd(tmp_path / name) == []
        assert Usd.Stage.Open(str(tmp_path / name)).GetEndTimeCode() == FRAMES
        for frame in (0, 1, FLUSH_EVERY - 1, FLUSH_EVERY, FLUSH_EVERY + 1, 2 * FLUSH_EVERY, FRAMES - 0.5, FRAMES):
            expected, found = world_poses(tmp_path / "all.usdc", frame), world_poses(tmp_path / name, frame)
            assert len(found) == 9 and found.keys() == expected.keys()
            for key, matrix in expected.items():
                np.testing.assert_allclose(found[key], matrix, atol=1e-6)


def test_interpolation_crosses_the_border_of_two_clips(recording, tmp_path):
    for layout in ("single", "clips"):
        wr.export_usd(recording, tmp_path / f"{layout}.usdc", profile="scene", layout=layout)
    assert len(list((tmp_path / "clips_parts").glob("clip_*.usdc"))) == 3
    for frame in (FLUSH_EVERY - 0.7, FLUSH_EVERY + 0.3, FLUSH_EVERY + 1.2):
        one, other = (world_poses(tmp_path / f"{layout}.usdc", frame) for layout in ("single", "clips"))
        for key in one:
            np.testing.assert_allclose(one[key], other[key], atol=1e-6)


def test_clips_have_the_extent_of_the_drawn_ground(tmp_path):
    """Bodies far from the middle make it wider; the clips had that of the narrower one."""
    scene = wr.Scene()
    scene.add_static(wr.Plane(), name="ground")
    scene.add_body(wr.Sphere(0.5), position=(8.0, 0.0, 0.5), name="ball")
    film = wr.record(wr.Simulator(scene), frames=FLUSH_EVERY + 2, progress=False)
    wr.export_usd(film, tmp_path / "film.usdc", profile="animation", layout="clips")
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))
    extent = stage.GetPrimAtPath("/World/env_0000/ground").GetAttribute("extent")
    for frame in (0, 1, FLUSH_EVERY, FLUSH_EVERY + 2):
        assert np.ptp(extent.Get(frame), axis=0)[0] > 30.0


def test_payloads_can_stay_closed(recording, tmp_path):
    wr.export_usd(recording, tmp_path / "film.usdc", layout="payloads", envs=[0, 2])
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"), Usd.Stage.LoadNone)
    envs = [prim for prim in stage.GetDefaultPrim().GetChildren() if prim.IsA(UsdGeom.Xform)]
    look = ("Looks", "Sun", "Sky", "Camera")
    loaded = [
        prim for prim in stage.Traverse() if not str(prim.GetPath()).startswith(tuple(f"/World/{n}" for n in look))
    ]
    assert len(loaded) <= 1 + len(envs) and {p.GetName() for p in envs} <= {"env_0000", "env_0002"}
    alone = Usd.Stage.Open(str(tmp_path / "film_parts" / "env_0002.usdc"))
    assert alone.GetDefaultPrim().GetName() == "env_0002" and alone.GetEndTimeCode() == FRAMES


KILLED = """
import os, sys
import warp_rigid as wr
from tests.test_usd_stream import LEFT, simulator
sim = simulator()
films = [
    wr.UsdStream(sim, os.path.join(sys.argv[1], name), fps=60.0, profile=profile, layout=layout)
    for name, profile, layout in LEFT
]
for _ in range({frames}):
    sim.step(4)
    for film in films:
        film.capture(sim)
os._exit(9)
"""

LEFT = [
    ("animation.usdc", "animation", "single"),
    ("scene.usdc", "scene", "single"),
    ("scene.usda", "scene", "single"),
    ("clips.usdc", "animation", "clips"),
]


@pytest.fixture(scope="module")
def left(tmp_path_factory):
    """The folder of a program that died while it wrote films."""
    folder = tmp_path_factory.mktemp("left")
    code = KILLED.format(frames=FLUSH_EVERY + 10)
    assert subprocess.run([sys.executable, "-c", code, str(folder)], cwd=ROOT).returncode == 9
    return folder


@pytest.mark.long
@pytest.mark.parametrize(("name", "profile", "layout"), LEFT)
def test_a_program_that_dies_leaves_its_frames(recording, left, name, profile, layout, tmp_path):
    path = left / name
    stage = Usd.Stage.Open(str(path))
    assert stage.GetEndTimeCode() == FLUSH_EVERY
    wr.export_usd(recording, tmp_path / "all.usdc", profile=profile)
    for frame in (0, 11, FLUSH_EVERY):
        whole, rest = world_poses(tmp_path / "all.usdc", frame), world_poses(path, frame)
        for key, matrix in whole.items():
            # Only the places of the environments depend on frames to come.
            np.testing.assert_allclose(rest[key][:3, :3], matrix[:3, :3], atol=1e-6)
            assert rest[key][3, 2] == pytest.approx(matrix[3, 2], abs=1e-6)


def test_a_body_at_rest_costs_nothing_and_stays_where_it_is(tmp_path):
    """It falls, rests for a while, and falls on: two values hold the rest."""

    class Pausing(FakeSimulator):
        @property
        def time(self):
            return min(self.steps, 40) / 240.0 + max(self.steps - 120, 0) / 240.0

    scene = wr.Scene()
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 5), name="box")
    recording = wr.record(Pausing(scene), 50)
    assert (recording.position[11:31] == recording.position[10]).all()
    wr.export_usd(recording, tmp_path / "film.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))
    place = stage.GetAttributeAtPath("/World/env_0000/box.xformOp:translate")
    times = place.GetTimeSamples()
    assert not set(times) & set(range(11, 30)) and {10, 30, 31} <= set(times)
    for frame in range(51):
        assert np.float32(place.Get(frame)[2]) == recording.position[frame, 0, 0, 2]
    assert place.Get(20.5) == place.Get(10)


def test_size_of_an_animation(tmp_path):
    """28 bytes a body and frame for its pose, and next to nothing beside it."""
    scene = wr.Scene()
    for i in range(1000):
        scene.add_body(wr.Sphere(0.1), position=(i, 0, 0))
    recording = wr.record(FakeSimulator(scene), 48)
    wr.export_usd(recording, tmp_path / "film.usdc", profile="animation")
    assert os.path.getsize(tmp_path / "film.usdc") < 1.15 * 28 * 1000 * 49


def test_contacts_are_points_and_impulses_lines(recording, tmp_path):
    path = tmp_path / "film.usdc"
    wr.export_usd(recording, path, contacts=True)
    assert check_usd(path) == []
    stage = Usd.Stage.Open(str(path))
    for row, env in enumerate(("env_0000", "env_0001", "env_0002")):
        points = UsdGeom.Points(stage.GetPrimAtPath(f"/World/{env}/contacts"))
        lines = UsdGeom.BasisCurves(stage.GetPrimAtPath(f"/World/{env}/impulses"))
        for frame in (0, 4, 5, 6, FRAMES - 1):
            records = recording.contacts[frame][recording.contacts[frame]["env"] == row]
            np.testing.assert_array_equal(
                np.array(points.GetPointsAttr().Get(frame)).reshape(-1, 3), records["position"]
            )
            assert list(lines.GetCurveVertexCountsAttr().Get(frame)) == [2] * len(records)
            ends = np.array(lines.GetPointsAttr().Get(frame)).reshape(-1, 2, 3)
            drawn = ends[:, 1] - ends[:, 0]
            if len(records):
                scale = drawn[:, 2] / records["impulse"][:, 2]
                np.testing.assert_allclose(scale, scale[0], rtol=1e-4)
                assert scale[0] > 0.0 and (np.abs(drawn[:, :2]) < 1e-5).all()


@pytest.mark.parametrize("profile", ["animation", "scene"])
@pytest.mark.parametrize("color", ["body", "environment", "level", "speed", "asleep"])
def test_colors_tell_what_they_are_asked_to(recording, profile, color, tmp_path):
    wr.export_usd(recording, tmp_path / "film.usdc", profile=profile, color=color)
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))

    def brick(env, frame):
        primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(f"/World/env_000{env}/brick"))
        return tuple(primvars.GetPrimvar("displayColor").Get(frame)[0])

    changes_over_time = color in ("level", "speed", "asleep")
    assert (brick(0, 1) != brick(0, 40)) == changes_over_time
    assert (brick(0, 1) != brick(1, 1)) == (color == "environment")
    if color == "speed":
        # From the first colour of the ramp to its last one at 2 m/s, which a fall of 0.204 s reaches.
        assert brick(0, 0) != brick(0, 6) != brick(0, 12) and brick(0, 13) == brick(0, FRAMES)
    if color == "asleep":
        assert brick(0, 2) != brick(0, 3) == brick(0, 30)


def test_velocities_are_those_of_the_instances_origins(recording, tmp_path):
    """Where poses move on as the velocities say, the next frame is met to second order."""
    wr.export_usd(recording, tmp_path / "film.usdc", profile="animation", velocities=True)
    stage = Usd.Stage.Open(str(tmp_path / "film.usdc"))
    ball = UsdGeom.PointInstancer(stage.GetPrimAtPath("/World/env_0001/ball"))
    speed = np.array(ball.GetVelocitiesAttr().Get(30))[0]
    spin = np.array(ball.GetAngularVelocitiesAttr().Get(30))[0]
    np.testing.assert_allclose(spin, (0, np.degrees(FakeSimulator.SPIN * 2.0), 0), rtol=1e-5)
    turn = recording.orientation[30, 1, 2].astype(float)
    half_angle = np.arctan2(turn[1], turn[3])
    arm = 0.5 * np.array([np.cos(2 * half_angle), 0.0, -np.sin(2 * half_angle)])
    center_speed = np.array([0, 0, -FakeSimulator.GRAVITY * 0.5])
    np.testing.assert_allclose(speed, center_speed - np.cross([0, FakeSimulator.SPIN * 2.0, 0], arm), atol=1e-4)


def test_options_are_checked_before_anything_is_written(recording, tmp_path):
    bare = wr.record(FakeSimulator(simulator().scene), 1)
    for options, message in (
        ({"profile": "film"}, "profile: must be one of auto, animation, scene"),
        ({"color": "mood"}, "color: must be one of body"),
        ({"layout": "pile"}, "layout: must be one of single"),
        ({"contacts": True}, "contacts: requires recorded contacts"),
        ({"color": "speed"}, "color: requires recorded velocities"),
        ({"velocities": True}, "velocities: requires recorded velocities"),
        ({"velocities": True, "profile": "scene"}, "velocities: requires profile animation"),
    ):
        with pytest.raises(ValueError, match=message):
            wr.export_usd(bare, tmp_path / "film.usdc", **options)
    with pytest.raises(ValueError, match="layout: must be single for .usdz"):
        wr.export_usd(recording, tmp_path / "film.usdz", layout="clips")
    assert list(tmp_path.iterdir()) == []
