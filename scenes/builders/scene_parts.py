"""Scenes as lists of parts, each of which is a function that adds something to a scene."""

from collections.abc import Callable
from operator import methodcaller
from typing import Any

from warp_rigid.scene.scene import Scene, Vector
from warp_rigid.scene.shapes.base import Shape
from warp_rigid.scenes.builders.bodies import add_bodies
from warp_rigid.scenes.builders.grounds import level_scene


def on_ground(*parts: Callable[[Scene], Any], **ground: Any) -> Callable[[], Scene]:
    """A function that builds a scene: level ground, with keywords of `level_scene`, and the parts in their order."""
    return lambda: _with_parts(level_scene(**ground), parts)


def in_space(*parts: Callable[[Scene], Any], gravity: Vector = (0.0, 0.0, 0.0)) -> Callable[[], Scene]:
    """A function that builds a scene: the parts in their order, without ground."""
    return lambda: _with_parts(Scene(gravity=gravity), parts)


def _with_parts(scene: Scene, parts: tuple[Callable[[Scene], Any], ...]) -> Scene:
    for add in parts:
        add(scene)
    return scene


def body(shape: Shape, **options: Any) -> Callable[[Scene], Any]:
    """A part of a scene: a body, with keywords of `Scene.add_body`."""
    return methodcaller("add_body", shape, **options)


def bodies(*columns: Any, **options: Any) -> Callable[[Scene], Any]:
    """A part of a scene: several bodies, with arguments of `add_bodies`."""
    return lambda scene: add_bodies(scene, *columns, **options)


def static(shape: Shape, **options: Any) -> Callable[[Scene], Any]:
    """A part of a scene: a static body, with keywords of `Scene.add_static`."""
    return methodcaller("add_static", shape, **options)
