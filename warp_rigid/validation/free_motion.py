"""Section B: motion of free bodies."""

import numpy as np

from warp_rigid import rotations
from warp_rigid.scene.shapes import Box, Sphere
from warp_rigid.scenes.builders.scene_parts import body, in_space
from warp_rigid.validation.case import Cases, Check, Curve, Miss, absolute, at_most, case, each, measured, relative
from warp_rigid.validation.common import G, complete_elliptic, orientation_about
from warp_rigid.validation.experiment import DT, Experiment, Start, Trace

EULER = "Euler's equations, closed form"
FLAT = 1e-3
"""Half the thickness of plates that approximate ideal ones [m]."""
PLATE = Box((1.0, 1.0, FLAT))
"""Moments of inertia as 1 : 1 : 2."""
ROD = Box((1.0, 1.0, np.sqrt(3.0)))
"""Moments of inertia as 2 : 2 : 1."""
BRICK = Box((np.sqrt(2.0), 1.0, FLAT))
"""Moments of inertia as 1 : 2 : 3."""


def cases(quick: bool) -> Cases:
    """All cases of the section; shorter if quick."""
    return [
        symmetric_top("plate, I 1 : 1 : 2", PLATE),
        symmetric_top("rod, I 2 : 2 : 1", ROD),
        flip(11.0 if quick else 40.0),
        stable_axes(10.0 if quick else 40.0),
        momentum_kept(),
        free_fall(),
    ]


def moments(shape) -> np.ndarray:
    """Principal moments over the mass, along the shape's axes, (3,) [m^2]."""
    return np.diag(np.asarray(shape.inertia, np.float64)) / shape.volume


def spinning(shape, spins, orientations=None, **options) -> Experiment:
    """Experiment: a free body in environments that differ in spin (n, 3) in the body frame and orientation (n, 4)."""
    spins = np.asarray(spins, np.float64)
    orientations = np.tile([0.0, 0.0, 0.0, 1.0], (len(spins), 1)) if orientations is None else np.asarray(orientations)
    world = rotations.rotate(orientations, spins)
    starts = Start("orientation", orientations[:, None]), Start("angular_velocity", world[:, None])
    return Experiment(in_space(body(shape, mass=1.0)), starts=starts, **options)


def symmetric_top(name, shape):
    """The symmetry axis precesses about the angular momentum at L / I1, at a constant angle."""
    side, _, axial = moments(shape)
    spin = np.array([1.0, 0.0, 10.0])
    orientations = np.concatenate([[[0, 0, 0, 1]], rotations.random(np.random.default_rng(1), 3)])
    total = np.array([side, side, axial]) * spin

    def axis_and_momentum(trace: Trace):
        up = trace.spin_momentum[0, :, 0]
        return trace.rotation[:, :, 0, :, 2], up / np.linalg.norm(up, axis=1, keepdims=True)

    def precession(trace):
        axis, up = axis_and_momentum(trace)
        east = axis[0] - np.einsum("ei,ei->e", axis[0], up)[:, None] * up
        azimuth = np.arctan2(np.einsum("nei,ei->ne", axis, np.cross(up, east)), np.einsum("nei,ei->ne", axis, east))
        return np.polyfit(trace.time, np.unwrap(azimuth, axis=0), 1)[0]

    def farthest_angle(trace):
        axis, up = axis_and_momentum(trace)
        angle = np.degrees(np.arccos(np.einsum("nei,ei->ne", axis, up)))
        return angle[np.abs(angle - angle[0]).argmax(axis=0), np.arange(angle.shape[1])]

    def body_rate(trace):
        azimuth = np.unwrap(np.arctan2(trace.body_spin[:, :, 0, 1], trace.body_spin[:, :, 0, 0]), axis=0)
        return np.abs(np.polyfit(trace.time, azimuth, 1)[0])

    tilt = np.degrees(np.arctan2(side * spin[0], axial * spin[2]))
    names = "upright", "turned", "2nd", "3rd"
    return case(
        f"V10 torque-free symmetric top, {name}, spin (1, 0, 10) rad/s",
        f"{EULER}; Landau and Lifshitz, Mechanics, sections 33 to 36",
        measured("precession in space", "rad/s", precession, relative(1e-3), np.linalg.norm(total) / side),
        measured("precession in the body", "rad/s", body_rate, relative(1e-3), abs(axial - side) / side * spin[2]),
        measured("angle with the largest deviation from the start", "deg", farthest_angle, relative(1e-3), tilt),
        of=spinning(shape, np.tile(spin, (4, 1)), orientations, duration=10.0, variants=names),
    )


