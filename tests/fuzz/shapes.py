"""Shapes and scenes of random and invalid numbers, used as a simulation uses them."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

import warp_rigid as wr
from tests.fuzz.harness import NUMBERS, ODDITIES, Target, vectors
from warp_rigid.scene.coefficients import COEFFICIENTS, Coefficient
from warp_rigid.scene.fields import FIELDS

SIZES = st.one_of(st.floats(0.01, 2), NUMBERS, ODDITIES)

SIMPLE = st.one_of(
    st.tuples(st.just(wr.Sphere), st.tuples(SIZES)),
    st.tuples(st.just(wr.Box), st.tuples(vectors(3))),
    st.tuples(st.just(wr.Capsule), st.tuples(SIZES, SIZES)),
    st.tuples(st.just(wr.Cylinder), st.tuples(SIZES, SIZES)),
    st.tuples(st.just(wr.Plane), st.tuples(vectors(3), SIZES)),
    st.tuples(st.just(wr.Heightfield), st.tuples(st.lists(vectors(3), max_size=4), vectors(2))),
)

COMPOUND = st.lists(st.tuples(SIMPLE, vectors(3), vectors(4)), max_size=3)

VERTICES = st.one_of(
    st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=3, max_size=9),
    st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=3, max_size=9),
    st.lists(vectors(3), max_size=6),
    ODDITIES,
)
FACES = st.one_of(
    st.lists(st.tuples(*[st.integers(0, 5)] * 3), max_size=12),
    st.lists(st.tuples(*[st.integers(-1, 9)] * 3), max_size=12),
    st.lists(vectors(3), max_size=4),
    ODDITIES,
)


def use(shape: wr.Shape) -> None:
    """Evaluate everything that a simulation needs of a shape."""
    assert np.isfinite(shape.volume) and np.isfinite(shape.inertia).all()
    shape.samples()
    shape.surface()
    for part in shape.parts():
        assert part.grid is None or np.isfinite(part.grid.values).all()


def simple(case: Any) -> wr.Shape:
    make, arguments = case
    return make(*arguments)


def try_simple(case: Any, folder: Path) -> None:
    use(simple(case))


def try_compound(case: Any, folder: Path) -> None:
    use(wr.Compound([(simple(shape), position, orientation) for shape, position, orientation in case]))


def try_mesh(case: Any, folder: Path) -> None:
    vertices, faces, resolution = case
    if not isinstance(resolution, int) or resolution > 16:
        resolution = min(resolution, 16) if isinstance(resolution, int) else resolution
    use(wr.Mesh(vertices, faces, sdf_resolution=resolution))


def coefficient_values(coefficient: Coefficient) -> st.SearchStrategy:
    """Values in the range, and invalid ones."""
    if math.isinf(coefficient.upper):
        return SIZES
    return st.one_of(st.floats(coefficient.lower, coefficient.upper), ODDITIES)


BODY = st.fixed_dictionaries(
    {"shape": SIMPLE, "add": st.sampled_from(["add_body", "add_body", "add_kinematic", "add_static"])},
    optional={
        "position": vectors(3),
        "orientation": vectors(4),
        "linear_velocity": vectors(3),
        "angular_velocity": vectors(3),
        "density": SIZES,
        "mass": SIZES,
        **{name: coefficient_values(coefficient) for name, coefficient in COEFFICIENTS.items()},
        "name": st.one_of(st.text(max_size=3), ODDITIES),
    },
)

FIELD = st.one_of(
    *(
        st.tuples(st.just(cls), st.tuples(*(vectors(3) if vector else NUMBERS for vector in cls.parameters().values())))
        for cls in FIELDS.values()
    )
)

SCENE = st.fixed_dictionaries(
    {"bodies": st.lists(BODY, min_size=1, max_size=4), "fields": st.lists(FIELD, max_size=1)},
    optional={"gravity": vectors(3), "friction_combine": st.one_of(st.just("max"), ODDITIES)},
)


def scene_of(case: dict) -> wr.Scene:
    """The scene of all bodies that are not refused; raises the refusal if none is left."""
    head = {name: case[name] for name in ("gravity", "friction_combine") if name in case}
    scene = wr.Scene(**head)
    refused: ValueError | None = None
    for entry in case["bodies"]:
        given = {name: value for name, value in entry.items() if name not in ("shape", "add")}
        kept = ("position", "orientation", *COEFFICIENTS, "name")
        if entry["add"] == "add_kinematic":
            kept += ("linear_velocity", "angular_velocity")
        if entry["add"] != "add_body":
            given = {name: value for name, value in given.items() if name in kept}
        try:
            getattr(scene, entry["add"])(simple(entry["shape"]), **given)
        except ValueError as error:
            refused = error
    for make, arguments in case["fields"]:
        scene.add_force_field(make(*arguments))
    if not scene.bodies and refused:
        raise refused
    return scene


def try_scene(case: dict, folder: Path) -> None:
    """Either the scene is refused, or it runs, and status reports every environment that is no longer finite."""
    sim = wr.Simulator(scene_of(case), num_envs=2, device="cpu")
    sim.step(3)
    sim.penetration()
    sim.contacts()
    sim.get("kinetic_energy")
    healthy = sim.status()["status"] == "ok"
    assert np.isfinite(sim.get("position")[healthy]).all()
    sim.save(folder / "scene.ckpt")
    wr.Simulator.load(folder / "scene.ckpt").step(1)


TARGETS = [
    Target("shapes", SIMPLE, try_simple),
    Target("compounds", COMPOUND, try_compound),
    Target("meshes", st.tuples(VERTICES, FACES, st.one_of(st.integers(8, 16), ODDITIES)), try_mesh),
    Target("scenes", SCENE, try_scene),
]
