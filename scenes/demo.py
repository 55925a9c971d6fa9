"""The parts of a built-in scene, and measurements that several scenes share."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from warp_rigid.rotations import inverse, rotate
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes.sampling import SampleKind

ONE_PASS_2003 = {"shock_propagation": "one_pass", "warm_starting": False}
"""The method of 2003: one pass of shock propagation, no warm starting."""

OFF_2003 = {"shock_propagation": "off", "warm_starting": False}
"""The method of 2003 without shock propagation."""

AT_REST = 0.05
"""Speed below which a body counts as resting [m/s], of every point of it."""

LASTING = 0.25
"""Time for which an overlap must last to count as lasting [s]: an impact overlaps for a few steps."""

SOUND = {"default": True}
"""What is expected of a condition where nothing else is said: that it holds with the default settings."""

SCALES = {"mm": 1e3, "%": 100.0}
"""Factors from SI units to units of conditions; 1 for the others."""
SI_UNITS = {"mm": "m", "%": ""}
"""SI units of the units of SCALES."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """One measured quantity of a run, and whether it meets its condition if it has one.

    Attributes:
        name: of the quantity, one word, used as the name of a table column.
        values: (envs,) measured values; booleans if the quantity is that the condition holds.
        limit: the condition as text, with its unit; "" for none.
        passed: (envs,) bool, whether the condition holds; None without a condition.
        expected: for variants of the demo by name, whether the condition must hold. Variants that are not listed
            have no expectation. SOUND if not given.
        unit: in which the values are shown, that of the condition; `values` are in SI units nevertheless.
    """

    name: str
    values: np.ndarray
    limit: str = ""
    passed: np.ndarray | None = None
    expected: dict[str, bool] = field(default_factory=SOUND.copy)
    unit: str = ""


def shown_value(value: float, unit: str) -> str:
    """A value of a verdict as text, in the unit of its condition."""
    return f"{SCALES.get(unit, 1.0) * value:.3g}" + (f" {unit}" if unit else "")


class Outcome(Protocol):
    """Measures a run: `observe` once per frame, then `verdicts` at the end.

    Both only read the simulator. Verdicts on moments that the run has not reached are left out.
    """

    def observe(self, sim: Any) -> None:
        """Record the state at this frame."""

    def verdicts(self, sim: Any) -> list[Verdict]:
        """Judge the recorded and the present state."""


def no_events(scene: Scene) -> list[tuple[float, Callable[[Any], None]]]:
    """No events."""
    return []


@dataclass(frozen=True)
class Demo:
    """A built-in scene: how it is built, run and judged.

    Attributes:
        name: argument of `load`.
        summary: one line of description.
        build: function(**parameters) -> Scene; every parameter has a default.
        outcome: function(scene) -> Outcome.
        duration: default duration of a run, after which all verdicts are available [s].
        variants: settings to compare, by name; each lists the differences from `Settings()`. A comparison runs each
            variant in one environment of one simulator. "default" is the first, and the only one where none are given.
        events: function(scene) -> list of (time [s], function(sim)); a run calls each function when it reaches that
            simulated time. The function may return the event that follows it.
        settings: differences from `Settings()` that all variants of this scene need.
        vary: function(sim, **parameters) that gives each environment of a batch a different start; None if all
            environments start alike. A run that compares settings does not call it.
        goes_with: for settings by name and value, further settings that a sweep over that setting applies unless it
            sets them itself, so that the typical effect of the value shows in this scene.
    """

    name: str
    summary: str
    build: Callable[..., Scene]
    outcome: Callable[[Scene], Outcome]
    duration: float
    variants: dict[str, dict[str, Any]] = field(default_factory=lambda: {"default": {}})
    events: Callable[[Scene], list[tuple[float, Callable[[Any], None]]]] = no_events
    settings: dict[str, Any] = field(default_factory=dict)
    vary: Callable[..., None] | None = None
    goes_with: dict[str, dict[Any, dict[str, Any]]] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters of `build` with their defaults."""
        known = inspect.signature(self.build).parameters
        return {name: parameter.default for name, parameter in known.items()}


