"""Files that would become too much, too deep, or that refer to themselves, are refused before USD composes them."""

import ctypes
import os
import resource
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd

import warp_rigid as wr
from tests.fuzz.usd import BALL, chain, doubling, nest
from tests.usd_tools import moved, rigid, write_stage
from warp_rigid.render.film import film_from_usd
from warp_rigid.usd import opening
from warp_rigid.usd.check import check_usd
from warp_rigid.usd.instancing import flatten_usd
from warp_rigid.usd.load import film_duration


@pytest.fixture
def file(tmp_path):
    """Function(text) -> the path of a .usda file."""

    def write(text):
        path = tmp_path / "file.usda"
        path.write_text("#usda 1.0\n" + text)
        return path

    return write


def test_a_message_of_usd_that_is_no_text_is_replaced(tmp_path):
    """USD quotes what it cannot read; converting this message to a string fails."""
    path = tmp_path / "file.usda"
    path.write_bytes(b'#usda 1.0\ndef Xform "A" { string s = "\xff\xfe" }\n')
    with pytest.raises(ValueError, match="not a readable USD file: 'utf-8' codec can't decode"):
        opening.open_stage(path)


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


FILM = (
    '(\ndefaultPrim = "World"\n{}\n)\ndef Xform "World" {{\ndef Xform "env" {{\ndef Sphere "body" {{\n'
    "quatd xformOp:orient = (1, 0, 0, 0)\ndouble3 xformOp:translate = (0, 0, 0)\n"
    "color3f[] primvars:displayColor = [(1, 1, 1)]\n}}\n}}\n}}\n"
)


@pytest.mark.parametrize(
    ("metadata", "told"),
    [
        ("timeCodesPerSecond = 0", "timeCodesPerSecond: must be a finite number > 0, got 0.0"),
        ("timeCodesPerSecond = -24", "timeCodesPerSecond: must be a finite number > 0, got -24.0"),
        ("startTimeCode = 0\nendTimeCode = inf", "endTimeCode: must be a number from 0 to 100000, got inf"),
        ("startTimeCode = 0\nendTimeCode = nan", "endTimeCode: must be a number from 0 to 100000, got nan"),
        ("startTimeCode = 0\nendTimeCode = 1e300", "endTimeCode: must be a number from 0 to 100000, got 1e.300"),
        ("startTimeCode = -inf\nendTimeCode = 1", "startTimeCode: must be a finite number, got -inf"),
    ],
)
def test_a_range_of_time_codes_that_is_none_is_refused(file, metadata, told):
    path = file(FILM.format(metadata))
    for use in (film_duration, film_from_usd):
        with pytest.raises(ValueError, match=f"^{path}: {told}$"):
            use(path)


@pytest.mark.parametrize(
    ("metadata", "told"),
    [
        ("metersPerUnit = 0", "metersPerUnit: must be a number from 1e-12 to 1e.12, got 0.0"),
        ("metersPerUnit = -1", "metersPerUnit: must be a number from 1e-12 to 1e.12, got -1.0"),
        ("metersPerUnit = nan", "metersPerUnit: must be a number from 1e-12 to 1e.12, got nan"),
        ("kilogramsPerUnit = -1", "kilogramsPerUnit: must be a number from 1e-12 to 1e.12, got -1.0"),
        ('upAxis = "X"', "upAxis: must be one of Y, Z, got 'X'"),
    ],
)
def test_units_that_are_none_are_refused(file, metadata, told):
    with pytest.raises(ValueError, match=f": {told}$"):
        wr.import_usd(file(f"(\n{metadata}\n)\n{BALL}"))


@pytest.mark.parametrize("name", ["mass", "density"])
@pytest.mark.parametrize("value", ["-1", "nan", "inf"])
def test_a_body_of_wrong_mass_is_left_out(file, name, value):
    path = file(rigid("Bad", "Sphere", f"float physics:{name} = {value}") + BALL)
    with pytest.warns(UserWarning, match=f"/Bad: left out: physics:{name}: must be a finite number >= 0, got {value}"):
        assert [body.name for body in wr.import_usd(path).bodies] == ["P0"]