def flip_interval(inertia, spin) -> float:
    """Time between two flips of a free body that spins about its middle axis [s].

    Half the period of the Jacobi functions that solve Euler's equations (Landau and Lifshitz, section 37).
    """
    i1, i2, i3 = inertia
    energy2 = np.dot(inertia, np.square(spin))
    square = np.dot(np.square(inertia), np.square(spin))
    if square < energy2 * i2:
        (i1, i3) = (i3, i1)
    rate = np.sqrt((i3 - i2) * (square - energy2 * i1) / (i1 * i2 * i3))
    parameter = (i2 - i1) * (energy2 * i3 - square) / ((i3 - i2) * (square - energy2 * i1))
    return 2.0 * complete_elliptic(parameter) / rate


def flips(trace: Trace) -> list[np.ndarray]:
    """Times at which the middle axis passes the equator of the angular momentum, for each environment [s]."""
    height = np.einsum("nei,nei->ne", trace.rotation[:, :, 0, :, 1], trace.spin_momentum[:, :, 0])
    found = []
    for series in height.T:
        k = np.flatnonzero(np.sign(series[:-1]) != np.sign(series[1:]))
        found.append((k + series[k] / (series[k] - series[k + 1])) * trace.experiment.dt)
    return found


def flip(duration):
    """Spin about the middle axis: Dzhanibekov's flip."""
    spins = np.array([[0.01, 5.0, 0.01], [0.1, 2.0, 0.2], [0.5, 20.0, 0.1]])
    exact = [flip_interval(moments(BRICK), spin) for spin in spins]

    def mean(t):
        return [np.diff(times).mean() if len(times) > 1 else np.nan for times in flips(t)]

    def size(t):
        return np.linalg.norm(t.spin_momentum[:, :, 0], axis=-1)

    def change(series):
        return np.abs(series[: round(10.0 / DT) + 1] / series[0] - 1).max(axis=0)

    names = tuple(f"spin {' '.join(f'{w:g}' for w in spin)} rad/s" for spin in spins)
    return case(
        "V11 Dzhanibekov's flip, I 1 : 2 : 3",
        "elliptic integral of Euler's equations",
        measured("time between flips", "s", mean, relative(2e-3), exact),
        measured("energy error over 10 s", "", lambda t: change(t.kinetic_energy), at_most(2e-4)),
        measured("error of |L| over 10 s", "", lambda t: change(size(t)), at_most(1e-5)),
        of=spinning(BRICK, spins, duration=duration, variants=names),
        curve=Curve("spin about the middle axis", "rad/s", lambda t: t.body_spin[:, :, 0, 1]),
    )