def shown_settings(changes: dict[str, Any]) -> str:
    """What a variant sets, as text."""
    return ", ".join(f"{name}={value}" for name, value in changes.items()) or "changes nothing"


def start_apart(sim: Any, bodies: list[int], starts: Callable[[int], tuple[np.ndarray, ...]]) -> None:
    """Give each environment a different start.

    Args:
        sim: the simulator.
        bodies: indices of the bodies that are set.
        starts: returns for an environment's index the positions [m], the orientations and, optionally, the linear
            velocities [m/s] of these bodies.
    """
    columns = zip(*(starts(env) for env in range(sim.num_envs)), strict=True)
    for name, values in zip(("position", "orientation", "linear_velocity"), columns, strict=False):
        sim.set(name, np.array(values), bodies=bodies)


def vary_starts(prefix: str, starts: Callable[..., tuple[np.ndarray, ...]]) -> Callable[..., None]:
    """A `vary` of Demo: environment e gets the starts of the scene with seed + e. Shapes are those of environment 0.

    Args:
        prefix: of the names of the bodies that are set.
        starts: function of `seed` and other parameters of the scene that returns the starts, as for `start_apart`.
    """
    others = set(inspect.signature(starts).parameters) - {"seed"}

    def vary(sim: Any, seed: int, **parameters: Any) -> None:
        given = {name: parameters[name] for name in others}
        start_apart(sim, indices(sim.scene, prefix), lambda env: starts(seed=seed + env, **given))

    return vary


def indices(scene: Scene, prefix: str) -> list[int]:
    """Indices of the bodies whose name begins with `prefix`, in the scene's order."""
    return [i for i, body in enumerate(scene.bodies) if body.name.startswith(prefix)]


def clearance(sim: Any, first: int, second: int) -> np.ndarray:
    """Smallest signed distance between the surfaces of two bodies, (envs,) [m]; negative inside.

    Computed from the samples of either body in the signed distance of the other, in float64 on the host,
    independently of the simulator's contacts.
    """
    position = sim.get("position").astype(np.float64)
    orientation = sim.get("orientation").astype(np.float64)
    smallest = np.full(len(position), np.inf)
    for a, b in ((first, second), (second, first)):
        samples, target = sim.scene.bodies[a].shape.samples(), sim.scene.bodies[b].shape
        # The middle and one end of each edge segment; its other end belongs to the next segment or is a vertex.
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


