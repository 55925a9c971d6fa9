"""Import of MJCF and URDF files, by way of USD.

The files are converted by the programs mujoco_usd_converter and urdf_usd_converter. They run as processes of their own
and are installed into a Python environment of their own, because they bring another build of OpenUSD than usd-core.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from warp_rigid.engine.joints import mechanisms_of
from warp_rigid.scene.body_columns import is_dynamic
from warp_rigid.scene.import_report import ImportFinding
from warp_rigid.scene.scene import Scene
from warp_rigid.usd import limited
from warp_rigid.usd.load import import_usd

CONVERTERS = {".xml": "mujoco_usd_converter", ".mjcf": "mujoco_usd_converter", ".urdf": "urdf_usd_converter"}
"""Programs by the suffix of the file."""
ROBOT_SUFFIXES = tuple(CONVERTERS)
SECONDS = 300.0
"""Longest time that a conversion may take."""
MOST_BYTES = 8 * 2**30
"""Largest memory that a conversion may take."""
MESSAGE = re.compile(r"^\[(Warning|Error)\] (?:\[[^\]]*\] )?(.*)$")
"""A line that a converter prints: its severity, the function that it comes from, and the text."""
REFERENCE = re.compile(r"""\b(?:file|filename)\s*=\s*["']([^"']+)["']""")
"""An attribute that names a file: a mesh, a texture, or another part of the description."""
FOLDER = re.compile(r"""\b(?:meshdir|texturedir|assetdir)\s*=\s*["']([^"']+)["']""")
"""An attribute that names the folder of such files."""
PACKAGE = re.compile(r"""package://([^/"'\s]+)/""")
"""A package in the address of a mesh, as in package://my_robot/meshes/arm.stl."""
MASKED = re.compile(r"\b(contype|conaffinity)\b|<(include|model|attach)\b")
"""What an MJCF file contains that has masks, or refers to another file that may have some."""
FREE = re.compile(r"""\btype\s*=\s*["']free\b|<(include|model|attach)\b""")
"""The same for free joints that can have damping; those written as <freejoint> cannot."""
MUJOCO_READER = """
import json, sys
import mujoco, numpy

def masks(body):
    for geom in body.geoms:
        if geom.contype or geom.conaffinity:
            yield geom.name, int(geom.contype), int(geom.conaffinity)
    for child in body.bodies:
        yield from masks(child)

spec = mujoco.MjSpec.from_file(sys.argv[1])
free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
resisting = [joint for joint in free if numpy.any(joint.damping) or joint.frictionloss or joint.armature]
print(json.dumps({
    "masks": list(masks(spec.worldbody)), "resisting": [joint.name or joint.parent.name for joint in resisting]
}))
"""
"""Program that prints what the converter leaves out, as values of its defaults included. It runs in its environment.

- masks: name, contype and conaffinity (masks of MuJoCo) of each geom that can touch others, depth first, as the
  converter writes them.
- resisting: names of the free joints, or of their bodies, with damping, friction or armature.
"""
LEFT_OUT = {
    "mujoco_usd_converter": (("tendons", "tendon/*"), ("sensors", "sensor/*"), ("equality constraints", "equality/*")),
    "urdf_usd_converter": (
        ("mimic joints", "joint[mimic]"), ("transmissions", "transmission"), ("sensors", "sensor"),
        ("sensors", "gazebo/sensor"),
    ),
}  # fmt: skip
"""By the program of a format: kinds of features that the engine does not simulate, and the places of their elements."""
RESISTING = "damping, friction and armature of free joints"
BEHIND_JOINTS = ("connect", "weld")
"""Equality constraints that become joints."""
NOT_FOUND = "package {} is neither around the file nor in ROS_PACKAGE_PATH: its meshes are missing"


