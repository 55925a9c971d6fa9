"""Section D, second part: bodies that roll and spin."""

import numpy as np

from warp_rigid import rotations
from warp_rigid.scene.shapes import Box, Cylinder, Sphere
from warp_rigid.scenes.builders.scene_parts import body, on_ground
from warp_rigid.validation.case import OUTCOME, Cases, Curve, at_most, case, measured, relative
from warp_rigid.validation.common import COULOMB, G, at_time, downhill, first_time, stop_checks, time_at_rest
from warp_rigid.validation.experiment import Experiment, Start, of_body, per_env


def cases(quick: bool) -> Cases:
    """Cases of rolling and spinning; shorter if quick."""
    return [
        slide_to_roll(),
        backspin(),
        rolling_race(),
        authors_rolling(),
        rolling_friction(),
        rolling_friction_holds(),
        spinning_friction(),
        force_direction(0.5 if quick else 4.0),
    ]


def ball(radius=0.1, **options):
    """Experiment: a ball on level ground; options as for Experiment."""
    return Experiment(on_ground(body(Sphere(radius), position=(0, 0, radius))), **options)


def rolling_time(trace):
    """Time at which the ball of 0.1 m starts to roll, as its lowest point stands still, (envs,) [s]."""
    return first_time(trace, trace.linear_velocity[:, :, 1, 0] - 0.1 * trace.angular_velocity[:, :, 1, 1] < 1e-4)


def stop_time(trace):
    """Time at which the ball neither rolls nor spins any more, (envs,) [s]."""
    return time_at_rest(trace, trace.speed)


def forward(trace):
    """Position of the ball along x, (records, envs) [m]."""
    return trace.position[:, :, 1, 0]


MASSES = (0.01, 1.0, 1000.0)


def over_masses(*starts, **options):
    """A ball in environments that differ only in its mass, by five powers of ten."""
    mass = Start("mass", np.array(MASSES)[:, None], bodies=[1])
    return ball(variants=tuple(f"{mass:g} kg" for mass in MASSES), starts=(mass, *starts), **options)


def slide_to_roll():
    """A ball that slides until its lowest point is at rest, and then rolls without loss."""
    v0, mu = 5.0, 0.2
    time = 2 * v0 / (7 * mu * G)
    distance = v0 * time - 0.5 * mu * G * time**2

    def rolling_distance(trace):
        return at_time(trace, forward(trace), rolling_time(trace))

    return case(
        "V24 ball that slides until it rolls, v0 5 m/s, mu 0.2",
        COULOMB,
        measured("time until it rolls", "s", rolling_time, relative(5e-3), time),
        measured("distance until it rolls", "m", rolling_distance, relative(5e-3), distance),
        measured("speed 1 s later", "m/s", lambda t: t.linear_velocity[-1, :, 1, 0], relative(5e-3), 5 * v0 / 7),
        of=over_masses(Start("friction", mu), *of_body(linear_velocity=(v0, 0, 0)), duration=1.75),
        curve=Curve("speed", "m/s", lambda t: t.linear_velocity[:, :, 1, 0]),
    )


def backspin():
    """A ball with backspin that removes all of its speed."""
    v0, mu = 2.0, 0.2
    time = v0 / (mu * G)
    motion = of_body(linear_velocity=(v0, 0, 0), angular_velocity=(0, -v0 / 0.1 * 2.5, 0))
    return case(
        "V24 ball with backspin, v0 2 m/s, omega R -5 m/s, mu 0.2, stops",
        COULOMB,
        measured("time to stop", "s", stop_time, relative(5e-3), time),
        measured("distance to stop", "m", lambda t: forward(t)[-1], relative(5e-3), 0.5 * v0 * time),
        measured("speed at the end", "m/s", lambda t: t.speed[-1], at_most(1e-3)),
        of=over_masses(Start("friction", mu), *motion, duration=1.4),
        curve=Curve("speed", "m/s", lambda t: t.linear_velocity[:, :, 1, 0]),
    )


def rolling_race():
    """A slope of 30 degrees: bodies roll with enough friction, and slip with less."""
    slope, shares = np.radians(30.0), np.array([0.8, 1.25, 3.0])
    experiments, ways = [], []
    for name, shape, inertia in (("sphere", Sphere(0.1), 0.4), ("cylinder", Cylinder(0.1, 0.3), 0.5)):
        needed = np.tan(slope) * inertia / (1 + inertia)
        lying = rotations.about_axis((1, 0, 0), np.radians(90))
        scene = on_ground(body(shape, position=(0, 0, 0.1), orientation=lying))
        starts = per_env("friction", shares * needed), Start("gravity", downhill(30.0))
        variants = tuple(f"{name}, {share:g} of the friction to roll" for share in shares)
        experiments.append(Experiment(scene, 1.0, variants, starts, every=4))
        slipping = G * (np.sin(slope) - shares * needed * np.cos(slope))
        ways.append(0.5 * np.where(shares < 1.0, slipping, G * np.sin(slope) / (1 + inertia)))
    return case(
        "V25 rolling race down 30 degrees",
        "a = g sin / (1 + k), or g (sin - mu cos) where it slips",
        measured("distance after 1 s", "m", lambda t: forward(t)[-1], relative(0.01), np.concatenate(ways)),
        of=tuple(experiments),
        curve=Curve("way", "m", forward),
    )


