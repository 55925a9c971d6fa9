"""Force fields as custom data of a USD physics scene: one array for each parameter of each kind of field."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import Vt

from warp_rigid.scene.fields import FIELDS, ForceField
from warp_rigid.usd.prims import custom_array


def fields_to_data(fields: Sequence[ForceField]) -> dict[str, Any]:
    """Return the parameters of force fields as arrays by key, such as "pointFieldCenters"."""
    data: dict[str, Any] = {}
    for kind, cls in FIELDS.items():
        members = [field for field in fields if type(field) is cls]
        for name, is_vector in cls.parameters().items():
            if members:
                array = Vt.Vec3dArray if is_vector else Vt.DoubleArray
                data[_key(kind, name)] = array([getattr(field, name) for field in members])
    return data


def fields_from_data(data: dict[str, Any], place: np.ndarray) -> list[ForceField]:
    """Return the force fields that `fields_to_data` was called with, ordered by kind.

    Args:
        data: the custom data.
        place: position (3,) of the environment [m], which is added to that of the centres.

    Raises:
        ValueError: An array is missing or has another length, or a parameter is refused.
    """
    found: list[ForceField] = []
    for kind, cls in FIELDS.items():
        parameters = cls.parameters()
        keys = {name: _key(kind, name) for name in parameters}
        if not any(key in data for key in keys.values()):
            continue
        count, columns = -1, {}
        for name, is_vector in parameters.items():
            columns[name] = custom_array(data, keys[name], (count, 3) if is_vector else (count,))
            count = len(columns[name])
        if "center" in columns:
            columns["center"] = columns["center"] + place
        found += [cls(**{name: columns[name][row] for name in columns}) for row in range(count)]
    return found


def _key(kind: str, parameter: str) -> str:
    return kind[0].lower() + kind[1:] + "".join(word.capitalize() for word in parameter.split("_")) + "s"
