"""Camera of pictures, as plain data."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from warp_rigid.checks import MOST_LISTED, finite_vector, instance_of, number_in, shown, suggestion

AZIMUTH, ELEVATION = -67.0, 22.0
"""Direction from which bodies are seen by default [degree]."""
FIELD_OF_VIEW = 30.0
"""Default vertical field of view [degree]."""
NARROWEST, WIDEST = 1.0, 150.0
"""Range of fields of view [degree]."""
SHORTEST = 1e-6
"""Least distance between a camera and what it looks at [m]."""


@dataclass(frozen=True)
class Camera:
    """Camera of pictures, films, pages and USD files. z of the world points up in the picture.

    `Camera(position=..., look_at=...)` stands still. `Camera.orbit` looks from a direction, and keeps the moving
    bodies in view if no distance is given; `Camera()` does so from the default direction. `Camera.follow` moves with a
    body.

    Attributes:
        position: (3,) of the camera, in the coordinates of the environment [m]; None for a camera that is placed by its
            direction and distance.
        look_at: (3,) the point in the middle of the picture [m]; None for the middle of the moving bodies, or of the
            body that is followed.
        field_of_view: vertical angle [degree], from 1 to 150.
        azimuth: of the direction from `look_at` to the camera, from x toward y [degree], from -360 to 360.
        elevation: of that direction above the horizontal [degree], from -90 to 90.
        distance: between `look_at` and the camera [m], > 0; None for one at which the bodies fill the picture.
        body: name or index of the body that is followed; None for no body.

    Raises:
        ValueError: A value is outside its range, or two of them contradict each other.
    """

    position: tuple[float, float, float] | None = None
    look_at: tuple[float, float, float] | None = None
    field_of_view: float = FIELD_OF_VIEW
    azimuth: float = AZIMUTH
    elevation: float = ELEVATION
    distance: float | None = None
    body: str | int | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        checked: dict[str, Any] = {
            "field_of_view": number_in("field_of_view", self.field_of_view, NARROWEST, WIDEST),
            "azimuth": number_in("azimuth", self.azimuth, -360.0, 360.0),
            "elevation": number_in("elevation", self.elevation, -90.0, 90.0),
        }
        for name in ("position", "look_at"):
            value = getattr(self, name)
            checked[name] = None if value is None else finite_vector(name, value)
        if self.distance is not None:
            checked["distance"] = number_in("distance", self.distance, SHORTEST)
        if self.body is not None:
            checked["body"] = _body(self.body)
        if self.position is not None:
            checked |= self._direction_between(checked["position"], checked["look_at"])
        if self.body is not None and self.look_at is not None:
            raise ValueError("look_at: must be None for a camera that follows a body")
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def _direction_between(self, position: tuple, look_at: tuple | None) -> dict[str, float]:
        """Azimuth, elevation and distance of a camera that stands still."""
        if look_at is None:
            raise ValueError("look_at: must be given with position")
        x, y, z = (a - b for a, b in zip(position, look_at, strict=True))
        distance = math.hypot(x, y, z)
        if distance < SHORTEST:
            raise ValueError(f"look_at: must be at least {SHORTEST:g} m from position, got {shown(look_at)} for both")
        flat = math.hypot(x, y)
        # Straight from above, x points to the right.
        azimuth = math.degrees(math.atan2(y, x)) if flat > 1e-9 * distance else -90.0
        return {"azimuth": azimuth, "elevation": math.degrees(math.atan2(z, flat)), "distance": distance}

    @classmethod
    def orbit(
        cls,
        azimuth: float = AZIMUTH,
        elevation: float = ELEVATION,
        *,
        look_at: Any = None,
        distance: float | None = None,
        field_of_view: float = FIELD_OF_VIEW,
    ) -> "Camera":
        """Make a camera that looks from a direction.

        Args:
            azimuth: of the direction toward the camera, from x toward y [degree], from -360 to 360.
            elevation: above the horizontal [degree], from -90 to 90; raised where uneven ground would hide the bodies
                of a camera without a distance.
            look_at: (3,) the point in the middle of the picture [m]; None for the middle of the moving bodies.
            distance: from that point [m], > 0; None for one at which the moving bodies fill the picture.
            field_of_view: vertical angle [degree], from 1 to 150.

        Raises:
            ValueError: A value is outside its range.
        """
        return cls(None, look_at, field_of_view, azimuth, elevation, distance)

    @classmethod
    def follow(
        cls,
        body: str | int,
        azimuth: float = AZIMUTH,
        elevation: float = ELEVATION,
        *,
        distance: float | None = None,
        field_of_view: float = FIELD_OF_VIEW,
    ) -> "Camera":
        """Make a camera that moves with a body, and does not turn with it.

        Args:
            body: name or index of the body.
            azimuth: of the direction toward the camera, from x toward y [degree], from -360 to 360.
            elevation: above the horizontal [degree], from -90 to 90.
            distance: from the middle of the body [m], > 0; None for one at which the body fills a third of the picture.
            field_of_view: vertical angle [degree], from 1 to 150.

        Raises:
            ValueError: A value is outside its range.
        """
        return cls(None, None, field_of_view, azimuth, elevation, distance, _body(body))

    def __str__(self) -> str:
        """Return the text from which `--camera` makes this camera, such as "azimuth=-75 elevation=16"."""
        if self.position is not None:
            names = ["position", "look_at", "field_of_view"]
        else:
            names = ["body", "look_at", "azimuth", "elevation", "distance", "field_of_view"]
        values = {name: getattr(self, name) for name in names}
        return " ".join(
            f"{'follow' if name == 'body' else name}={_text(value)}"
            for name, value in values.items()
            if value is not None and (name in ("azimuth", "elevation") or value != getattr(Camera, name))
        )


def with_body_index(camera: Any, names: Sequence[str]) -> Camera:
    """The camera with the index of the body that it follows.

    Args:
        camera: the camera.
        names: of the bodies of the scene.

    Raises:
        ValueError: It is no camera, or there is no such body.
    """
    instance_of("camera", camera, Camera, "a Camera")
    if camera.body is None or (isinstance(camera.body, int) and camera.body < len(names)):
        return camera
    if camera.body in names:
        return replace(camera, body=list(names).index(str(camera.body)))
    if isinstance(camera.body, str) and camera.body.isdigit() and int(camera.body) < len(names):
        return replace(camera, body=int(camera.body))
    near = suggestion(camera.body, names, "scene.bodies" if len(names) > MOST_LISTED else "")
    raise ValueError(f"camera: there is no body {shown(camera.body)} to follow{near}")


def camera_of_text(text: str) -> Camera:
    """The camera that a text describes, such as "position=3,0,2 look_at=0,0,0.5" or "follow=ball distance=2".

    Raises:
        ValueError: The text has another form, or as Camera.
    """
    known = ["follow", *(entry.name for entry in fields(Camera) if entry.name != "body")]
    values: dict[str, Any] = {}
    for part in text.split():
        name, _, value = part.partition("=")
        if name not in known:
            raise ValueError(f"camera: unknown value {shown(name)}{suggestion(name, known)}")
        if not value:
            raise ValueError(f"camera: must be NAME=VALUE with spaces between them, got {shown(part)}")
        if name in values:
            raise ValueError(f"camera: {name} is given twice")
        values[name] = value if name == "follow" else _numbers(name, value)
    body = values.pop("follow", None)
    return Camera(**values, body=body)


def _numbers(name: str, text: str) -> Any:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"camera: {name} must be numbers with commas between them, got {shown(text)}") from None
    return numbers[0] if len(numbers) == 1 else tuple(numbers)


def _text(value: Any) -> str:
    return ",".join(repr(part) for part in value) if isinstance(value, tuple) else str(value)


def _body(value: Any) -> str | int:
    """Check the name or the index of a body."""
    is_index = isinstance(value, int) and not isinstance(value, bool) and value >= 0
    if not is_index and not (isinstance(value, str) and value):
        raise ValueError(f"body: must be the name or the index of a body, got {shown(value)}")
    return value
