"""How a film is written as USD."""

from dataclasses import dataclass
from pathlib import Path

from warp_rigid.checks import one_of
from warp_rigid.render.appearance import COLORINGS
from warp_rigid.runs.recording import Recording

__all__ = ["LAYOUTS", "MOST_IN_SCENE", "PROFILES", "SUFFIXES", "UsdOptions"]

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
PROFILES = ("auto", "animation", "scene")
LAYOUTS = ("single", "payloads", "clips")
MOST_IN_SCENE = 2000
"""Up to so many bodies in all environments are written as a scene with physics unless told otherwise."""


@dataclass(frozen=True)
class UsdOptions:
    """How a film is written.

    Attributes:
        profile: "animation" (one PointInstancer for each shape, no physics), "scene" (one prim for each body, with
            UsdPhysics) or "auto": a scene up to MOST_IN_SCENE bodies.
        color: what a body's colour tells: one of COLORINGS.
        layout: "single" (one file), "payloads" (one file for each environment, which viewers load on demand) or
            "clips" (one file for each stretch of time: neither writer nor reader needs to hold the whole film).
        contacts: whether contact points and impulses are drawn.
        velocities: whether instances carry velocities, for motion blur.

    Raises:
        ValueError: A value is unknown, or two do not go together.
    """

    profile: str = "auto"
    color: str = "body"
    layout: str = "single"
    contacts: bool = False
    velocities: bool = False

    def __post_init__(self):
        """Check the words."""
        one_of("profile", self.profile, PROFILES)
        one_of("color", self.color, COLORINGS)
        one_of("layout", self.layout, LAYOUTS)
        if self.velocities and self.profile == "scene":
            raise ValueError("velocities: only instances carry them; profile must be animation, not scene")

    def check_path(self, path: Path) -> None:
        """Refuse another ending, or one that cannot hold several files."""
        if path.suffix not in SUFFIXES:
            raise ValueError(f"path: must end in one of {', '.join(SUFFIXES)}, got {path}")
        if path.suffix == ".usdz" and self.layout != "single":
            raise ValueError(f"layout: a .usdz is one file; {self.layout} needs .usdc or .usda")

    def check_film(self, film: Recording) -> None:
        """Refuse what was not recorded."""
        if film.scene is None and (self.profile == "scene" or self.contacts):
            name = "contacts" if self.contacts else "profile"
            raise ValueError(f"{name}: a recording that was read from a file has no masses and materials")
        if film.contacts is None and self.contacts:
            raise ValueError("contacts: were not recorded; record them with contacts=True")
        if film.linear_velocity is None and (self.velocities or self.color == "speed"):
            wanted = "velocities" if self.velocities else "color: speed needs velocities, which"
            raise ValueError(f"{wanted}: were not recorded; record them with velocities=True")

    def chosen_profile(self, film: Recording, num_envs: int) -> str:
        """The profile, "auto" decided."""
        if self.profile != "auto":
            return self.profile
        small = num_envs * len(film.motion) <= MOST_IN_SCENE
        return "scene" if small and film.scene is not None and not self.velocities else "animation"
