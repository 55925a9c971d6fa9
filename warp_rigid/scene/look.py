"""Look: the appearance of a body's surface, as plain data."""

import os
from dataclasses import dataclass
from typing import Any, Self

from warp_rigid.checks import finite_vector, instance_of, number_in, shown, whole_in


@dataclass(frozen=True)
class Look:
    """Visible surface of a body, as UsdPreviewSurface describes it.

    Attributes:
        color: (3,) linear RGB from 0 to 1; None for a colour chosen by the body's index.
        roughness: 0 for a mirror to 1 for a matt surface.
        metallic: 0 for a dielectric to 1 for a metal, whose reflections have its colour.
        image: path of an image, made absolute; also of one in a package, "film.usdz[image.png]". It replaces the colour
            on meshes with `uv`.

    Raises:
        ValueError: A value is outside its range.
        FileNotFoundError: There is no such image; the message names it.
    """

    color: tuple[float, float, float] | None = None
    roughness: float = 0.5
    metallic: float = 0.0
    image: str | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.color is not None:
            color = finite_vector("color", self.color)
            object.__setattr__(self, "color", tuple(number_in("color", part, 0.0, 1.0) for part in color))
        for name in ("roughness", "metallic"):
            object.__setattr__(self, name, number_in(name, getattr(self, name), 0.0, 1.0))
        if self.image is not None:
            image: object = self.image
            if not isinstance(image, str | os.PathLike) or not os.fspath(image):
                raise ValueError(f"image: must be the path of a file, got {shown(image)}")
            path = os.path.abspath(os.fspath(image))
            if not os.path.isfile(file_of_image(path)):
                raise FileNotFoundError(f"image: no such file: {path}")
            object.__setattr__(self, "image", path)

    @classmethod
    def from_data(cls, color: Any, roughness: float, metallic: float, image: str | None = None) -> Self:
        """A saved look, whose image may be elsewhere now.

        Raises:
            ValueError: A value is outside its range.
        """
        look = cls(color, roughness, metallic)
        instance_of("image", image, str | None, "the path of a file")
        object.__setattr__(look, "image", image)
        return look


def file_of_image(path: str) -> str:
    """The file with an image: the path itself, or that of a package, "film.usdz[image.png]"."""
    return path.split("[")[0] if path.endswith("]") else path


def check_looks(name: str, looks: Any, bodies: int) -> None:
    """Check that each look belongs to one of the bodies, by its index.

    Raises:
        ValueError: One does not, or is no Look; the message begins with `name`.
    """
    instance_of(name, looks, dict, "a dictionary of Look by the index of the body")
    for body, look in looks.items():
        whole_in(f"{name}: index of a body", body, 0, bodies - 1)
        instance_of(f"{name}[{body}]", look, Look, "a Look")


def looks_to_data(looks: dict[int, Look]) -> list[list]:
    """Looks of bodies by index as plain data."""
    return [[body, look.color, look.roughness, look.metallic, look.image] for body, look in sorted(looks.items())]


def looks_from_data(data: list[list], bodies: int) -> dict[int, Look]:
    """The looks that `looks_to_data` was called with.

    Raises:
        ValueError, TypeError: The data do not have that form.
    """
    return {whole_in("body", body, 0, bodies - 1): Look.from_data(*values) for body, *values in data}
