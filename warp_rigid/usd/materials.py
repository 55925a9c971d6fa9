"""Body coefficients as attributes of a USD material."""

import math
from collections.abc import Mapping

from pxr import Sdf, Usd, UsdPhysics, UsdShade

from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.usd.masses import MUJOCO_COLLIDER, positive
from warp_rigid.usd.prims import applies, value_of
from warp_rigid.usd.specs import define, set_attribute
from warp_rigid.usd.usd_file import UsdFile

SCHEMAS = {"physics": "PhysicsMaterialAPI", "newton": "NewtonMaterialAPI"}
"""Applied schemas by the namespace of their attributes."""

BASE = "physics"
"""Namespace whose attributes are always written; the others are left out while all their values are defaults."""

MUJOCO_DIMENSIONS = {"friction": 3, "spinning_friction": 4, "rolling_friction": 6}
"""Least `condim` of a geom of MuJoCo with which a coefficient acts; by default it is 3."""


def write_material(layer: Sdf.Layer, path: str, values: Mapping[str, float]) -> None:
    """Define a material.

    Args:
        layer: takes the definition.
        path: of the material's prim.
        values: all coefficients by name.
    """
    changed = [c for c in COEFFICIENTS.values() if values[c.name] != c.default]
    written = {BASE} | {_namespace(attribute) for c in changed for attribute in c.usd_attributes}
    prim = define(layer, path, "Material", [schema for space, schema in SCHEMAS.items() if space in written])
    for name, coefficient in COEFFICIENTS.items():
        for attribute in coefficient.usd_attributes:
            if _namespace(attribute) in written:
                set_attribute(prim, attribute, Sdf.ValueTypeNames.Float, values[name])


def read_material(file: UsdFile, prim: Usd.Prim) -> tuple[dict[str, float], float | None]:
    """Return the coefficients that the material of a collider has, and its density in units of the file.

    Args:
        file: the file, which receives the values that are not used.
        prim: the collider.
    """
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
    if not material or not material.HasAPI(UsdPhysics.MaterialAPI):
        return {}, None
    found = {}
    for name, coefficient in COEFFICIENTS.items():
        first, *others = (material.GetAttribute(attribute) for attribute in coefficient.usd_attributes)
        if not first or not (first.HasAuthoredValue() or _namespace(first.GetName()) == BASE):
            continue
        value = first.Get()
        for other in others:
            if other.HasAuthoredValue() and not math.isclose(value, other.Get(), rel_tol=1e-6):
                used = f"{value:g} of {first.GetName()} is used"
                file.change(prim, f"{name}: {used}, not {other.Get():g} of {other.GetName()}")
        found[name] = value * file.meter**coefficient.length_power
    if applies(prim, MUJOCO_COLLIDER):
        dimensions = value_of(prim, "mjc:condim", 3)
        found |= {name: 0.0 for name, least in MUJOCO_DIMENSIONS.items() if dimensions < least}
    return found, positive(UsdPhysics.MaterialAPI(material).GetDensityAttr())


def _namespace(attribute: str) -> str:
    return attribute.partition(":")[0]
