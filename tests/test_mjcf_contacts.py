"""MJCF files whose contacts differ from those of USD: the friction of a pair, masks, and gravity compensation."""

import itertools
import shutil

import numpy as np
import pytest

import warp_rigid as wr
from warp_rigid.usd.robots import search_path


@pytest.fixture
def imported(tmp_path):
    """Function(text of the worldbody, text before it) -> the scene of an MJCF file."""
    if shutil.which("mujoco_usd_converter", path=search_path()) is None:
        pytest.skip("the converters of robots' files are not installed")

    def read(bodies, head="", **options):
        path = tmp_path / "file.xml"
        path.write_text(f"<mujoco>{head}<worldbody>{bodies}</worldbody></mujoco>")
        with pytest.warns(UserWarning, match="left out"):
            return wr.import_robot(path, **options)

    return read


def box(name, x, z, more=""):
    return f'<body name="{name}" pos="{x} 0 {z}"><freejoint/><geom type="box" size="0.2 0.2 0.1" {more}/></body>'


@pytest.mark.parametrize(("ground", "block"), [(1.0, 0.2), (0.2, 1.0), (0.4, 0.4)])
def test_a_pair_has_the_larger_friction(imported, ground, block):
    """A block at 2 m/s stops after v^2 / (2 mu g), less v dt / 2, as each step uses the speed at its end."""
    scene = imported(
        f'<geom type="plane" size="9 9 .1" friction="{ground}"/>' + box("block", 0, 0.1, f'friction="{block}"')
    )
    sim = wr.Simulator(scene, device="cpu")
    sim.set("linear_velocity", (2.0, 0.0, 0.0), bodies=["block"])
    sim.step(240 * 2)
    assert sim.get("position")[0, 1, 0] == pytest.approx(
        2.0**2 / (2.0 * max(ground, block) * 9.81) - 1.0 / 240.0, rel=2e-3
    )


@pytest.mark.parametrize("condim", [None, 1, 3, 4, 6])
def test_condim_decides_which_friction_acts(imported, condim):
    """A block that slides, a ball that spins and one that rolls, against Coulomb's laws of their friction."""
    slide, spin, roll = 0.3, 0.002, 0.004
    more = f'friction="{slide} {spin} {roll}"' + (f' condim="{condim}"' if condim else "")
    ball = '<body name="{}" pos="{} 0 0.1"><freejoint/><geom type="sphere" size="0.1" {}/></body>'
    balls = ball.format("spinning", 2, more) + ball.format("rolling", 4, more)
    sim = wr.Simulator(
        imported(f'<geom type="plane" size="9 9 .1" {more}/>' + box("block", 0, 0.1, more) + balls), device="cpu"
    )
    sim.set("linear_velocity", (0, 2.0, 0), bodies=["block", "rolling"])
    sim.set("angular_velocity", [(0, 0, 30.0), (-20.0, 0, 0)], bodies=["spinning", "rolling"])
    sim.step(120)
    speed = sim.get("linear_velocity")[0, :, 1]
    acts = [(condim or 3) >= least for least in (3, 4, 6)]
    assert speed[1] == pytest.approx(2.0 - acts[0] * 0.5 * slide * 9.81, abs=2e-3)
    assert sim.get("angular_velocity")[0, 2, 2] == pytest.approx(30.0 - acts[1] * 0.5 * spin * 9.81 / 0.004, abs=0.02)
    assert speed[3] == pytest.approx(2.0 - acts[2] * 0.5 * 5.0 / 7.0 * roll * 9.81 / 0.1, abs=2e-3)


def touching(scene):
    """Names of the pairs of movable bodies that are not kept apart."""
    names = [body.name for body in scene.bodies]
    pairs = itertools.combinations(range(len(names)), 2)
    return {frozenset((names[a], names[b])) for a, b in pairs if (a, b) not in scene.filtered_pairs}


def test_masks_decide_which_bodies_touch(imported):
    """Contype of one and conaffinity of the other have a common bit, either way round; each pair of 3-bit masks."""
    generator = np.random.default_rng(7)
    masks = {f"b{k}": generator.integers(0, 8, 2).tolist() for k in range(14)}
    masks = {name: mask for name, mask in masks.items() if any(mask)}  # others have no collider
    text = "".join(
        box(name, k, 1, f'contype="{mask[0]}" conaffinity="{mask[1]}"') for k, (name, mask) in enumerate(masks.items())
    )
    expected = {
        frozenset((a, b))
        for a, b in itertools.combinations(masks, 2)
        if masks[a][0] & masks[b][1] or masks[b][0] & masks[a][1]
    }
    found = touching(imported(text))
    assert found == expected and 10 < len(expected) < len(masks) * (len(masks) - 1) // 2


def test_masks_of_classes_and_of_included_files(imported, tmp_path):
    head = '<default><default class="ghost"><geom contype="0" conaffinity="2"/></default></default>'
    (tmp_path / "more.xml").write_text(
        f"<mujoco>{box('solid', 2, 1, 'contype=' + repr('2'))}</mujoco>".replace("'", '"')
    )
    text = box("a", 0, 1, 'class="ghost"') + box("b", 1, 1) + '<include file="more.xml"/>'
    found = touching(imported(text, head))
    assert found == {frozenset(("a", "solid")), frozenset(("b", "solid"))}


def test_a_body_falls_through_one_that_its_masks_exclude(imported):
    """Both rest on the plane in the end, one inside the other."""
    scene = imported(
        '<geom type="plane" size="5 5 0.1" contype="3" conaffinity="3"/>'
        + box("low", 0, 0.1, 'contype="1" conaffinity="1"')
        + box("top", 0, 0.6, 'contype="2" conaffinity="2"')
    )
    sim = wr.Simulator(scene, device="cpu")
    sim.step(240)
    np.testing.assert_allclose(sim.get("position")[0, 1:, 2], 0.1, atol=1e-3)


def test_a_converter_without_mujoco_is_told(imported, monkeypatch):
    monkeypatch.setattr("warp_rigid.usd.robots.MUJOCO_READER", "import no_such_module")
    scene = imported(box("a", 0, 1, 'contype="2"') + box("b", 1, 1))
    (told,) = [finding.reason for finding in scene.import_report.findings if "contype" in finding.reason]
    assert "has no MuJoCo: all bodies touch each other" in told and scene.filtered_pairs == set()


def test_gravity_compensation_is_told(imported):
    scene = imported(box("a", 0, 1).replace("<body ", '<body gravcomp="1" '))
    told = {finding.path.rsplit("/", 1)[-1]: finding.reason for finding in scene.import_report.findings}
    assert told["a"] == "mjc:body:gravcomp: not supported"
