"""Assignments `name=value` of the command line, sorted by target.

Scene parameters, settings and body properties share one set of names. A comma-separated list gives one value to each
environment.
"""

import ast
import inspect
from dataclasses import dataclass, field, fields
from typing import Any

from warp_rigid.checks import shown, suggestion
from warp_rigid.engine import field_values, joint_quantities
from warp_rigid.engine.quantities import STATE_NAMES, VECTOR_LENGTHS, check_vectors
from warp_rigid.engine.settings import Settings
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.scene import SURFACE_VELOCITIES

BODY_PROPERTIES = (*COEFFICIENTS, "mass", *STATE_NAMES, *SURFACE_VELOCITIES, "active")
SELECTING = (*BODY_PROPERTIES, *joint_quantities.WRITABLE)
"""Properties of bodies and of joints, which can be selected by name."""
PROPERTIES = (*SELECTING, "gravity", *field_values.VALUE_SHAPES)
"""Quantities that can be set in a simulation besides the settings; all bodies, joints or force fields get the same
value."""

SETTINGS = tuple(f.name for f in fields(Settings))
SET_NAMES = "help(Simulator.set)"


@dataclass
class Assignments:
    """Values to set, by target.

    Attributes:
        scene: scene parameters, by name.
        settings: settings shared by all environments, by name.
        batched: settings and properties with one value per environment, by name.
        properties: properties shared by all environments, by name.
    """

    scene: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    batched: dict[str, list] = field(default_factory=dict)
    properties: dict[str, Any] = field(default_factory=dict)

    @property
    def num_envs(self) -> int | None:
        """Number of environments required by the lists of values; None without lists."""
        return max((len(values) for values in self.batched.values()), default=None)

    @property
    def scene_key(self) -> str:
        """Key that is equal for equal scene parameters."""
        return repr(sorted(self.scene.items()))


def parse_assignment(text: str, flag: str = "--set") -> tuple[str, list]:
    """Split "name=value" or "name=value,value,..." into the name and its values.

    A value is a number, true, false, a vector in brackets such as (0,0,-9.81), or else a string.

    Args:
        text: the assignment.
        flag: option name for the error message.

    Raises:
        ValueError: The text has another form.
    """
    name, equals, values = text.partition("=")
    name, bracket, bodies = name.strip().partition("[")
    name = name.replace("-", "_")
    parts = [part.strip() for part in split_at_commas(values)]
    choice_is_bad = bracket and not (bodies.endswith("]") and bodies[:-1].strip())
    if not equals or not name.isidentifier() or choice_is_bad or not all(parts):
        raise ValueError(f"{flag}: must be name=value or name=value,value,..., got {shown(text)}")
    return name + bracket + bodies, [_value(part) for part in parts]


def join_vector(name: str, values: list) -> list:
    """Join the numbers of one vector that is written without brackets, such as gravity=0,0,-1.62.

    Args:
        name: the name, with or without a selection of bodies.
        values: from parse_assignment.

    Raises:
        ValueError: The quantity is a vector and a value is not.
    """
    plain = name.partition("[")[0]
    if plain not in VECTOR_LENGTHS:
        return values
    numbers = all(isinstance(value, int | float) for value in values)
    if numbers and len(values) == VECTOR_LENGTHS[plain]:
        return [tuple(values)]
    for value in values:
        try:
            check_vectors(plain, value)
        except ValueError as error:
            raise ValueError(f"--set {error}; write vectors in brackets: {plain}=(0,0,1),(0,0,2)") from None
    return values


def assignment_target(name: str, parameters, flag: str = "--set") -> str:
    """Return what a name sets: "scene", "setting" or "property".

    A scene parameter takes precedence over a property of the same name.

    Args:
        name: the name; a property name may select bodies, such as "mass[box_*]".
        parameters: the names of the scene parameters.
        flag: option name for the error message.

    Raises:
        ValueError: The name is unknown, or selects bodies for something other than a body property.
    """
    plain, bracket, _ = name.partition("[")
    if bracket:
        if plain not in SELECTING:
            known = suggestion(plain, SELECTING, SET_NAMES)
            raise ValueError(f"{flag} {name}: is not a property of bodies or joints, so it cannot select bodies{known}")
        return "property"
    if name in parameters:
        return "scene"
    if name in SETTINGS:
        return "setting"
    if name in PROPERTIES:
        return "property"
    if name == "substeps":
        raise ValueError(f"{flag} {name}: unknown name; set dt, the time step [s], or use run --substeps")
    known = suggestion(
        name, (*parameters, *SETTINGS, *PROPERTIES), f"{', '.join((*parameters, 'dt'))} and those in {SET_NAMES}"
    )
    raise ValueError(f"{flag} {name}: unknown name{known}")


def sort_assignments(texts, build) -> Assignments:
    """Parse assignments and sort them by target.

    Args:
        texts: strings such as "height=10" or "friction=0.1,0.5,0.9".
        build: the scene function; its parameters are the names of the scene parameters.

    Raises:
        ValueError: A name is unknown or given twice, or lists differ in length.
    """
    parameters = tuple(inspect.signature(build).parameters)
    result, seen = Assignments(), set()
    for text in texts:
        name, values = parse_assignment(text)
        if name in seen:
            raise ValueError(f"--set {name}: given twice")
        seen.add(name)
        target = assignment_target(name, parameters)
        if target == "property":
            values = join_vector(name, values)
        several = len(values) > 1
        if target == "scene" and not (several and name in PROPERTIES):
            if several:
                raise ValueError(f"--set {name}: is a scene parameter and takes one value, not a list")
            result.scene[name] = values[0]
        elif several and name == "dt":
            raise ValueError("--set dt: is shared by all environments and takes one value")
        elif several:
            result.batched[name] = values
        elif target == "setting":
            result.settings[name] = values[0]
        else:
            result.properties[name] = values[0]
    lengths = {name: len(values) for name, values in result.batched.items()}
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise ValueError(f"--set: lists must have one value per environment, but {found}")
    return result


def split_at_commas(text: str) -> list[str]:
    """Split at commas outside brackets."""
    parts, depth = [""], 0
    for character in text:
        depth += (character in "([") - (character in ")]")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def _value(text: str) -> Any:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return float(text) if text.lower().lstrip("+-") in ("nan", "inf") else text
