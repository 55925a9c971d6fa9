"""Section L: mechanisms without drives keep their energy, and pendulums their period."""

from collections.abc import Callable
from functools import partial
from itertools import combinations

import numpy as np

from warp_rigid import rotations
from warp_rigid.kernels.enums import Coordinate
from warp_rigid.scene.joints import DistanceJoint, SphericalJoint
from warp_rigid.scene.scene import Scene
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes import linkages
from warp_rigid.validation.articulated import exact_period, pendulum, period_of
from warp_rigid.validation.case import Cases, Check, ValidationCase, at_most, case, measured, relative
from warp_rigid.validation.common import G
from warp_rigid.validation.experiment import Experiment, Trace

ANGLES = (10.0, 90.0, 150.0, 178.0)
"""Angles from which a pendulum is let go [degrees]."""
RATES = (60, 240, 120, 480)
"""Steps per second; the first two for the whole time."""
SHORT = 10.0
"""Time of the loss of energy, and of long chains [s]."""


def cases(quick: bool) -> Cases:
    """All cases of the section; for a shorter time and with fewer steps if quick."""
    duration, rates = (SHORT, RATES[:2]) if quick else (120.0, RATES)
    return [pendulums(duration, rates), mechanisms(duration, rates, 5 if quick else 50)]


def rows_of(trace: Trace) -> np.ndarray:
    """Velocities that the joints prevent, as coefficients of the bodies' velocities, (records, rows, 6 bodies).

    A joint prevents relative motion of its point along axes of its second frame, and rotation about them; a distance
    prevents that along its line. One environment.
    """
    place, orientation, center = (values[:, 0] for values in (trace.position, trace.orientation, trace.center))
    rows = []
    for entry in trace.scene.joints:
        points = entry.anchors(place, orientation)
        frame = np.array(entry.frame_b.orientation)
        frame = frame if entry.body_b is None else rotations.multiply(orientation[:, entry.body_b], frame)
        axes = np.swapaxes(np.broadcast_to(rotations.matrix(frame), (len(place), 3, 3)), 1, 2)
        prevented = [k for k in range(6) if entry.joint.locked >> k & 1]
        if entry.joint.coordinate == Coordinate.LENGTH:
            line = points[0] - points[1]
            axes, prevented = (line / np.linalg.norm(line, axis=-1, keepdims=True))[:, None], [0]
        for k in prevented:
            row = np.zeros((len(place), len(trace.scene.bodies), 6))
            axis = axes[:, k % 3]
            for body, sign in ((entry.body_a, 1.0), (entry.body_b, -1.0)):
                if body is not None:
                    row[:, body, :3] += sign * axis if k < 3 else 0.0
                    row[:, body, 3:] += sign * (np.cross(points[0] - center[:, body], axis) if k < 3 else axis)
            rows.append(row.reshape(len(place), -1))
    return np.stack(rows, axis=1)


def energy_at_pose(trace: Trace, since: float) -> np.ndarray:
    """Kinetic and potential energy with the velocities at each pose, (records,) [J]. One environment.

    Velocities of a record belong to a time up to half a step earlier. Those at the pose have, besides, the acceleration
    of gravity over the time `since` then [s], and what the joints prevent removed (Leimkuhler and Reich 2004, RATTLE).
    """
    count = len(trace.scene.bodies)
    rotation = trace.rotation[:, 0]
    mass = np.zeros((len(rotation), count, 6, 6))
    mass[:, :, :3, :3] = trace.mass[0][:, None, None] * np.eye(3)
    mass[:, :, 3:, 3:] = rotation @ trace.inertia[0] @ np.swapaxes(rotation, -1, -2)
    momentum_free = np.linalg.inv(mass)
    velocity = np.concatenate(
        [trace.linear_velocity[:, 0] + since * trace.gravity[0], trace.angular_velocity[:, 0]], -1
    )
    rows = rows_of(trace)
    change = np.einsum("nbij,nrbj->nrbi", momentum_free, rows.reshape(len(rows), -1, count, 6)).reshape(rows.shape)
    matrix = rows @ np.swapaxes(change, 1, 2)
    speeds = (rows @ velocity.reshape(len(rows), -1, 1))[..., 0]
    impulse = np.linalg.pinv(matrix, rcond=1e-10, hermitian=True) @ speeds[..., None]
    velocity = velocity - (np.swapaxes(change, 1, 2) @ impulse)[..., 0].reshape(velocity.shape)
    kinetic = 0.5 * np.einsum("nbi,nbij,nbj->n", velocity, mass, velocity)
    return kinetic - np.einsum("b,nbi,i->n", trace.mass[0], trace.center[:, 0], trace.gravity[0])


def change_of_energy(trace: Trace) -> np.ndarray:
    """Energy less that at the start over m g L for the whole length L, (records,); at least so much is there.

    The smaller one of the energies with velocities of half a step before the pose, and of the pose. They are equal
    whenever the centre of mass is at its lowest or highest point.
    """
    energy = np.minimum(energy_at_pose(trace, 0.0), energy_at_pose(trace, 0.5 * trace.experiment.dt))
    length = np.linalg.norm(trace.center[0, 0], axis=-1).max()
    return (energy - energy[0]) / (trace.mass.sum() * G * length)


