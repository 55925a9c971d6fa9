"""What several tests of USD need."""

import numpy as np
from pxr import Sdf, Usd, UsdValidation

from warp_rigid.engine.quantities import owner_of
from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.recording import Recorder


class Resting:
    """A simulator that stays at its scene's start, for exports that need no motion."""

    def __init__(self, scene, num_envs=1):
        self.scene, self.num_envs, self.time, self.times = scene, num_envs, 0.0, np.zeros(num_envs)
        self.scenes, self.scene_of = [scene], np.zeros(num_envs, dtype=int)

    def get(self, name):
        if owner_of(name) in ("joints", "fields"):
            return Simulator(self.scene, self.num_envs, device="cpu").get(name)
        if name == "gravity":
            rows = np.array(self.scene.gravity)
        elif name in ("asleep", "level"):
            rows = np.zeros(len(self.scene.bodies), dtype=int)
        else:
            rows = np.array([getattr(body, name) for body in self.scene.bodies])
        return np.repeat(rows[None], self.num_envs, axis=0)


def start_of(scene, num_envs=1):
    """A recording of the first frame alone."""
    sim = Resting(scene, num_envs)
    recorder = Recorder(sim, 60.0)
    recorder.capture(sim)
    return recorder.recording()


def validator_errors(path):
    """What the USD library's validators find."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [f"{error.GetName()}: {error.GetMessage()}" for error in errors]


def write_stage(path, body, up="Z", meters=1.0, kilograms=1.0):
    """A .usda file with a physics scene and some prims below /World."""
    text = (
        f'#usda 1.0\n(\n    defaultPrim = "World"\n    upAxis = "{up}"\n    metersPerUnit = {meters}\n'
        f"    kilogramsPerUnit = {kilograms}\n)\n"
        f'def Xform "World"\n{{\n{body}\n}}\n'
    )
    layer = Sdf.Layer.CreateAnonymous(".usda")
    assert layer.ImportFromString(text)
    layer.Export(str(path))
    return path


def rigid(name, kind, values="", apis=(), inside=""):
    """The text of a prim with a rigid body and a collider."""
    applied = ", ".join(f'"{api}"' for api in ("PhysicsRigidBodyAPI", "PhysicsCollisionAPI", *apis))
    lines = "\n".join(f"    {value.strip()}" for value in values.split(";") if value.strip())
    return f'def {kind} "{name}" (\n    prepend apiSchemas = [{applied}]\n)\n{{\n{lines}\n{inside}\n}}\n'


def moved(x, y, z):
    """The text of a translation."""
    return f'double3 xformOp:translate = ({x}, {y}, {z}); uniform token[] xformOpOrder = ["xformOp:translate"]'
