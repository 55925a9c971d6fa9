"""Settings of the method. Every one except the time step can differ from environment to environment."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from warp_rigid.checks import number_in, one_of, shown, whole_in
from warp_rigid.kernels.enums import ShockMode

SHOCK_MODES = tuple(mode.name.lower() for mode in ShockMode)
MOST_ITERATIONS = 10_000
SHORTEST = 1e-9
"""Shortest time step [s]; the squares of shorter ones are lost in single precision."""


@dataclass(frozen=True)
class Settings:
    """Settings of the solver; all but dt can differ between environments.

    Attributes:
        dt: time step [s].
        collision_iterations: largest number of sweeps over impacts with restitution.
        contact_iterations: largest number of solver sweeps over contacts, half of them before and half after shock
            propagation; the numbers of rounds are proportional to it. In piles that move, which are solved without
            shock propagation, two more sweeps follow for each body on the shortest path to the ground. Structures that
            hardly move, such as an arch, are swept further until they converge: up to this number for each body, at
            most 30 times; structures that topple, up to six times this number. Piles of masses that differ by more
            than 4 : 1 are treated in the same way. `Simulator.stats` reports the sweeps.
        shock_iterations: repetitions of shock propagation.
        shock_propagation: "off", "one_pass" (Guendelman et al. 2003) or "two_pass" (with a line search, the default).
        collision_first: True solves impacts before the velocity update (as Guendelman et al.). False, for comparison,
            solves them after it: resting bodies with restitution hop, and rolling friction does not act on them.
        warm_starting: True starts from the impulses of the last step, False from zero (as Guendelman et al.).
        edge_samples: whether edges generate contacts; False uses only vertices, faces and balls.
        sleeping: whether islands at rest fall asleep; they then cost little until one of their bodies is disturbed.
    """

    dt: float = 1.0 / 240.0
    collision_iterations: int = 5
    contact_iterations: int = 10
    shock_iterations: int = 1
    shock_propagation: str = "two_pass"
    collision_first: bool = True
    warm_starting: bool = True
    edge_samples: bool = True
    sleeping: bool = False

    def __post_init__(self) -> None:
        """Refuse values out of range, each in one line."""
        object.__setattr__(self, "dt", number_in("dt", self.dt, SHORTEST, 1.0))
        for name in PER_ENVIRONMENT:
            check_setting(name, getattr(self, name))


PER_ENVIRONMENT = tuple(field.name for field in fields(Settings) if field.name != "dt")
"""Names of the settings that can differ between environments."""


def check_settings(settings: Any) -> Settings:
    """Check that a simulator is given one Settings, and return it; None is the default."""
    if settings is None:
        return Settings()
    if not isinstance(settings, Settings):
        raise ValueError(
            f"settings: must be one Settings for all environments, got {shown(settings)}; all but dt are set per "
            "environment with Simulator.set"
        )
    return settings


def check_setting(name: str, value: Any) -> int:
    """Check one per-environment setting and return it as the device stores it."""
    if name == "shock_propagation":
        return SHOCK_MODES.index(one_of(name, value, SHOCK_MODES))
    if name.endswith("_iterations"):
        return whole_in(name, value, 0, MOST_ITERATIONS)
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name}: must be True or False, got {shown(value)}")
    return int(value)


def setting_from_device(name: str, values: np.ndarray) -> np.ndarray:
    """Turn stored numbers into what the user gave: mode names, whole numbers or booleans."""
    if name == "shock_propagation":
        return np.array(SHOCK_MODES)[values]
    return values if name.endswith("_iterations") else values.astype(bool)