def above_heightfield(sim: Any, bodies: list[int], half: float, time: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Heights of bodies above the height field of body 0 at a time [m], and whether they are above it, (envs, bodies).

    Bodies outside a square of half a width [m], and those whose position is NaN, are not above it.
    """
    place = sim.get("center_of_mass")[:, bodies]
    ground = sim.scene.bodies[0].shape.height_at(place[..., :2].reshape(-1, 2), time)
    height = place[..., 2] - ground.reshape(place.shape[:2])
    return height, (height > 0.0) & (np.abs(place[..., :2]).max(axis=-1) < half)


def outside(sim: Any, bodies: list[int], half: float) -> np.ndarray:
    """Whether bodies are below z = 0 or outside a square of half a width [m], (envs, bodies); true where NaN."""
    place = sim.get("center_of_mass")[:, bodies]
    return ~((np.abs(place[..., :2]).max(axis=-1) < half) & (place[..., 2] > 0.0))


def below(
    name: str, values: np.ndarray, limit: float, text: str, expected: dict[str, bool] = SOUND, unit: str = "mm"
) -> Verdict:
    """Verdict: the values are below `limit`; NaN is not."""
    return Verdict(name, values, text, values < limit, expected, unit)


class SceneOutcome:
    """Base of the outcomes of the built-in scenes.

    Attributes:
        prefix: of the names of the bodies that a scene judges.
        bodies: their indices.
        start: (bodies, 3) their positions at the start [m].
        largest: values of `keep_largest` by their names, (envs,).
    """

    prefix = "body_"

    def __init__(self, scene: Scene) -> None:
        """Find the bodies."""
        self.bodies = indices(scene, self.prefix)
        self.start = np.array([scene.bodies[i].position for i in self.bodies]).reshape(-1, 3)
        self.largest: dict[str, np.ndarray] = {}

    def observe(self, sim: Any) -> None:
        """Record nothing: the final state is enough."""

    def keep_largest(self, **values: np.ndarray) -> None:
        """Keep the largest values (envs,) of all frames by their names."""
        for name, now in values.items():
            self.largest[name] = np.maximum(self.largest.get(name, now), now)

    def displacement(self, sim: Any) -> np.ndarray:
        """Distance of each body from its start, (envs, bodies) [m]."""
        return np.linalg.norm(sim.get("position")[:, self.bodies] - self.start, axis=-1)

    def verdicts(self, sim: Any) -> list[Verdict]:
        """Those of `judge`, once a value was kept."""
        return self.judge(sim) if self.largest else []

    def judge(self, sim: Any) -> list[Verdict]:
        """Judge the kept values and the present state."""
        raise NotImplementedError


class OverlapOutcome(SceneOutcome):
    """Base of the outcomes that judge the overlap of the whole film.

    Attributes:
        recent: (time, deepest overlap of each environment) of the frames within LASTING [s, m].
        lasting: deepest overlap that lasted for LASTING [m].
        deepest: deepest overlap at any time [m].
    """

    recent: tuple = ()
    lasting: Any = 0.0
    deepest: Any = 0.0

    def observe(self, sim: Any) -> None:
        """Record the overlap at this frame."""
        now, time = sim.penetration(), float(sim.time)
        before = (frame for frame in self.recent if time - LASTING - 1e-6 < frame[0] < time)
        self.recent = (*before, (time, now))
        self.deepest = np.maximum(self.deepest, now)
        if time - self.recent[0][0] > LASTING - 1e-6:
            self.lasting = np.maximum(self.lasting, np.min([overlap for _, overlap in self.recent], axis=0))

    def overlap_verdicts(self, sim: Any, lasting: float, deepest: float) -> list[Verdict]:
        """Verdicts: no overlap exceeds `lasting` [m] now or for LASTING, and none ever exceeds `deepest` [m]."""
        now = sim.penetration()
        text = f"overlap < {1e3 * lasting:g} mm at the end, and never more for {LASTING:g} s"
        at_any_time = f"overlap < {1e3 * deepest:g} mm at any time"
        return [
            below("overlap", np.maximum(self.lasting, now), lasting, text),
            below("deepest", np.maximum(self.deepest, now), deepest, at_any_time),
        ]

    def settled_verdicts(self, sim: Any, lasting: float, deepest: float) -> list[Verdict]:
        """Verdicts: all bodies are at rest now with a contact for each, and those of `overlap_verdicts`."""
        count = len(self.bodies)
        resting = (surface_speed(sim, self.bodies) < AT_REST).sum(axis=1)
        contacts = np.bincount(sim.contacts()["env"], minlength=sim.num_envs)
        text = f"all {count} bodies at rest at the end, no point faster than {AT_REST:g} m/s"
        return [
            Verdict("resting", resting, text, resting == count),
            Verdict("contacts", contacts, "at least one contact per body at the end", contacts >= count),
            *self.overlap_verdicts(sim, lasting, deepest),
        ]


def surface_speed(sim: Any, bodies: list[int]) -> np.ndarray:
    """Upper bound of the speed of all points of each body, (envs, bodies) [m/s]."""
    linear = np.linalg.norm(sim.get("linear_velocity")[:, bodies], axis=-1)
    spin = np.linalg.norm(sim.get("angular_velocity")[:, bodies], axis=-1)
    shapes = [sim.scene.bodies[i].shape for i in bodies]
    radius = {shape: np.linalg.norm(shape.surface()[0] - shape.center_of_mass, axis=1).max() for shape in set(shapes)}
    return linear + spin * np.array([radius[shape] for shape in shapes])


def rest_verdict(sim: Any, bodies: list[int]) -> Verdict:
    """Verdict: no point of a body moves faster than AT_REST now."""
    speed = surface_speed(sim, bodies).max(axis=1)
    return below("speed", speed, AT_REST, f"no point faster than {AT_REST:g} m/s at the end", unit="m/s")
