"""Balls drop from a hopper, one in every sixth frame, as long as there are any."""

import numpy as np

import warp_rigid as wr

DURATION = 3.0
VARIANTS = {"default": {}, "off": {"shock_propagation": "off"}}


def scene(balls: int = 12, radius: float = 0.06):
    """A ground, and a pool of inactive balls."""
    made = wr.Scene()
    made.add_static(wr.Plane(), friction=0.6, name="ground")
    made.add_pool(wr.Sphere(radius), balls, "ball", friction=0.6, rolling_friction=0.1 * radius)
    return made


def events(sim, frame):
    """Drop a ball, each at another place."""
    if frame % 6 == 0:
        sim.spawn("ball", (0.01 * (frame % 5), 0.01 * (frame % 7), 0.8))


def outcome(sim):
    """How many balls were dropped, and whether all of them are above the ground."""
    height, active = sim.get("position")[:, 1:, 2], sim.get("active")[:, 1:]
    return {"dropped": active.sum(axis=1), "above": np.where(active, height, 1.0).min(axis=1) > 0.0}
