"""What a built-in scene consists of, and the measurements that several of them share."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from warp_rigid.rotations import inverse, rotate
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes.sampling import SampleKind

ONE_PASS_2003 = {"shock_propagation": "one_pass", "warm_starting": False}
"""The method of 2003: one pass of shock propagation, every step from zero impulses."""

OFF_2003 = {"shock_propagation": "off", "warm_starting": False}
"""The same without shock propagation."""

AT_REST = 0.05
"""Speed below which a body counts as come to rest [m/s]."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """One measured quantity of a run and whether it is as it must be.

    Attributes:
        name: what was measured, a word fit for a table's column.
        values: (envs,) float, the measure.
        limit: the condition in words, with its unit.
        passed: (envs,) bool, whether the condition holds.
        expected: for variants of the demo by name, whether the condition holds there. A variant
            that is not named may do either.
    """

    name: str
    values: np.ndarray
    limit: str
    passed: np.ndarray
    expected: dict[str, bool]


class Outcome(Protocol):
    """Measures a run: `observe` once a frame, then `verdicts` at the end.

    Both only read the simulator. A verdict whose moment has not come yet is left out.
    """

    def observe(self, sim: Any) -> None:
        """Take note of the state at this frame."""

    def verdicts(self, sim: Any) -> list[Verdict]:
        """Judge what was observed, and the state now."""


def no_events(scene: Scene) -> list[tuple[float, Callable[[Any], None]]]:
    """Nothing happens from outside."""
    return []


@dataclass(frozen=True)
class Demo:
    """A built-in scene: how it is made, run and judged.

    Attributes:
        name: what `load` calls it.
        summary: one line.
        build: function(**parameters) -> Scene; every parameter has a default.
        outcome: function(scene) -> Outcome.
        duration: how long a run takes to show all [s].
        variants: settings to compare, by name; each is what differs from `Settings()`. They fit
            into one simulator, one environment each. "default" comes first.
        events: function(scene) -> list of (time [s], function(sim)), which a run calls when the
            simulated time reaches them.
        settings: what all variants of this scene need to differ from `Settings()`.
        vary: function(sim, **parameters) that gives each environment of a batch a start of its own; None if all
            start alike. A run that compares settings leaves the starts alike.
        goes_with: for settings by name and value, what a sweep over that setting also sets, unless it is told
            otherwise: what it takes to see in this scene what the value is known for.
    """

    name: str
    summary: str
    build: Callable[..., Scene]
    outcome: Callable[[Scene], Outcome]
    duration: float
    variants: dict[str, dict[str, Any]]
    events: Callable[[Scene], list[tuple[float, Callable[[Any], None]]]] = no_events
    settings: dict[str, Any] = field(default_factory=dict)
    vary: Callable[..., None] | None = None
    goes_with: dict[str, dict[Any, dict[str, Any]]] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters of `build` with their defaults."""
        known = inspect.signature(self.build).parameters
        return {name: parameter.default for name, parameter in known.items()}


def start_apart(sim: Any, prefix: str, starts: Callable[[int], tuple[np.ndarray, ...]]) -> None:
    """Give each environment its own start: `starts(env)` tells position, orientation and, if it likes, velocity."""
    own = indices(sim.scene, prefix)
    columns = zip(*(starts(env) for env in range(sim.num_envs)), strict=True)
    for name, values in zip(("position", "orientation", "linear_velocity"), columns, strict=False):
        sim.set(name, np.array(values), bodies=own)


def indices(scene: Scene, prefix: str) -> list[int]:
    """Indices of the bodies whose name begins with `prefix`, in the scene's order."""
    return [i for i, body in enumerate(scene.bodies) if body.name.startswith(prefix)]


def clearance(sim: Any, first: int, second: int) -> np.ndarray:
    """Smallest signed distance between the surfaces of two bodies, (envs,) [m]; negative inside.

    From the samples of either one in the other's signed distance, in float64 on the host, so that
    a demo does not judge the simulator by its own contacts.
    """
    position = sim.get("position").astype(np.float64)
    orientation = sim.get("orientation").astype(np.float64)
    smallest = np.full(len(position), np.inf)
    for a, b in ((first, second), (second, first)):
        samples, target = sim.scene.bodies[a].shape.samples(), sim.scene.bodies[b].shape
        # The middle of each segment of an edge and its one end: the other is the next one's, or a vertex.
        points = np.concatenate([samples.point, samples.point + samples.slide]).astype(np.float64)
        ball = np.tile(np.where(samples.kind == SampleKind.RIM, 0.0, samples.radius), 2)
        if not len(points):
            continue
        world = rotate(orientation[:, a, None], points[None]) + position[:, a, None]
        back = inverse(orientation[:, b, None])
        local = rotate(back, world - position[:, b, None])
        distance, _ = target.signed_distance(local.reshape(-1, 3))
        smallest = np.minimum(smallest, (distance.reshape(world.shape[:2]) - ball).min(axis=1))
    return smallest


def below(name: str, values: np.ndarray, limit: float, text: str, expected: dict[str, bool]) -> Verdict:
    """That the values are below `limit`; what is not a number is not."""
    return Verdict(name, values, text, values < limit, expected)


def overlap_verdict(sim: Any, limit: float, expected: dict[str, bool]) -> Verdict:
    """That no body is deeper than `limit` [m] inside another now."""
    text = f"overlap < {1e3 * limit:g} mm at the end"
    return below("overlap", sim.penetration(), limit, text, expected)


def rest_verdict(sim: Any, bodies: list[int], expected: dict[str, bool]) -> Verdict:
    """That no body's centre of mass moves faster than AT_REST now."""
    speed = np.linalg.norm(sim.get("linear_velocity")[:, bodies], axis=-1).max(axis=1)
    return below("speed", speed, AT_REST, f"speed < {AT_REST:g} m/s at the end", expected)


def resting_verdict(sim: Any, bodies: list[int], expected: dict[str, bool]) -> Verdict:
    """That all bodies are at rest now: how many are."""
    resting = (np.linalg.norm(sim.get("linear_velocity")[:, bodies], axis=-1) < AT_REST).sum(axis=1)
    text = f"all {len(bodies)} bodies slower than {AT_REST:g} m/s at the end"
    return Verdict("resting", resting, text, resting == len(bodies), expected)


def contacts_verdict(sim: Any, bodies: list[int], expected: dict[str, bool]) -> Verdict:
    """That there are at least as many contacts as bodies now: each body touches something."""
    contacts = np.bincount(sim.contacts()["env"], minlength=sim.num_envs)
    return Verdict("contacts", contacts, "a contact a body or more at the end", contacts >= len(bodies), expected)
