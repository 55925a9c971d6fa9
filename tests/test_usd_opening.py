"""Files that would become too much, too deep, or that refer to themselves, are refused before USD composes them."""

import time
import zipfile

import numpy as np
import pytest

import warp_rigid as wr
from tests.fuzz.usd import BALL, chain, doubling, nest
from tests.usd_tools import moved, rigid, write_stage
from warp_rigid.render.film import film_from_usd
from warp_rigid.usd.check import check_usd
from warp_rigid.usd.flatten import flatten_usd


@pytest.fixture
def file(tmp_path):
    """Function(text) -> the path of a .usda file."""

    def write(text):
        path = tmp_path / "file.usda"
        path.write_text("#usda 1.0\n" + text)
        return path

    return write


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (doubling(30, "references"), "at most 1000000 prims including references, has about 9e.09"),
        (doubling(30, "instances"), "at most 1000000 prims including references, has about 9e.09"),
        (doubling(30, "instancers"), "at most 1000000 prims including instances, has "),
        (chain(150, "references"), "at most 100 chained references, has 149"),
        (nest(70_000, "instances"), "at most 1000 nested brackets"),
        ('def "A" (\nprepend references = </A>\n)\n{\n}\n', "/A must not refer to itself"),
        (
            'def "A" (\nprepend references = </B>\n)\n{\n}\n'
            'def "B" {\ndef "C" (\nprepend inherits = </A>\n)\n{\n}\n}\n',
            "/[ABC/]+ must not refer to itself",
        ),
        (
            'def PointInstancer "I" {\nrel prototypes = </I>\nint[] protoIndices = [0]\n'
            "point3f[] positions = [(0, 0, 0)]\n}\n",
            "/I: must not be one of its own prototypes",
        ),
    ],
)
def test_too_much_is_refused_at_once(file, text, told):
    path = file(text)
    start = time.perf_counter()
    with pytest.raises(ValueError, match=told) as error:
        wr.import_usd(path)
    assert "\n" not in str(error.value) and time.perf_counter() - start < 5.0
    if "instances" not in told and "prototypes" not in told:
        for use in (check_usd, film_from_usd, wr.Mesh.from_file, lambda p: flatten_usd(p, p.with_suffix(".usdc"))):
            with pytest.raises(ValueError, match=told):
                use(path)


def test_packages_and_layers_behind_are_looked_into(tmp_path, file):
    deep = "#usda 1.0\n" + nest(5000, "instances")
    (tmp_path / "deep.usda").write_text(deep)
    with zipfile.ZipFile(tmp_path / "deep.usdz", "w", zipfile.ZIP_STORED) as package:
        package.writestr("a.usda", deep)
    for name in ("deep.usda", "deep.usdz"):
        for text in (f'def "A" (\nprepend references = @{name}@</a>\n)\n{{\n}}\n', f"(\nsubLayers = [@{name}@]\n)\n"):
            with pytest.raises(ValueError, match="at most 1000 nested brackets"):
                wr.import_usd(file(text))
    path = tmp_path / "deep.usdz"
    with pytest.raises(ValueError, match="at most 1000 nested brackets"):
        wr.import_usd(path)
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02")] = 0
    path.write_bytes(content)
    with pytest.raises(ValueError, match="deep.usdz: not a readable package: Bad magic number for central directory"):
        wr.import_usd(path)


def test_variants_payloads_and_what_comes_through_references_count(file):
    """Of a set of variants the largest one counts; a prim that only a reference brings is as large as the reference."""
    large = doubling(18, "references")
    variants = (
        'def "V" (\nvariants = {\nstring v = "a"\n}\nprepend variantSets = "v"\n)\n{\nvariantSet "v" = {\n'
        '"a" {\ndef "x" (\nprepend payload = </P18>\n)\n{\n}\n}\n"b" {\n}\n}\n}\n'
    )
    through = (
        'def "T" {\ndef "x" (\nprepend references = </P18>\n)\n{\n}\n}\n'
        'def "U" (\nprepend references = </T/x/a>\n)\n{\n}\n'
    )
    for text in (large + variants, large + through):
        with pytest.raises(ValueError, match="at most 1000000 prims including references"):
            wr.import_usd(file(text))
    assert len(wr.import_usd(file(doubling(3, "references") + variants.replace("P18", "P3"))).bodies) == 23


def test_instancers_within_prototypes_are_expanded(file):
    """Two of two of two, also where only the outermost is below the root that is read."""
    path = file(doubling(3, "instancers"))
    scene = wr.import_usd(path, root="/P3")
    places = sorted(body.position[0] for body in scene.bodies)
    np.testing.assert_allclose(places, np.arange(8) * 0.06)
    path = file(doubling(1, "instancers").replace('def Xform "P1"', 'def PointInstancer "P1"'))
    assert len(wr.import_usd(path).bodies) == 1, "below an instancer that has no prototypes nothing is there"