def test_an_instancer_without_its_prototype_is_one_line(file):
    instances = "int[] protoIndices = [0]\npoint3f[] positions = [(0, 0, 0)]\n"
    path = file(BALL + 'def PointInstancer "I" {\nrel prototypes = </Gone>\n' + instances + "}\n")
    for use in (wr.import_usd, lambda p: flatten_usd(p, p.with_suffix(".usdc"))):
        with pytest.raises(ValueError, match=f"^{path}: /I: prototypes: there is no prim /Gone$"):
            use(path)
    world = '(\ndefaultPrim = "World"\n)\ndef Xform "World" {\ndef Xform "env" {\ndef PointInstancer "I" {\n'
    for prototypes in ("", "rel prototypes = </Gone>\n"):
        path = file(world + prototypes + instances + "}\n}\n}\n")
        with pytest.raises(ValueError, match=f"^{path}: /World/env/I: must have a mesh as its prototype$"):
            film_from_usd(path)


def test_what_is_no_regular_file_is_not_opened(tmp_path, file):
    """A named pipe would be waited for without end."""
    os.mkfifo(tmp_path / "pipe.usda")
    for text in (f'def "A" (\nprepend references = @pipe.usda@\n)\n{{\n}}\n{BALL}', "(\nsubLayers = [@pipe.usda@]\n)"):
        with pytest.raises(ValueError, match="pipe.usda: must be a regular file"):
            wr.import_usd(file(text))


def test_files_of_value_clips_are_looked_into(tmp_path, file):
    os.mkfifo(tmp_path / "pipe.usda")
    for clip, told in (
        ("asset[] assetPaths = [@pipe.usda@]", "pipe.usda: must be a regular file"),
        ("asset manifestAssetPath = @pipe.usda@", "pipe.usda: must be a regular file"),
        ('string templateAssetPath = "a.#.usda"', "/A: templates of value clips are not supported"),
    ):
        clips = f"(\nclips = {{ dictionary default = {{ {clip} }} }}\n)"
        with pytest.raises(ValueError, match=told):
            wr.import_usd(file(f'def "A" {clips}\n{{\n}}\n{BALL}'))


CRATES = sorted((Path(__file__).parent / "fuzz" / "corpus").glob("*.usdc"))

OPEN_CRATES = """
import resource, sys
from pathlib import Path
from pxr import Usd

import warp_rigid as wr
from warp_rigid.usd import opening
for path in sys.argv[1:]:
    try:
        wr.import_usd(path)
    except ValueError as error:
        print(error)
    opening._EXAMINER._stop()  # the usage of a child is known once it has ended
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    # ru_maxrss of a process itself is at least that of the process which started it.
    largest = Path('/proc/self/status').read_text().partition('VmHWM:')[2].split()[0]
    print(sum(one.ru_utime + one.ru_stime for one in used), largest, used[1].ru_maxrss)
"""


@pytest.mark.long
def test_damaged_crates_take_little_time_and_memory():
    """Of 5.5 kB each; the library takes up to 3.7 GB and 7 s for one. One process opens all, one after the other."""
    command = [sys.executable, "-c", OPEN_CRATES, *map(str, CRATES)]
    made = subprocess.run(command, capture_output=True, text=True)
    told = made.stdout.strip().splitlines()
    assert len(told) == 2 * len(CRATES) > 0 and not made.stderr
    before = 0.0
    for crate, message, figures in zip(CRATES, told[::2], told[1::2], strict=True):
        seconds, kilobytes, of_children = map(float, figures.split())
        assert message.startswith(f"{crate}: not a readable USD file: ")
        assert seconds - before < 5.0 and kilobytes < 2**20
        assert 2**16 < of_children < 2**21
        before = seconds


