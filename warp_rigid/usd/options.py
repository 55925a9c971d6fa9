"""Options of the USD export."""

from dataclasses import dataclass
from pathlib import Path

from warp_rigid.checks import one_of, shown
from warp_rigid.files.mesh_files import USD_SUFFIXES
from warp_rigid.render.appearance import COLORINGS
from warp_rigid.runs.recording import Recording

PROFILES = ("auto", "animation", "scene")
LAYOUTS = ("single", "payloads", "clips", "override")
MAX_SCENE_BODIES = 2000
"""Maximum number of bodies in all environments for which the profile "auto" writes a scene with physics."""


@dataclass(frozen=True)
class UsdOptions:
    """Options of the USD export; see export_usd. "auto" is a scene for up to MAX_SCENE_BODIES bodies.

    Raises:
        ValueError: A value is unknown, or two values are incompatible.
    """

    profile: str = "auto"
    color: str = "body"
    layout: str = "single"
    contacts: bool = False
    velocities: bool = False

    def __post_init__(self):
        """Check the values."""
        one_of("profile", self.profile, PROFILES)
        one_of("color", self.color, COLORINGS)
        one_of("layout", self.layout, LAYOUTS)
        if self.velocities and self.profile == "scene":
            raise ValueError("velocities: requires profile animation, since only instances have velocities")

    def check_path(self, path: Path) -> None:
        """Check the suffix, and that it supports the layout."""
        if path.suffix not in USD_SUFFIXES:
            raise ValueError(f"path: must end in one of {', '.join(USD_SUFFIXES)}, got {path}")
        if path.suffix == ".usdz" and self.layout != "single":
            raise ValueError(f"layout: must be single for .usdz, got {self.layout}; use .usdc or .usda")

    def check_film(self, film: Recording) -> None:
        """Check that it is a recording with the required quantities."""
        if not isinstance(film, Recording):
            raise ValueError(f"recording: must be a Recording, as record() returns, got {shown(film)}")
        if film.scene is None and (self.profile == "scene" or self.contacts):
            name = "contacts" if self.contacts else "profile"
            raise ValueError(f"{name}: requires masses and materials, which a recording read from a file lacks")
        if film.contacts is None and self.contacts:
            raise ValueError("contacts: requires recorded contacts; record them with contacts=True")
        if film.linear_velocity is None and (self.velocities or self.color == "speed"):
            option = "velocities" if self.velocities else "color"
            raise ValueError(f"{option}: requires recorded velocities; record them with velocities=True")
