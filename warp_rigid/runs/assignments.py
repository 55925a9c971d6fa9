"""Assignments `name=value` of the command line, sorted by what they set.

Parameters of a scene, settings and properties of bodies share one vocabulary. A list of values,
separated by commas, gives one value to each environment.
"""

import ast
import difflib
import inspect
from dataclasses import dataclass, field, fields
from typing import Any

from warp_rigid.checks import shown
from warp_rigid.engine.quantities import STATE_NAMES
from warp_rigid.engine.settings import Settings
from warp_rigid.scene.coefficients import COEFFICIENTS

__all__ = ["PROPERTIES", "Assignments", "parse_assignment", "place_of", "sort_assignments"]

PROPERTIES = (*COEFFICIENTS, "mass", *STATE_NAMES, "gravity")
"""What can be set in a simulation beside the settings; all bodies get the same value."""

SETTINGS = tuple(f.name for f in fields(Settings))


@dataclass
class Assignments:
    """What to set, and where.

    Attributes:
        scene: parameters of the scene, by name.
        settings: settings that hold for all environments, by name.
        batched: settings and properties with one value an environment, by name.
        properties: properties that hold for all environments, by name.
    """

    scene: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    batched: dict[str, list] = field(default_factory=dict)
    properties: dict[str, Any] = field(default_factory=dict)

    @property
    def num_envs(self) -> int | None:
        """How many environments the lists of values ask for; None without lists."""
        return max((len(values) for values in self.batched.values()), default=None)


def parse_assignment(text: str, flag: str = "--set") -> tuple[str, list]:
    """Split "name=value" or "name=value,value,..." into the name and its values.

    A value is a number, true, false, a vector in brackets such as (0,0,-9.81), or else a word.

    Args:
        text: what to split.
        flag: where it comes from, for the message.

    Raises:
        ValueError: The text has another form.
    """
    name, equals, values = text.partition("=")
    name, bracket, bodies = name.strip().partition("[")
    name = name.replace("-", "_")
    parts = [part.strip() for part in _split(values)]
    if not equals or not name.isidentifier() or (bracket and not bodies.endswith("]")) or not all(parts):
        raise ValueError(f"{flag}: must be name=value or name=value,value,..., got {shown(text)}")
    return name + bracket + bodies, [_value(part) for part in parts]


def place_of(name: str, parameters, flag: str = "--set") -> str:
    """Say what a name sets: "scene", "setting" or "property".

    A parameter of the scene comes before a property of the same name, since the scene knows which bodies it means.

    Args:
        name: the name; that of a property can choose bodies, such as "mass[box_*]".
        parameters: the names of the scene's parameters.
        flag: where it comes from, for the message.

    Raises:
        ValueError: The name is unknown, or chooses bodies where there are none to choose.
    """
    plain, bracket, _ = name.partition("[")
    if bracket:
        if plain not in PROPERTIES or plain == "gravity":
            raise ValueError(f"{flag} {name}: is no property of bodies, so it cannot choose bodies")
        return "property"
    if name in parameters:
        return "scene"
    if name in SETTINGS:
        return "setting"
    if name in PROPERTIES:
        return "property"
    raise ValueError(_unknown(name, (*parameters, *SETTINGS, *PROPERTIES), flag))


def sort_assignments(texts, build) -> Assignments:
    """Parse assignments and sort them by what they set.

    Args:
        texts: texts such as "height=10" or "friction=0.1,0.5,0.9".
        build: the scene's function; its parameters are the names it understands.

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
        several = len(values) > 1
        place = place_of(name, parameters)
        if place == "scene" and not (several and name in PROPERTIES):
            if several:
                raise ValueError(f"--set {name}: is a parameter of the scene and takes one value, not a list")
            result.scene[name] = values[0]
        elif several and name == "dt":
            raise ValueError("--set dt: is one for the whole simulation and takes one value")
        elif several:
            result.batched[name] = values
        elif place == "setting":
            result.settings[name] = values[0]
        else:
            result.properties[name] = values[0]
    lengths = {name: len(values) for name, values in result.batched.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise ValueError(f"--set: lists must have one value an environment, but {told}")
    return result


def _split(text: str) -> list[str]:
    """Split at the commas outside brackets."""
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
        return text


def _unknown(name: str, names: tuple[str, ...], flag: str) -> str:
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else f"; known: {', '.join(dict.fromkeys(names))}"
    return f"{flag} {name}: unknown name{hint}"
