"""Selection: environments and bodies by index or name, as rows of the arrays of all environments."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_rigid.checks import array_of, listed, shown
from warp_rigid.engine.layout import LACKING, Layout
from warp_rigid.scene.scene import Scene


def env_indices(layout: Layout, envs: Any) -> np.ndarray:
    """Indices of the environments chosen by indices or by a mask (envs,); None for all.

    Raises:
        ValueError: there is no such environment, or one is given twice.
    """
    if envs is None:
        return np.arange(layout.num_envs)
    mask = _as_array("envs", envs)
    if mask.dtype == bool and mask.shape == (layout.num_envs,):
        return np.flatnonzero(mask)
    return _whole_indices("envs", envs, layout.num_envs)


def body_rows(layout: Layout, chosen: np.ndarray, bodies: Any, name: str = "bodies") -> np.ndarray:
    """Rows of bodies of the chosen environments, (chosen, bodies).

    Args:
        layout: the environments.
        chosen: indices of environments.
        bodies: indices or names of bodies, which each of these environments must have; None for all bodies, where a row
            is LACKING if an environment has no such body.
        name: of the argument, for the error message.

    Raises:
        ValueError: a scene of the chosen environments has no such body.
    """
    return _rows(layout, chosen, bodies, name, "bodies")


def joint_rows(layout: Layout, chosen: np.ndarray, joints: Any) -> np.ndarray:
    """Rows of joints of the chosen environments, (chosen, joints); as `body_rows`.

    Raises:
        ValueError: a scene of the chosen environments has no such joint.
    """
    return _rows(layout, chosen, joints, "joints", "joints")


def _rows(layout: Layout, chosen: np.ndarray, given: Any, name: str, symbol: str) -> np.ndarray:
    """Rows of what a symbol counts, from indices or names."""
    if given is None:
        return layout.table(symbol)[chosen]
    scene_of = layout.scene_of[chosen]
    table = np.zeros((len(layout.scenes), 0), np.int64)
    for scene in np.unique(scene_of).tolist():
        own = _indices_in_scene(layout, scene, given, name, symbol)
        if table.shape[1] != len(own):
            table = np.zeros((len(layout.scenes), len(own)), np.int64)
        table[scene] = own
    return layout.starts[symbol][chosen, None] + table[scene_of]


def _indices_in_scene(layout: Layout, scene: int, given: Any, name: str, symbol: str) -> np.ndarray:
    """Indices within a scene, from indices or names."""
    names = named(given)
    whose = "" if len(layout.scenes) == 1 else f" of scene {scene} ({_environments(layout, scene)})"
    place = names_of(layout.scenes[scene], symbol)
    if not place:
        raise ValueError(f"{name}: there are no {symbol}{whose or ' in the scene'}")
    if names is None:
        return _whole_indices(name, given, len(place), whose)
    for one in names:
        if one not in place:
            raise ValueError(f"{name}: must be names of {symbol}{whose} ({listed(list(place))}), got {shown(one)}")
    _check_distinct(name, names, given)
    return np.array([place[one] for one in names], np.int64)


def names_of(scene: Scene, symbol: str = "bodies") -> dict[str, int]:
    """Index of each body, or joint, by its name; `symbol`: "bodies" or "joints"."""
    return {entry.name: index for index, entry in enumerate(getattr(scene, symbol))}


def named(bodies: Any) -> list[str] | None:
    """The names, if bodies are given by names and not by indices."""
    if isinstance(bodies, str):
        return [bodies]
    if isinstance(bodies, Sequence | np.ndarray) and len(bodies) and all(isinstance(one, str) for one in bodies):
        return [str(one) for one in bodies]
    return None


def _whole_indices(name: str, value: Any, size: int, whose: str = "") -> np.ndarray:
    chosen = np.atleast_1d(_as_array(name, value))
    if chosen.shape == (0,):
        return np.zeros(0, np.int64)
    if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or (chosen < 0).any() or (chosen >= size).any():
        raise ValueError(f"{name}: must be indices from 0 to {size - 1}{whose}, got {shown(value)}")
    _check_distinct(name, chosen, value)
    return chosen


def _as_array(name: str, value: Any) -> np.ndarray:
    array = array_of(value)
    if array is None:
        raise ValueError(f"{name}: must be a list of indices, got {shown(value)}")
    return array


def _check_distinct(name: str, chosen: Sequence | np.ndarray, value: Any) -> None:
    """Refuse a selection in which something occurs twice: it would have two values, or one impulse instead of two."""
    if len(np.unique(chosen)) < len(chosen):
        raise ValueError(f"{name}: must be given once each, got {shown(value)}")


def _environments(layout: Layout, scene: int) -> str:
    """The first environments of a scene as text."""
    envs = layout.environments(scene)
    return f"environment{'s' if len(envs) > 1 else ''} {listed(envs)}"


def existing(rows: np.ndarray) -> np.ndarray:
    """Mask of the rows that are bodies."""
    return rows != LACKING