def authors_rolling():
    """The sphere of the authors of the 2003 method on inclines of k 4.5 degrees, which never slips."""
    degrees = 4.5 * np.arange(1, 11)
    sine = np.sin(np.radians(degrees))
    names = tuple(f"{angle:g} deg" for angle in degrees)
    starts = Start("gravity", [downhill(angle) for angle in degrees]), Start("friction", 1e4)
    return case(
        "V25 sphere without slip on ten inclines from 4.5 to 45 degrees",
        "PhysBAM sphere on an incline: (5/14) g t^2 sin^2",
        measured("height lost in 1 s", "m", lambda t: forward(t)[-1] * sine, relative(0.01), 5 / 14 * G * sine**2),
        of=ball(duration=1.0, variants=names, starts=starts, every=4),
        curve=Curve("way", "m", forward),
    )


def rolling_friction():
    """Torque = c N slows a rolling ball by c g / (R (1 + 2/5)), whatever its mass."""
    radius, c = 0.5, 0.01
    slowing = c * G / (1.4 * radius)
    surface = Start("friction", 0.5), Start("rolling_friction", c)
    motion = of_body(linear_velocity=(1, 0, 0), angular_velocity=(0, 2, 0))
    return case(
        "V29 rolling friction, R 0.5 m, c 0.01 m, from 1 m/s, over five powers of ten of mass",
        "torque = c N, closed form",
        *stop_checks(lambda t: t.speed, forward, 1 / slowing, 0.5 / slowing, 0.02, 1e-5),
        of=over_masses(*surface, *motion, radius=radius, duration=8.0),
        curve=Curve("speed", "m/s", lambda t: t.linear_velocity[:, :, 1, 0]),
    )


def rolling_friction_holds():
    """A ball starts to roll above tan = c / R and stays at rest below."""
    shares = np.array([0.5, 0.9, 1.1, 2.0])
    slopes = [downhill(np.degrees(np.arctan(share * 0.01 / 0.5))) for share in shares]
    names = tuple(f"tan = {share:g} c / R" for share in shares)
    starts = Start("gravity", slopes), Start("friction", 0.5), Start("rolling_friction", 0.01)
    return case(
        "V29 rolling friction on a slope, R 0.5 m, c 0.01 m",
        "rolls above tan = c / R",
        measured("rolls", "", lambda t: forward(t)[-1] > 1e-3, OUTCOME, shares > 1.0),
        of=ball(0.5, duration=2.0, variants=names, starts=starts, every=24),
    )


def spinning_friction():
    """Torque = c N slows a ball that spins in place by c N / I = 5 c g / (2 R^2), whatever its mass."""
    radius, c, spin = 0.5, 0.01, 10.0
    time = spin / (c * G / (0.4 * radius**2))
    surface = Start("friction", 0.5), Start("spinning_friction", c)
    return case(
        "V30 spinning friction, R 0.5 m, c 0.01 m, from 10 rad/s, over five powers of ten of mass",
        "torque = c N, closed form",
        measured("time to stop", "s", stop_time, relative(0.02), time),
        measured("drift", "m", lambda t: t.displacement[-1], at_most(1e-4)),
        of=over_masses(*surface, *of_body(angular_velocity=(0, 0, spin)), radius=radius, duration=11.0, every=4),
        curve=Curve("spin", "rad/s", lambda t: t.angular_velocity[:, :, 1, 2]),
    )


def force_direction(duration):
    """A force 9 % above friction drags a box with 25 balls on it; a 5 % error of the friction cone becomes 50 %."""
    mass, balls, mu, force = 10.0, 25, 0.4, 150.0
    angles = np.array([0.0, 30.0, 45.0, 60.0])
    box_rate = (force - mu * (mass + balls) * G) / (mass + 2 / 7 * balls)
    places = [(x, y, 1.5) for x in range(-4, 5, 2) for y in range(-4, 5, 2)]
    parts = [body(Box((10, 10, 0.5)), position=(0, 0, 0.5), mass=mass, friction=0.8)]
    parts += [body(Sphere(0.5), position=place, mass=1.0, friction=0.8) for place in places]
    heading = np.stack([np.cos(np.radians(angles)), np.sin(np.radians(angles)), 0 * angles], axis=1)

    def deviation(trace):
        exact = trace.time[:, None, None] * heading * box_rate
        box = trace.linear_velocity[:, :, 1] - exact
        rolling = trace.linear_velocity[:, :, 2] - 2 / 7 * exact
        return ((box**2).sum(axis=-1) + (rolling**2).sum(axis=-1)).mean(axis=0)

    def acceleration(trace):
        return np.einsum("ei,ei->e", trace.linear_velocity[-1, :, 1], heading) / trace.time[-1]

    names = tuple(f"{angle:g} deg to x" for angle in angles)
    starts = of_body(force=force * heading)
    return case(
        "V33 box with 25 balls dragged in four directions by 1.09 of its friction",
        "SimBenchmark rolling; a = (F - mu N) / (M + 2 m n / 7)",
        measured("acceleration of the box", "m/s^2", acceleration, relative(0.01), box_rate),
        measured("mean squared error of the speeds", "m^2/s^2", deviation, at_most(1e-4)),
        of=Experiment(on_ground(*parts, friction=mu), duration, names, starts, dt=1e-3, every=10),
        curve=Curve("speed of the box", "m/s", lambda t: np.linalg.norm(t.linear_velocity[:, :, 1], axis=-1)),
    )