def stable_axes(duration):
    """Spin about the axes of largest and smallest inertia is stable; spin about the middle axis flips."""
    # The moments of a box are in the same proportion as those of the ellipsoid with its half extents as semi-axes.
    ellipsoid = Box((2.0, 1.0, 0.5))
    spin = np.radians(180.0)
    axes = np.array([0, 2])

    def wander(trace):
        axis = np.moveaxis(trace.rotation[:, np.arange(2), 0, :, axes], 0, 1)
        sine = np.linalg.norm(np.cross(axis, axis[0][None]), axis=-1)
        return np.degrees(np.arctan2(sine, np.einsum("nei,ei->ne", axis, axis[0]))).max(axis=0)

    names, off = ("long axis", "short axis"), ("1e-3 off at the start",)
    between = "time between flips about the middle axis"
    middle = spin * np.array([1e-3, 1.0, 2e-3])
    exact = flip_interval(moments(ellipsoid), middle)
    return case(
        f"V12 axes of an ellipsoid 2 x 1 x 0.5, 180 degrees/s, {duration:g} s",
        "stability of Euler's equations; rigid-ipc",
        Check("deviation of the axis", "deg", lambda s: wander(s[0]), at_most(0.5), labels=names),
        Check(between, "s", lambda s: np.diff(flips(s[1])[0])[:1], relative(2e-3), exact, labels=off),
        of=(
            spinning(ellipsoid, spin * np.eye(3)[axes], duration=duration, variants=names),
            spinning(ellipsoid, [middle], duration=16.0, variants=("middle axis",)),
        ),
    )


def momentum_kept():
    """|L| of tumbling bodies over ten thousand steps."""
    shape = Box((1.0, 0.7, 0.4))
    draw = np.random.default_rng(2)
    spins, orientations = 5.0 * draw.normal(size=(8, 3)), rotations.random(draw, 8)

    def change(trace):
        start, end = trace.spin_momentum[0, :, 0], trace.spin_momentum[-1, :, 0]
        return np.linalg.norm(end, axis=1) / np.linalg.norm(start, axis=1) - 1.0

    def rotation_of_momentum(trace):
        unit = trace.spin_momentum[:, :, 0]
        unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
        return np.linalg.norm(unit - unit[0], axis=-1).max(axis=0)

    names = tuple(f"{np.linalg.norm(spin):.3g} rad/s" for spin in spins)
    return case(
        "V12 angular momentum of tumbling bodies over 10 000 steps",
        "conservation",
        measured("error of |L|", "", change, absolute(1e-5)),
        measured("rotation of L", "rad", rotation_of_momentum, at_most(5e-5)),
        of=spinning(shape, spins, orientations, duration=10_000 * DT, every=100, variants=names),
    )


def free_fall():
    """Symplectic Euler must fall by g dt^2 n (n + 1) / 2; the other components of the motion are uniform."""
    rates = (60, 240, 1000)
    velocity = np.array([[0.0, 0.0, 0.0], [3.0, -2.0, 4.0]])
    ball = body(Sphere(0.1), angular_velocity=(5, 0, 0), orientation=orientation_about((1, 2, 3), 40.0))
    scene = in_space(ball, gravity=(0, 0, -G))

    def discrete(trace):
        n, dt = len(trace.time) - 1, trace.experiment.dt
        return velocity[:, 2] * n * dt - G * dt * dt * n * (n + 1) / 2

    def experiment(rate):
        starts = (Start("linear_velocity", velocity[:, None]),)
        return Experiment(scene, 1.0, (f"fall, dt 1/{rate}", f"throw, dt 1/{rate}"), starts, dt=1 / rate)

    def off(trace):
        exact = np.column_stack([velocity[:, :2], discrete(trace)])
        return np.linalg.norm(trace.position[-1, :, 0] - exact, axis=1)

    def height(t):
        return t.position[-1, :, 0, 2]

    rounding = "rounding of 1000 sums in float32, at most 1.2e-7 m each from 2 to 4 m, at most 6.6e-5 m in all"
    return case(
        "V14 free fall and throw, 1 s",
        "the sum of symplectic Euler steps",
        measured("height", "m", height, absolute(1e-5), lambda s: each(discrete)(s[:2]), rows=slice(4)),
        measured("position error", "m", off, at_most(1e-5), rows=slice(4)),
        measured("position error", "m", off, at_most(1e-5), rows=slice(4, None), miss=Miss(rounding, 5e-5)),
        of=tuple(experiment(rate) for rate in rates),
        curve=Curve("height", "m", lambda t: t.position[:, :, 0, 2]),
    )
