"""Look: what the surface of a body looks like, as plain data."""

from dataclasses import dataclass

from warp_rigid.checks import finite_vector, number_in, whole_in


@dataclass(frozen=True)
class Look:
    """Visible surface of a body, as UsdPreviewSurface describes it.

    Attributes:
        color: (3,) linear RGB from 0 to 1; None for the colour that bodies have by their index.
        roughness: 0 for a mirror to 1 for a matt surface.
        metallic: 0 for others to 1 for metals, whose reflections have their colour.

    Raises:
        ValueError: A value is outside its range.
    """

    color: tuple[float, float, float] | None = None
    roughness: float = 0.5
    metallic: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        if self.color is not None:
            color = finite_vector("color", self.color)
            object.__setattr__(self, "color", tuple(number_in("color", part, 0.0, 1.0) for part in color))
        for name in ("roughness", "metallic"):
            object.__setattr__(self, name, number_in(name, getattr(self, name), 0.0, 1.0))


def looks_to_data(looks: dict[int, Look]) -> list[list]:
    """Looks of bodies by index as plain data."""
    return [[body, look.color, look.roughness, look.metallic] for body, look in sorted(looks.items())]


def looks_from_data(data: list[list], bodies: int) -> dict[int, Look]:
    """The looks that `looks_to_data` was called with.

    Raises:
        ValueError, TypeError: The data do not have that form.
    """
    return {whole_in("body", body, 0, bodies - 1): Look(*values) for body, *values in data}
