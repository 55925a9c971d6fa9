"""Program for the environment of the converters: masses and motion of a robot by MuJoCo, as JSON.

    python mujoco_oracle.py FILE SECONDS

Contacts, limits and friction of joints are off. All joints start with velocities. Bodies without names get those of the
converter.
"""

import json
import sys
import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np

STEP = 5e-4
OFF = ("mjDSBL_CONTACT", "mjDSBL_LIMIT", "mjDSBL_FRICTIONLOSS")


def load(path: str) -> mujoco.MjModel:
    """The model; of URDF files without geometry, and with all links."""
    if not path.endswith(".urdf"):
        return mujoco.MjModel.from_xml_path(path)
    tree = ElementTree.parse(path).getroot()
    for link in tree.iter("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    ElementTree.SubElement(ElementTree.SubElement(tree, "mujoco"), "compiler", fusestatic="false")
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(tree).decode())


def main(path: str, seconds: float) -> None:
    """Print masses and states at the start, and coordinates and centres of mass at the end."""
    model = load(path)
    for name in OFF:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, name))
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.density = model.opt.viscosity = 0.0
    data = mujoco.MjData(model)
    data.qvel[:] = 0.6 * np.cos(1.7 * np.arange(model.nv) + 0.3)
    mujoco.mj_forward(model, data)
    bodies, unnamed = {}, 0
    for b in range(1, model.nbody):
        if model.body_mass[b] == 0.0:
            continue  # the base of a URDF file
        name = model.body(b).name or f"Body_{unnamed}".removesuffix("_0")
        unnamed += not model.body(b).name
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, linear, angular, data.xipos[b], b)
        axes = data.ximat[b].reshape(3, 3)
        bodies[name] = {
            "mass": float(model.body_mass[b]),
            "center": data.xipos[b].tolist(),
            "inertia": (axes @ np.diag(model.body_inertia[b]) @ axes.T).tolist(),
            "linear": (linear @ data.qvel).tolist(),
            "angular": (angular @ data.qvel).tolist(),
        }
    before = data.qpos.copy()
    for _ in range(round(seconds / STEP)):
        mujoco.mj_step(model, data)
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    single = [j for j in range(model.njnt) if model.jnt_type[j] in kinds]
    turned = {model.joint(j).name: float((data.qpos - before)[model.jnt_qposadr[j]]) for j in single}
    print(json.dumps({"bodies": bodies, "joints": turned}))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