def test_the_limits_can_be_set(file, monkeypatch):
    points = ", ".join(["(0, 0, 0)"] * 300_000)
    path = file(f'def Points "A" {{\npoint3f[] points = [{points}]\n}}\n{BALL}')
    monkeypatch.setenv("WARP_RIGID_USD_SECONDS", "60")
    assert len(wr.import_usd(path).bodies) == 1
    monkeypatch.delenv("WARP_RIGID_USD_SECONDS")
    monkeypatch.setenv("WARP_RIGID_USD_GIGABYTES", "0.0001")
    with pytest.raises(ValueError, match=f"^{path}: not a readable USD file: .*(memory)"):
        wr.import_usd(path)
    monkeypatch.setenv("WARP_RIGID_USD_GIGABYTES", "much")
    with pytest.raises(ValueError, match="WARP_RIGID_USD_GIGABYTES: must be a number > 0, got 'much'$"):
        wr.import_usd(path)


def test_a_reader_that_was_killed_is_started_again(file):
    path = file(BALL)
    wr.import_usd(path)
    opening._EXAMINER._process.kill()
    opening._EXAMINER._process.wait()
    assert len(wr.import_usd(path).bodies) == 1


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
    with pytest.raises(OSError, match="Is a directory: '.*/folder.usda'"):
        flatten_usd(file(BALL), tmp_path / "folder.usda")


PR_CAPBSET_DROP, CAP_SYS_RESOURCE = 24, 24
IMPORT_IT = "import sys; import warp_rigid as wr; print(len(wr.import_usd(sys.argv[1]).bodies))"


@pytest.mark.long
def test_a_file_is_read_under_hard_limits_of_the_system(file):
    """As set by `ulimit` or a queue; the process that examines files must not raise them, which root alone may."""

    def limit():
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_SYS_RESOURCE)
        for kind, most in ((resource.RLIMIT_CPU, 100), (resource.RLIMIT_AS, 9 * 2**30)):
            resource.setrlimit(kind, (most, most))

    command = [sys.executable, "-c", IMPORT_IT, str(file(BALL))]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit)
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr


@pytest.mark.long
def test_the_examination_ends_with_the_process_that_asked(file):
    """A file that takes long is left when its reader is killed."""
    points = ", ".join(["(0, 0, 0)"] * 3_000_000)
    slow = file(f'def Points "A" {{\npoint3f[] points = [{points}]\n}}\n')
    environment = os.environ | {"WARP_RIGID_USD_SECONDS": "100", "WARP_RIGID_USD_GIGABYTES": "4"}
    program = "import sys; from warp_rigid.usd import opening; opening._EXAMINER.start()\n" + (
        "print(opening._EXAMINER._process.pid, flush=True); opening._EXAMINER.refusal(sys.argv[1])"
    )
    command = [sys.executable, "-c", program, str(slow)]
    reader = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    group = int(reader.stdout.readline())
    time.sleep(1.0)
    assert processes_of(group) == 2
    reader.kill()
    reader.wait()
    deadline = time.monotonic() + 5.0
    while processes_of(group) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert processes_of(group) == 0


def processes_of(group):
    """Number of processes of a group that have not ended."""
    found = 0
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of_group = entry.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        found += of_group == str(group) and state != "Z"
    return found


@pytest.mark.parametrize("held", ["stage", "error"])
def test_a_file_that_changed_on_the_disk_is_read_again(tmp_path, held):
    """USD shares the layers that are open in a process: by the caller, or by the traceback of an error."""
    asset, path = tmp_path / "asset.usda", tmp_path / "file.usda"
    path.write_text("#usda 1.0\n(\n    metersPerUnit = 1\n    subLayers = [@./asset.usda@]\n)\n")

    def write(radius):
        write_stage(asset, rigid("Ball", "Sphere", f"double radius = {radius}"))

    write(0.0)
    if held == "stage":
        kept = Usd.Stage.Open(str(path))
    else:
        with pytest.raises(ValueError, match="radius") as kept:
            wr.import_usd(path)
    write(0.3)
    assert wr.import_usd(path).bodies[0].shape == wr.Sphere(0.3)
    del kept


def test_what_the_caller_has_not_saved_is_kept(tmp_path):
    path = write_stage(tmp_path / "file.usda", rigid("Ball", "Sphere", "double radius = 0.3"))
    stage = Usd.Stage.Open(str(path))
    radius = stage.GetPrimAtPath("/World/Ball").GetAttribute("radius")
    radius.Set(0.5)
    path.touch()
    wr.import_usd(path)
    assert radius.Get() == 0.5