def largest_gain(trace: Trace) -> list[float]:
    """Largest gain of energy at any time."""
    return [max(change_of_energy(trace).max(), 0.0)]


def loss(trace: Trace) -> list[float]:
    """Loss of energy in `SHORT`: the smallest in the last second."""
    last = (trace.time > SHORT - 1.0) & (trace.time <= SHORT)
    return [max(-change_of_energy(trace)[last].max(), 0.0)]


def pendulums(duration: float, rates: tuple[int, ...]) -> ValidationCase:
    """Period and energy of a pendulum that is let go at up to 178 degrees."""
    options = [(angle, rate) for angle in ANGLES for rate in rates]
    experiments = tuple(
        Experiment(
            partial(pendulum, angle), _time(duration, rate), dt=1.0 / rate, label=f"{angle:g} degrees, 1/{rate} s"
        )
        for angle, rate in options
    )
    near_top = [k for k, option in enumerate(options) if option[0] == ANGLES[-1]]
    groups = (([k for k in range(len(options)) if k not in near_top], 1e-3), (near_top, 1e-2))
    exact = [exact_period(angle) for angle, _ in options]
    checks = [
        measured("period", "s", period_of, relative(tolerance), [exact[k] for k in rows], rows)
        for rows, tolerance in groups
    ]
    source = "arithmetic-geometric mean; conservation of energy"
    return case("V102 Pendulums", source, *checks, *_kept(experiments), of=experiments)


def mechanisms(duration: float, rates: tuple[int, ...], links: int) -> ValidationCase:
    """Energy of a double pendulum, chains and closed loops, all let go from rest."""
    scenes: list[tuple[str, Callable[[], Scene], float]] = [
        ("double pendulum", double_pendulum, duration),
        ("chain of 5", partial(chain, 5), duration),
        ("four-bar linkage", four_bar, duration),
        ("slider-crank", slider_crank, duration),
    ]
    if links > 5:
        scenes.append((f"chain of {links}", partial(chain, links), SHORT))
    experiments = tuple(
        Experiment(scene, _time(time, rate), dt=1.0 / rate, every=rate // RATES[0], label=f"{name}, 1/{rate} s")
        for name, scene, time in scenes
        for rate in rates
    )
    title = f"Double pendulum, chains of up to {links}, closed loops"
    return case(f"V102 {title}", "conservation of energy", *_kept(experiments), of=experiments)


def _time(duration: float, rate: int) -> float:
    """Time to simulate with so many steps per second [s]."""
    return duration if rate in RATES[:2] else SHORT


def _kept(experiments: tuple[Experiment, ...]) -> tuple[Check, ...]:
    """Checks that no mechanism gains energy, and that none loses much in `SHORT` with the default step."""
    default = [k for k, experiment in enumerate(experiments) if round(experiment.dt * 240) == 1]
    return (
        measured("largest gain of energy", "m g L", largest_gain, at_most(1e-3)),
        measured("loss of energy in 10 s", "m g L", loss, at_most(0.03), rows=default),
    )


def double_pendulum() -> Scene:
    """Two balls of 1 kg on rods of 1 m without mass, let go in a horizontal line."""
    scene = Scene(gravity=(0, 0, -G))
    above, at = None, (0.0, 0.0, 0.0)
    for k in (1.0, 2.0):
        ball = scene.add_body(Sphere(0.01), position=(k, 0, 0), mass=1.0)
        scene.add_joint(DistanceJoint(1.0, 1.0), ball, above, anchor=(k, 0, 0), anchor_b=at)
        above, at = ball, (k, 0.0, 0.0)
    return scene


def chain(links: int) -> Scene:
    """Rods of 0.2 m on ball joints, let go in a horizontal line."""
    scene = Scene(gravity=(0, 0, -G))
    above = None
    for k in range(links):
        link = scene.add_body(Box((0.1, 0.01, 0.01)), position=(0.2 * k + 0.1, 0, 0), mass=1.0 / links)
        scene.add_joint(SphericalJoint(), link, above, anchor=(0.2 * k, 0, 0))
        above = link
    for pair in combinations(range(links), 2):
        scene.filter_pair(*pair)
    return scene


def four_bar() -> Scene:
    """Crank, coupler and rocker of 0.3, 0.9 and 0.7 m on a base of 1 m, let go with the crank upright."""
    scene = Scene(gravity=(0, -G, 0))
    linkages.add_four_bar(scene, (0.0, 1.0))
    return scene


def slider_crank() -> Scene:
    """A crank of 0.3 m and a rod of 0.8 m that moves a slider, let go with the crank at 60 degrees."""
    scene = Scene(gravity=(0, -G, 0))
    linkages.add_slider_crank(scene, (np.cos(np.pi / 3.0), np.sin(np.pi / 3.0)))
    return scene