def test_what_is_missing_behind_a_reference_is_told(file):
    text = 'def "A" (\nprepend references = @none.usda@\n)\n{\n}\n' + rigid("Ball", "Sphere")
    with pytest.warns(UserWarning, match="/A: left out: Could not open asset @none.usda@"):
        scene = wr.import_usd(file(text))
    assert len(scene.bodies) == 1 and len(scene.import_report.left_out) == 1
    with pytest.raises(ValueError, match="/A: left out: Could not open asset"):
        wr.import_usd(file(text), strict=True)


@pytest.mark.parametrize(
    ("prim", "told"),
    [
        (rigid("Ball", "Sphere", moved("nan", 0, 0)), "/World/Ball: left out: transform: must be finite numbers"),
        (rigid("Ball", "Capsule", 'token axis = "W"'), "axis: must be one of X, Y, Z, got 'W'"),
        (
            rigid("Ball", "Sphere", "double radius = 1e300"),
            "/World/Ball: left out: radius: must be a finite number > 0",
        ),
        (
            rigid("Ball", "Mesh", "int[] faceVertexCounts = [3, 3]; int[] faceVertexIndices = [0, 1, 2]"),
            "/World/Ball: faceVertexCounts must add up to the length of faceVertexIndices, 3, got 6",
        ),
        (
            rigid("Ball", "Sphere").replace(
                "\n)", "\n customData = { dictionary warp_rigid = { int sdfResolution = 8 } }\n)"
            )
            + 'def PhysicsScene "P" (\ncustomData = { dictionary warp_rigid = { '
            "double3[] pointFieldCenters = [(0, 0, 1)] } }\n)\n{\n}\n",
            "pointFieldStrengths: must be 1 numbers in the custom data of warp_rigid",
        ),
        (rigid("Ball", "Sphere", "uniform string physics:density = 'x'"), "cannot be read: "),
    ],
)
def test_wrong_values_are_told_by_name(tmp_path, prim, told):
    with pytest.raises(ValueError) as error:
        wr.import_usd(write_stage(tmp_path / "file.usda", prim))
    assert told in str(error.value) and "\n" not in str(error.value)


def test_a_mesh_that_is_marked_as_a_height_field_must_be_one(tmp_path):
    mark = "\n customData = { dictionary warp_rigid = { int heightfieldRows = 3; int heightfieldColumns = 2 } }\n)"
    mesh = rigid("Ball", "Mesh", "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]").replace("\n)", mark)
    with pytest.raises(
        ValueError, match="heightfieldRows: times heightfieldColumns must be 4, the number of mesh points"
    ):
        wr.import_usd(write_stage(tmp_path / "file.usda", mesh))


def test_the_parsers_reason_is_told(file):
    with pytest.raises(
        ValueError, match="file.usda: not a readable USD file: .*:2:1: parse error .* at 'nonsense'"
    ) as error:
        wr.import_usd(file("nonsense\n"))
    assert "Error in" not in str(error.value) and "\n" not in str(error.value)
    path = file("")
    path.write_bytes(b"#us")
    with pytest.raises(ValueError, match="not a readable USD file"):
        wr.import_usd(path)


def test_a_film_of_endless_frames_is_refused(file):
    text = (
        '(\ndefaultPrim = "World"\nstartTimeCode = 0\nendTimeCode = 1e12\n)\ndef Xform "World" {\ndef Xform "env" {\n'
        'def Xform "body" {\nquatd xformOp:orient = (1, 0, 0, 0)\n}\n}\n}\n'
    )
    with pytest.raises(ValueError, match="endTimeCode: must be a number from 0 to 100000"):
        film_from_usd(file(text))
    with pytest.raises(ValueError, match="/World/env/body has no geometry"):
        film_from_usd(file(text.replace("1e12", "3")))


def test_sublayers_that_are_missing_damaged_or_too_many(tmp_path, file):
    """Without those that cannot be read the rest stands, and the report names them."""
    (tmp_path / "bad.usda").write_text("nonsense")
    for name in ("none.usda", "bad.usda"):
        path = file(f"(\nsubLayers = [@{name}@]\n)\n" + rigid("Ball", "Sphere"))
        with pytest.warns(UserWarning, match=f"left out: .*{name}"):
            assert len(wr.import_usd(path).bodies) == 1
    for index in range(1100):
        (tmp_path / f"{index}.usda").write_text(f"#usda 1.0\n(\nsubLayers = [@{index + 1}.usda@]\n)\n")
    with pytest.raises(ValueError, match="0.usda: must have at most 1000 sublayers"):
        wr.import_usd(tmp_path / "0.usda")


def test_a_target_that_cannot_be_written_is_one_line(tmp_path, file):
    (tmp_path / "folder.usda").mkdir()
    with pytest.raises(OSError, match="folder.usda: cannot be written"):
        flatten_usd(file(BALL), tmp_path / "folder.usda")
