"""A stand-in for the simulator whose motion is known in closed form."""

import numpy as np

from warp_rigid.engine.health_checks import WARNING_RECORD
from warp_rigid.engine.settings import Settings
from warp_rigid.scene.scene import Motion


class FakeSimulator:
    """Bodies fall freely from their start and spin about y; environment e spins e + 1 times as fast.

    The simulator's interface as far as recording needs it.
    """

    SPIN = 3.0
    GRAVITY = 9.81

    def __init__(self, scene, num_envs=1, dt=1.0 / 240.0):
        self.scene = scene
        self.scenes, self.scene_of = (scene,), np.zeros(num_envs, int)
        self.num_envs = num_envs
        self.num_bodies = len(scene.bodies)
        self.settings = Settings(dt=dt)
        self.device = "nowhere"
        self.steps = 0

    @property
    def times(self):
        return np.full(self.num_envs, self.time)

    @property
    def time(self):
        return self.steps * self.settings.dt

    def step(self, count=1):
        self.steps += count

    def get(self, name):
        if name == "gravity":
            return np.tile(np.array(self.scene.gravity), (self.num_envs, 1))
        if hasattr(self, name):
            return getattr(self, name)()
        return np.stack([[getattr(body, name) for body in self.scene.bodies]] * self.num_envs)

    def penetration(self):
        return np.full(self.num_envs, 0.001 * self.steps)

    def status(self):
        record = np.dtype([("status", "U10"), ("step", np.int64), ("body", np.int64)])
        return np.array([("ok", -1, -1)] * self.num_envs, dtype=record)

    def warnings(self):
        return np.zeros(0, WARNING_RECORD)

    def counts(self):
        return {"pairs": 0, "contacts": 0, "levels": 0}

    def asleep(self):
        return np.full((self.num_envs, self.num_bodies), self.steps > 10)

    def level(self):
        return np.full((self.num_envs, self.num_bodies), self.steps)

    def position(self):
        start = np.array([body.position for body in self.scene.bodies])
        fall = np.array([body.motion == Motion.DYNAMIC for body in self.scene.bodies])
        drop = 0.5 * self.GRAVITY * self.time**2 * fall
        moved = start - drop[:, None] * [0.0, 0.0, 1.0]
        return np.repeat(moved[None], self.num_envs, axis=0).astype(np.float32)

    def orientation(self):
        half = 0.5 * self.SPIN * self.time * (np.arange(self.num_envs) + 1.0)
        turned = np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], axis=1)
        # A simulator may give either sign of a quaternion.
        turned *= np.where((np.arange(self.num_envs) + self.steps // 7) % 2 == 0, 1.0, -1.0)[:, None]
        fixed = np.array([body.orientation for body in self.scene.bodies])
        moving = np.array([body.motion == Motion.DYNAMIC for body in self.scene.bodies])
        both = np.where(moving[None, :, None], turned[:, None], fixed[None])
        return both.astype(np.float32)