def import_robot(
    path: str | os.PathLike[str], *, self_collision: bool = False, strict: bool = False, sdf_resolution: int = 64
) -> Scene:
    """Read the bodies, colliders and joints of an MJCF or URDF file.

    The file is converted to USD by `mujoco_usd_converter` or `urdf_usd_converter`, which must be on the search path or
    beside the Python interpreter, and read by `import_usd`. What neither supports is listed in `scene.import_report`,
    with a warning; motors, tendons, equality constraints, mimic joints, transmissions, sensors and free joints with
    damping by their names, with a warning for each of these kinds. The package of an address
    `package://my_robot/meshes/arm.stl` is the folder `my_robot` that contains the file, or that lies in a folder around
    it, or in a folder of the environment variable ROS_PACKAGE_PATH.

    Args:
        path: .xml or .mjcf (MJCF), or .urdf.
        self_collision: whether bodies of the same mechanism can touch each other, where the masks of an MJCF file
            allow it. The links of many robots overlap.
        strict: reject a file that cannot be imported completely and unchanged.
        sdf_resolution: grid cells along the longest side of meshes.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is none of these files, its converter is missing or fails, it has no bodies, or `strict` is set
            and the import is incomplete.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if path.suffix.lower() not in CONVERTERS:
        raise ValueError(f"{path}: must end in one of {', '.join(CONVERTERS)}")
    with tempfile.TemporaryDirectory() as folder:
        findings = _convert(path, folder)
        more, resisting = _read_with_mujoco(path, folder)
        findings += more
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*see scene.import_report")
            try:
                scene = import_usd(_main_file(path, folder), sdf_resolution=sdf_resolution)
            except ValueError as error:
                raise ValueError(f"{path}: {str(error).replace(folder, '')}") from None
    if not self_collision and _filter_mechanisms(scene):
        findings.append(ImportFinding(path.name, "changed", "bodies of the same mechanism do not collide"))
    if massless := _without_mass(path):
        reason = f"links of mass 0 get a mass, a small one where they are fixed to another: {', '.join(massless)}"
        findings.append(ImportFinding(path.name, "changed", reason))
        warnings.warn(f"{path}: {reason}", stacklevel=2)
    report = scene.import_report
    assert report is not None
    named = _name_left_out(path, report.findings, resisting)
    report = replace(report, file=str(path), findings=(*findings, *named, *report.findings), files=(str(path),))
    scene.import_report = report
    report.tell(strict, stacklevel=2)
    for finding in named:
        warnings.warn(f"{path}: not simulated: {finding.reason}", stacklevel=2)
    return scene


def _filter_mechanisms(scene: Scene) -> bool:
    """Exclude pairs of bodies that joints connect, directly or not, from collision. Returns whether there are any."""
    dynamic = is_dynamic(scene.bodies)
    pairs = [pair for members in mechanisms_of(scene).members for pair in combinations(members, 2)]
    moving = [pair for pair in pairs if dynamic[list(pair)].all()]
    for first, second in moving:
        scene.filter_pair(first, second)
    return bool(moving)


def search_path() -> str:
    """Where the converters are looked for: beside the Python interpreter, then on the search path of the system."""
    return os.pathsep.join([os.path.dirname(sys.executable), os.environ.get("PATH", "")])


def _convert(path: Path, folder: str) -> list[ImportFinding]:
    """Convert a file, and return what the converter leaves out."""
    name = CONVERTERS[path.suffix.lower()]
    program = shutil.which(name, path=search_path())
    if program is None:
        package = name.replace("_", "-")
        raise ValueError(f"{path}: needs the program {name}: pipx install {package} (or pip, in its own environment)")
    packages = _packages(path)
    known = [f"--package={name}={place}" for name, place in packages.items() if place]
    command = [program, str(path.absolute()), folder, *known]
    _check_files(path, packages, set())
    try:
        done = _run(command, folder)
    except subprocess.TimeoutExpired:
        raise ValueError(f"{path}: {name} was stopped after {SECONDS:.0f} s") from None
    lines = (done.stdout + done.stderr).splitlines()
    told = [match.groups() for match in map(MESSAGE.match, lines) if match]
    if done.returncode or not list(Path(folder).glob("*.usd*")):
        raise ValueError(f"{path}: {name}: {_reason(lines)}")
    told += [("Warning", NOT_FOUND.format(name)) for name, place in packages.items() if place is None]
    return [ImportFinding(path.name, "left out", text) for text in dict.fromkeys(text for _, text in told)]


def _reason(lines: list[str]) -> str:
    """Why a conversion failed: the first error with the lines that belong to it, else the last message or line."""
    lines = [line.strip() for line in lines if line.strip()]
    starts = [row for row, line in enumerate(lines) if MESSAGE.match(line)]
    errors = [row for row in starts if lines[row].startswith("[Error]")]
    if not starts:
        return lines[-1] if lines else "no message"
    start = errors[0] if errors else starts[-1]
    end = min((row for row in starts if row > start), default=len(lines))
    return MESSAGE.sub(r"\2", " ".join(lines[start:end]))


def _run(command: list[str], folder: str) -> subprocess.CompletedProcess:
    """Run a program of the converters' environment in a folder, with limits on memory and time."""
    if sys.platform != "win32":
        limits = [str(MOST_BYTES), str(max(1, round(SECONDS))), str(os.getpid())]
        command = [sys.executable, "-I", "-S", limited.__file__, *limits, *command]
    # The variables of this Python environment must not affect the other interpreter's imports.
    surroundings = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    return subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, env=surroundings, cwd=folder)


