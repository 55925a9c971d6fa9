"""Names of what a robot's file defines and the engine does not simulate: motors, tendons, couplings and sensors."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator
from pathlib import Path

from warp_rigid.scene.import_report import ImportFinding

MOTORS, TENDONS, EQUALITIES = "motors", "tendons", "equality constraints"
MIMICS, SENSORS, TRANSMISSIONS = "mimic joints", "sensors", "transmissions"
BEHIND_JOINTS = ("connect", "weld")
"""Equality constraints that become joints."""


def name_left_out(path: Path, findings: Iterable[ImportFinding]) -> list[ImportFinding]:
    """One finding for each kind of feature that is left out, with the names that the file gives.

    Args:
        path: an MJCF or URDF file.
        findings: what was left out of its conversion, which tells the motors apart from the servos that are imported.
    """
    named: dict[str, list[str]] = {}
    for kind, name in _urdf(path) if path.suffix.lower() == ".urdf" else _mjcf(path):
        named.setdefault(kind, []).append(name)
    for finding in findings:
        if finding.reason.startswith("MjcActuator"):
            named.setdefault(MOTORS, []).append(finding.path.rpartition("/")[2])
    return [
        ImportFinding(path.name, "left out", f"{kind}: {', '.join(dict.fromkeys(names))}")
        for kind, names in named.items()
    ]


def without_mass(path: Path) -> list[str]:
    """Names of the links of a URDF file that state a mass of 0 and have a collider, which get a mass."""
    if path.suffix.lower() != ".urdf":
        return []
    links = (link for root in _included(path, set()) for link in root.findall("link"))
    return [_name(link) for link in links if link.find("collision") is not None and _states_no_mass(link)]


def _states_no_mass(link: ElementTree.Element) -> bool:
    mass = link.find("inertial/mass")
    try:
        return mass is not None and float(mass.get("value", "")) == 0.0
    except ValueError:
        return False


def _mjcf(path: Path) -> Iterator[tuple[str, str]]:
    """Kinds and names of the tendons, equality constraints and sensors of an MJCF file and of those it includes."""
    for root in _included(path, set()):
        for kind, section in ((TENDONS, "tendon"), (SENSORS, "sensor"), (EQUALITIES, "equality")):
            for element in (element for part in root.findall(section) for element in part):
                if section != "equality" or element.tag not in BEHIND_JOINTS:
                    yield kind, element.get("name") or _described(element)


def _urdf(path: Path) -> Iterator[tuple[str, str]]:
    """Kinds and names of the mimic joints, transmissions and sensors of a URDF file."""
    for root in _included(path, set()):
        yield from ((MIMICS, _name(joint)) for joint in root.findall("joint") if joint.find("mimic") is not None)
        yield from ((TRANSMISSIONS, _name(transmission)) for transmission in root.findall("transmission"))
        sensors = [*root.findall("sensor"), *root.findall("gazebo/sensor")]
        yield from ((SENSORS, _name(sensor)) for sensor in sensors)


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
    return element.get("name") or "without a name"


def _described(element: ElementTree.Element) -> str:
    """An element without a name by its kind and what it refers to, as in `joint (left, right)`."""
    references = [value for key, value in element.attrib.items() if key.rstrip("12") in ("joint", "tendon", "site")]
    return f"{element.tag} ({', '.join(references)})" if references else f"{element.tag} without a name"
