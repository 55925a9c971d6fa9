"""The motion of a URDF robot in MuJoCo, as JSON; `robots.py` runs this with the Python of the converters.

python robots_mujoco.py FILE SECONDS GX GY GZ
"""

import json
import sys
import xml.etree.ElementTree as ElementTree

import mujoco

STEP = 5e-4
CHANGE = 1e-5
"""Of all coordinates at the start [rad], to measure how sensitive a motion is."""
OFF = ("CONTACT", "LIMIT", "FRICTIONLOSS", "EQUALITY")


def load(path):
    """The model without geometry, its first link fixed to the world, every link a body."""
    tree = ElementTree.parse(path).getroot()
    for link in tree.iter("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    for old in tree.findall("mujoco"):
        tree.remove(old)
    ElementTree.SubElement(ElementTree.SubElement(tree, "mujoco"), "compiler", fusestatic="false")
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(tree).decode())


def moved(model, seconds, pose):
    """The state after a motion from rest, with all coordinates equal to `pose` [rad] at the start."""
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    for _ in range(round(seconds / STEP)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


def main(path, seconds, gravity):
    """Print the angles by joint, the centres of mass [m] and masses [kg] by body, and the growth of a small change."""
    model = load(path)
    for name in OFF:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.gravity[:] = gravity
    data = moved(model, seconds, 0.0)
    growth = abs(moved(model, seconds, CHANGE).qpos - data.qpos).max() / CHANGE
    angles = {model.joint(j).name: float(data.qpos[model.jnt_qposadr[j]]) for j in range(model.njnt)}
    moving = [b for b in range(1, model.nbody) if model.body_weldid[b] != 0 and model.body_mass[b] > 0.0]
    centers = {model.body(b).name: data.xipos[b].tolist() for b in moving}
    masses = {model.body(b).name: float(model.body_mass[b]) for b in moving}
    last = model.body(model.jnt_bodyid[model.njnt - 1]).name
    print(json.dumps({"angles": angles, "centers": centers, "masses": masses, "last": last, "growth": float(growth)}))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), [float(x) for x in sys.argv[3:6]])