def _read_with_mujoco(path: Path, folder: str) -> tuple[list[ImportFinding], list[str]]:
    """Add the masks of an MJCF file to its conversion.

    Returns:
        What cannot be added, and the names of free joints with damping, friction or armature.
    """
    text = "" if path.suffix.lower() == ".urdf" else path.read_text(errors="replace")
    if not (MASKED.search(text) or FREE.search(text)):
        return [], []
    program = shutil.which(CONVERTERS[path.suffix.lower()], path=search_path()) or ""
    python = Path(program).resolve().parent / "python"
    resisting: list[str] = []
    try:
        done = _run([str(python), "-c", MUJOCO_READER, str(path.absolute())], folder)
        done.check_returncode()
        found = json.loads(done.stdout.splitlines()[-1])
        resisting = found["resisting"]
        if MASKED.search(text):
            _add_masks(_main_file(path, folder), found["masks"])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError) as error:
        reason = str(error).splitlines()[0] if isinstance(error, ValueError) else f"{python} has no MuJoCo"
        reason = f"contype and conaffinity: {reason}: all bodies touch each other"
        return [ImportFinding(path.name, "left out", reason)], resisting
    return [], resisting


def _add_masks(file: Path, masks: list[tuple[str, int, int]]) -> None:
    """Write one collision group for each pair of masks to a converted file.

    Two geoms touch if the contype of one and the conaffinity of the other have a common bit.

    Args:
        file: the layer that the converter wrote.
        masks: of the geoms with a collider, in the order of the file.

    Raises:
        ValueError: The file has other colliders.
    """
    from pxr import Usd, UsdPhysics

    from warp_rigid.usd.masses import MUJOCO_COLLIDER
    from warp_rigid.usd.opening import open_stage
    from warp_rigid.usd.prims import applies

    stage = open_stage(file)
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    colliders = [prim for prim in prims if applies(prim, MUJOCO_COLLIDER)]
    names = [{prim.GetName(), prim.GetDisplayName()} for prim in colliders]
    if len(masks) != len(names) or any(mask[0] and mask[0] not in own for mask, own in zip(masks, names, strict=True)):
        raise ValueError("the converter writes other colliders")
    members: dict[tuple[int, int], list[str]] = {}
    for prim, (_, kind, affinity) in zip(colliders, masks, strict=True):
        members.setdefault((kind, affinity), []).append(str(prim.GetPath()))
    paths = {mask: f"/warp_rigid_masks/group_{index}" for index, mask in enumerate(members)}
    for mask, path in paths.items():
        group = UsdPhysics.CollisionGroup.Define(stage, path)
        group.GetCollidersCollectionAPI().CreateIncludesRel().SetTargets(members[mask])
        apart = [other for (kind, affinity), other in paths.items() if not (kind & mask[1] or mask[0] & affinity)]
        group.CreateFilteredGroupsRel().SetTargets(apart)
    stage.GetRootLayer().Save()


