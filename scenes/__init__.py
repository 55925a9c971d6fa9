"""The built-in scenes: `names` lists them, `load` builds one, `get` returns how one is run and judged."""

from functools import cache
from importlib import import_module
from typing import Any

from warp_rigid.checks import shown, suggestion
from warp_rigid.scene.scene import Scene
from warp_rigid.scenes.demo import Demo, Outcome, Verdict, no_events

__all__ = ["Demo", "Outcome", "Verdict", "get", "load", "names"]

_NAMES = (
    "box_stack",
    "leaning_tower",
    "incline",
    "plank_launch",
    "seesaw",
    "skull_and_brain",
    "showcase",
    "terrain",
    "carpet",
    "planet",
    "rings_on_poles",
    "bone_pile",
    "bunny_pile",
    "domino_spiral",
    "balance_bird",
    "nut_and_bolt",
    "wrecking_ball",
    "chain",
    "pallet",
    "cradle",
    "ragdolls",
    "linkages",
    "bridge",
    "crane",
    "demolition",
    "sorting_line",
)
"""Files of this folder, which are imported when they are needed.

The first line of each is its summary. Each defines DURATION, `build` and `outcome`, and where it needs them VARIANTS,
SETTINGS, GOES_WITH and the functions `events` and `vary`: the attributes of a Demo.
"""


def names() -> list[str]:
    """Names of the built-in scenes."""
    return list(_NAMES)


def get(name: str) -> Demo:
    """A built-in scene by its name.

    Raises:
        ValueError: There is no such scene.
    """
    if name not in _NAMES:
        known = suggestion(name, _NAMES, "warp-rigid scenes")
        raise ValueError(f"scene: must be a built-in scene, got {shown(name)}{known}")
    return _demo(name)


@cache
def _demo(name: str) -> Demo:
    module = import_module(f"{__name__}.{name}")
    sentence = (module.__doc__ or " ").partition("\n")[0]
    return Demo(
        name,
        sentence[0].lower() + sentence[1:].removesuffix("."),
        module.build,
        module.outcome,
        module.DURATION,
        {"default": {}} | getattr(module, "VARIANTS", {}),
        getattr(module, "events", no_events),
        getattr(module, "SETTINGS", {}),
        getattr(module, "vary", None),
        getattr(module, "GOES_WITH", {}),
    )


def load(name: str, **parameters: Any) -> Scene:
    """Build a built-in scene.

    Args:
        name: one of `names()`.
        **parameters: those of `get(name).parameters`; the others keep their defaults.

    Raises:
        ValueError: There is no such scene or parameter, or a value is out of its range.
        FileNotFoundError: A value is the path of a file that does not exist.
    """
    demo = get(name)
    for parameter in parameters:
        if parameter not in demo.parameters:
            known = ", ".join(demo.parameters)
            raise ValueError(f"{parameter}: no parameter of {name}, which has {known}")
    return demo.build(**parameters)
