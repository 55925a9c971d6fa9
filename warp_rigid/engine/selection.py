"""Selection: environments and bodies by index or name, as rows of the arrays of all environments."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_rigid.checks import array_of, brief, listed, shown, suggestion
from warp_rigid.engine.layout import LACKING, Layout
from warp_rigid.scene.scene import Scene

Indices = int | slice | Sequence[int] | Sequence[bool] | np.ndarray | None
"""Choice of environments."""
Members = Indices | str | Sequence[str]
"""Choice of bodies or joints, by indices or names."""


def env_indices(num_envs: int, envs: Any) -> np.ndarray:
    """Indices of the environments chosen by indices, a slice or a mask (num_envs,); None for all.

    Raises:
        ValueError: there is no such environment, or one is given twice.
    """
    if envs is None or isinstance(envs, slice):
        return np.arange(num_envs)[slice(None) if envs is None else envs]
    mask = _as_array("envs", envs)
    if mask.dtype == bool:
        if mask.shape != (num_envs,):
            raise ValueError(f"envs: a mask must have the shape ({num_envs},), got {brief(envs)}")
        return np.flatnonzero(mask)
    return _whole_indices("envs", envs, num_envs)


def rows_of(
    layout: Layout, chosen: np.ndarray, given: Any, symbol: str = "bodies", name: str = "", of_some: bool = False
) -> np.ndarray:
    """Rows of bodies or joints of the chosen environments, (chosen, n).

    Args:
        layout: the environments.
        chosen: indices of environments.
        given: indices, names or a slice, all of which each of these environments must have; None for all bodies or
            joints, where a row is LACKING if an environment has fewer.
        symbol: "bodies" or "joints".
        name: of the argument for the error message, if it is not that symbol.
        of_some: whether it is enough that one of these environments has each; a row is LACKING in the others.

    Raises:
        ValueError: a scene, or with `of_some` every scene, of the chosen environments has no such body or joint.
    """
    if given is None:
        return layout.table(symbol)[chosen]
    scenes = np.unique(layout.scene_of[chosen]).tolist()
    if isinstance(given, slice):  # it counts in the scene with the most bodies or joints
        given = np.arange(max((len(getattr(layout.scenes[scene], symbol)) for scene in scenes), default=0))[given]
    if of_some:
        own = _indices_in_some(layout, scenes, given, symbol)
    else:
        own = {scene: _indices_in_scene(layout, scene, given, name or symbol, symbol) for scene in scenes}
    table = np.zeros((len(layout.scenes), len(next(iter(own.values()), ()))), np.int64)
    for scene, indices in own.items():
        table[scene] = indices
    index = table[layout.scene_of[chosen]]
    return np.where(index == LACKING, LACKING, layout.starts[symbol][chosen, None] + index)


def _indices_in_some(layout: Layout, scenes: list[int], given: Any, symbol: str) -> dict[int, np.ndarray]:
    """Indices within each scene, of which at least one must have each body or joint; LACKING in the others."""
    names = named(given)
    known = {scene: names_of(layout.scenes[scene], symbol) for scene in scenes}
    if names is None or not all(any(one in place for place in known.values()) for one in names):
        for scene in sorted(scenes, key=lambda one: -len(known[one]))[:1]:  # the most bodies: the largest index
            given = _indices_in_scene(layout, scene, given, symbol, symbol)
    if names is None:
        return {scene: np.where(given < len(place), given, LACKING) for scene, place in known.items()}
    _check_distinct(symbol, names, given)
    return {scene: np.array([place.get(one, LACKING) for one in names]) for scene, place in known.items()}


def _indices_in_scene(layout: Layout, scene: int, given: Any, name: str, symbol: str) -> np.ndarray:
    """Indices within a scene of the layout, from indices or names."""
    whose = "" if len(layout.scenes) == 1 else f" of scene {scene} ({_environments(layout, scene)})"
    return indices_in(layout.scenes[scene], given, name, symbol, whose)


def indices_in(scene: Scene, given: Any, name: str, symbol: str, whose: str = "") -> np.ndarray:
    """Indices of bodies or joints within a scene.

    Args:
        scene: the scene.
        given: indices, names or a slice.
        name: of the argument, for the error message.
        symbol: "bodies" or "joints".
        whose: which scene it is, for the error message.

    Raises:
        ValueError: the scene has no such body or joint.
    """
    names, place = named(given), names_of(scene, symbol)
    if isinstance(given, slice):
        return np.arange(len(place))[given]
    if not place:
        raise ValueError(f"{name}: there are no {symbol}{whose or ' in the scene'}")
    if names is None:
        return _whole_indices(name, given, len(place), whose)
    for one in names:
        if one not in place:
            known = suggestion(one, place, listed(list(place)))
            raise ValueError(f"{name}: must be names of {symbol}{whose}, got {shown(one)}{known}")
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
    envs = np.flatnonzero(layout.scene_of == scene)
    return f"environment{'s' if len(envs) > 1 else ''} {listed(envs)}"


def existing(rows: np.ndarray) -> np.ndarray:
    """Mask of the rows that are bodies."""
    return rows != LACKING