def _packages(path: Path) -> dict[str, Path | None]:
    """The packages that a URDF file names, and their folders; None for those that are not found.

    The folder of a package is around the file, the nearest first, or on ROS_PACKAGE_PATH.
    """
    if path.suffix.lower() != ".urdf":
        return {}
    listed = filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))
    folders = (*path.absolute().parents, *map(Path, listed))
    found: dict[str, Path | None] = {}
    for name in PACKAGE.findall(path.read_text(errors="replace")):
        candidates = (place for folder in folders for place in (folder, folder / name))
        found[name] = next((place for place in candidates if place.name == name and place.is_dir()), None)
    return found


def _check_files(path: Path, packages: dict[str, Path | None], checked: set[Path]) -> None:
    """Check that the files behind a description are regular ones: a named pipe would be waited for without end.

    Raises:
        ValueError: One of them is not.
    """
    checked.add(path)
    text = path.read_text(errors="replace")
    folders = [path.parent, *(path.parent / name for name in FOLDER.findall(text))]
    for name in REFERENCE.findall(text):
        package, _, rest = name.removeprefix("package://").partition("/")
        within = [packages.get(package) or path.parent] if name.startswith("package://") else folders
        for found in [folder / (rest if name.startswith("package://") else name) for folder in within]:
            if found.exists() and not found.is_file() and not found.is_dir():
                raise ValueError(f"{path}: {name}: must be a regular file")
            if found.suffix.lower() in CONVERTERS and found.is_file() and found not in checked:
                _check_files(found, packages, checked)


def _main_file(path: Path, folder: str) -> Path:
    """The layer of a conversion that the others belong to."""
    layers = sorted(Path(folder).glob("*.usd*"))
    return next((layer for layer in layers if layer.stem == path.stem), layers[0])


def _name_left_out(path: Path, findings: Iterable[ImportFinding], resisting: list[str]) -> list[ImportFinding]:
    """One finding for each kind of feature that is not simulated, with the names that the file gives.

    Args:
        path: an MJCF or URDF file.
        findings: what was left out of its conversion, which tells the motors apart from the servos that are imported.
        resisting: free joints with damping, friction or armature.
    """
    named: dict[str, list[str]] = {RESISTING: resisting} if resisting else {}
    for root in _included(path, set()):
        for kind, place in LEFT_OUT[CONVERTERS[path.suffix.lower()]]:
            for element in root.findall(place):
                if element.tag not in BEHIND_JOINTS:
                    named.setdefault(kind, []).append(_name(element))
    for finding in findings:
        if finding.reason.startswith("MjcActuator"):
            named.setdefault("motors", []).append(finding.path.rpartition("/")[2])
    return [
        ImportFinding(path.name, "left out", f"{kind}: {', '.join(dict.fromkeys(names))}")
        for kind, names in named.items()
    ]


def _without_mass(path: Path) -> list[str]:
    """Names of the links of a URDF file that state a mass of 0 and have a collider, which get a mass."""
    if path.suffix.lower() != ".urdf":
        return []
    links = (link for root in _included(path, set()) for link in root.findall("link[collision]"))
    return [_name(link) for link in links if _states_no_mass(link)]


def _states_no_mass(link: ElementTree.Element) -> bool:
    mass = link.find("inertial/mass")
    try:
        return mass is not None and float(mass.get("value", "")) == 0.0
    except ValueError:
        return False


def _included(path: Path, seen: set[Path]) -> Iterator[ElementTree.Element]:
    """The roots of a file and of those that it includes; the converter reports those that cannot be read."""
    seen.add(path)
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return
    yield root
    for element in root.iter("include"):
        included = path.parent / element.get("file", "")
        if included not in seen and included.is_file():
            yield from _included(included, seen)


def _name(element: ElementTree.Element) -> str:
    """The name of an element; without one, its kind and what it refers to, as in `joint (left, right)`."""
    references = [value for key, value in element.attrib.items() if key.rstrip("12") in ("joint", "tendon", "site")]
    described = f"{element.tag} ({', '.join(references)})" if references else f"{element.tag} without a name"
    return element.get("name") or described
