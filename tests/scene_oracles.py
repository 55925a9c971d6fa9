"""What the tests of the scenes share: a still simulator, and a test of overlap by separating axes."""

import numpy as np

from warp_rigid.scene.scene import Motion


def rotation(quaternion):
    """Rotation matrix of a unit quaternion (x, y, z, w), from its axis and angle."""
    axis, w = np.array(quaternion[:3], dtype=float), float(quaternion[3])
    sine = np.linalg.norm(axis)
    if sine == 0.0:
        return np.eye(3)
    x, y, z = axis / sine
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = 2.0 * np.arctan2(sine, w)
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


def about(axis, degrees):
    """Quaternion that turns about an axis."""
    half = np.radians(degrees) / 2.0
    return np.array([*(np.sin(half) * np.array(axis, dtype=float)), np.cos(half)])


def separation(first, second, axes):
    """Largest gap between two point sets over the axes; negative where none of them separates."""
    gaps = []
    for axis in axes:
        length = np.linalg.norm(axis)
        if length > 1e-9:
            a, b = first @ axis / length, second @ axis / length
            gaps.append(max(a.min() - b.max(), b.min() - a.max()))
    return max(gaps)


def body_separation(first, second):
    """Gap between two bodies along the axes of their frames and the products of these.

    For two boxes these are all axes that matter, so that the sign is exact.
    """
    points, frames = [], []
    for body in (first, second):
        turned = rotation(body.orientation)
        points.append(np.asarray(body.shape.surface()[0]) @ turned.T + np.array(body.position))
        frames.append(turned.T)
    products = [np.cross(a, b) for a in frames[0] for b in frames[1]]
    return separation(*points, [*frames[0], *frames[1], *products])


class StillSimulator:
    """A simulator whose arrays the test writes, one environment as the scene starts at first."""

    def __init__(self, scene, num_envs=1):
        self.scene = scene
        self.num_envs = num_envs
        self.time = 0.0
        self.arrays = {
            name: np.repeat([[getattr(body, name) for body in scene.bodies]], num_envs, axis=0)
            for name in ("position", "orientation", "linear_velocity", "angular_velocity")
        }
        self.depth = np.zeros(num_envs)
        self.contact_envs = []
        for name in ("kinetic_energy", "potential_energy"):
            self.arrays[name] = np.zeros((num_envs, len(scene.bodies)))
        self.calls = []

    def index(self, name):
        """Index of the body of this name."""
        (found,) = [i for i, body in enumerate(self.scene.bodies) if body.name == name]
        return found

    def movable(self):
        """Indices of the dynamic bodies."""
        return [i for i, body in enumerate(self.scene.bodies) if body.motion == Motion.DYNAMIC]

    def get(self, name):
        if name == "center_of_mass":
            local = np.array([body.shape.center_of_mass for body in self.scene.bodies])
            turned = [[rotation(q) @ c for q, c in zip(row, local, strict=True)] for row in self.arrays["orientation"]]
            return self.arrays["position"] + np.array(turned)
        return self.arrays[name].copy()

    def set(self, name, value, bodies):
        self.calls.append((name, value, bodies))

    def penetration(self):
        return self.depth.copy()

    def contacts(self):
        """One record for each entry of `contact_envs`."""
        return np.array([(env,) for env in self.contact_envs], dtype=[("env", np.int32)])
