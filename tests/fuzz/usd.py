"""USD files: scenes with wild attributes, references that lead in circles or to far too much, and damaged bytes."""

import functools
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

import warp_rigid as wr
from tests.fuzz.harness import Target, damaged
from warp_rigid.render.film import film_from_usd
from warp_rigid.usd import opening
from warp_rigid.usd.check import check_usd
from warp_rigid.usd.instancing import flatten_usd
from warp_rigid.usd.load import film_duration

opening._EXAMINER.start()  # the process that examines files is no doing of a case

HEAD = '#usda 1.0\n(\n    defaultPrim = "World"\n    upAxis = {up}\n    metersPerUnit = {meters}\n)\n'

NUMBER = st.one_of(
    st.sampled_from(["0.1", "1", "2", "0.5"]),
    st.sampled_from(["nan", "inf", "-inf", "0", "-1", "1e30", "-1e30", "1e300", "1e-30", "7"]),
)


def tuples(length: int) -> st.SearchStrategy:
    """A vector, mostly of numbers that may be."""
    return st.lists(NUMBER, min_size=length, max_size=length).map(lambda values: f"({', '.join(values)})")


def arrays(of: st.SearchStrategy, most: int = 9) -> st.SearchStrategy:
    return st.lists(of, max_size=most).map(lambda values: f"[{', '.join(values)}]")


INTEGERS = arrays(st.one_of(st.integers(0, 4), st.sampled_from([-1, 3, 7, 10**6, 2**31 - 1])).map(str), 12)
PATHS = ["</World/A>", "</World/B>", "</World/C/inner>", "</World>", "</World/none>", "</Other>"]
TARGETS_OF = st.lists(st.sampled_from(PATHS), min_size=1, max_size=3, unique=True).map(
    lambda found: f"[{', '.join(found)}]"
)
SOLID = "[3, 3, 3, 3]", "[0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]", "[(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]"

ATTRIBUTES: dict[str, st.SearchStrategy] = {
    "double radius": NUMBER,
    "double height": NUMBER,
    "double size": NUMBER,
    "double width": NUMBER,
    "token axis": st.sampled_from(['"X"', '"Z"', '"W"', '""']),
    "double3 xformOp:translate": tuples(3),
    "double3 xformOp:scale": tuples(3),
    "quatf xformOp:orient": tuples(4),
    "matrix4d xformOp:transform": st.lists(tuples(4), min_size=4, max_size=4).map(lambda rows: f"({', '.join(rows)})"),
    "float physics:mass": NUMBER,
    "float physics:density": NUMBER,
    "point3f physics:centerOfMass": tuples(3),
    "float3 physics:diagonalInertia": tuples(3),
    "quatf physics:principalAxes": tuples(4),
    "vector3f physics:velocity": tuples(3),
    "vector3f physics:angularVelocity": tuples(3),
    "bool physics:kinematicEnabled": st.sampled_from(["0", "1"]),
    "bool physics:rigidBodyEnabled": st.sampled_from(["0", "1"]),
    "token physics:approximation": st.sampled_from(['"none"', '"convexHull"', '"what"']),
    "float physics:dynamicFriction": NUMBER,
    "float physics:staticFriction": NUMBER,
    "float physics:restitution": NUMBER,
    "float newton:rollingFriction": NUMBER,
    "int newton:sdfMaxResolution": st.sampled_from(["8", "16", "-1", "7", "513", "2147483647"]),
    "float newton:sdfTargetVoxelSize": st.sampled_from(["0.2", "nan", "inf", "-1", "0"]),
    "int[] faceVertexCounts": st.one_of(st.just(SOLID[0]), INTEGERS),
    "int[] faceVertexIndices": st.one_of(st.just(SOLID[1]), INTEGERS),
    "point3f[] points": st.one_of(st.just(SOLID[2]), arrays(tuples(3))),
    "int[] protoIndices": INTEGERS,
    "point3f[] positions": arrays(tuples(3)),
    "quath[] orientations": arrays(tuples(4)),
    "int64[] invisibleIds": INTEGERS,
    "rel prototypes": TARGETS_OF,
    "rel physics:filteredPairs": TARGETS_OF,
    "rel physics:simulationOwner": TARGETS_OF,
    "rel material:binding:physics": TARGETS_OF,
    "rel physics:body0": TARGETS_OF,
    "vector3f physics:gravityDirection": tuples(3),
    "float physics:gravityMagnitude": NUMBER,
    "prepend rel collection:colliders:includes": TARGETS_OF,
    "rel physics:filteredGroups": TARGETS_OF,
}
KINDS = [
    "Sphere", "Cube", "Capsule", "Cylinder", "Cone", "Plane", "Mesh", "Mesh", "PointInstancer", "Xform", "Points",
    "PhysicsScene", "PhysicsRevoluteJoint", "PhysicsCollisionGroup", "Material", "Nonsense",
]  # fmt: skip
APIS = [
    "PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "PhysicsMeshCollisionAPI", "PhysicsMaterialAPI",
    "PhysicsFilteredPairsAPI", "PhysicsArticulationRootAPI", "NewtonMaterialAPI", "NonsenseAPI",
]  # fmt: skip
MARKS = [
    "int sdfResolution", "int heightfieldRows", "int heightfieldColumns", "string motion",
    "double heightfieldFrequency", "double[] heightfieldHeights", "string frictionCombine",
    "double3[] pointFieldCenters", "double[] pointFieldStrengths", "double3[] uniformFieldAccelerations",
]  # fmt: skip
MARKED = {
    "int": st.sampled_from(["8", "2", "0", "-1", "600"]),
    "string": st.sampled_from(['"static"', '"min"', '"x"']),
    "double": NUMBER,
    "double[]": arrays(NUMBER, 4),
    "double3[]": arrays(tuples(3), 2),
}
ARC = st.tuples(
    st.sampled_from(["references", "payload", "inherits", "specializes"]),
    st.sampled_from([*PATHS, "@none.usda@", "@/etc/passwd@", "@.@"]),
).filter(lambda arc: not (arc[0] in ("inherits", "specializes") and "@" in arc[1]))

NOTHING = [st.just([])] * 3


def quoted(words: list[str]) -> str:
    return ", ".join(f'"{word}"' for word in words)


@st.composite
def prims(draw: Any, name: str, inner: bool = False) -> str:
    """A prim: with any attributes, schemas, references and own data."""
    usual = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"]
    apis = draw(st.one_of(st.just(usual), st.lists(st.sampled_from(APIS), unique=True, max_size=4)))
    head = [f"prepend apiSchemas = [{quoted(apis)}]"] * bool(apis)
    head += [f"prepend {kind} = {target}" for kind, target in draw(st.one_of(*NOTHING, st.lists(ARC, max_size=1)))]
    head += ["instanceable = true"] * draw(st.booleans())
    own = [f"{mark} = {draw(MARKED[mark.split()[0]])}" for mark in draw(st.lists(st.sampled_from(MARKS), max_size=3))]
    if own:
        head.append(f"customData = {{ dictionary warp_rigid = {{ {'; '.join(own)} }} }}")
    names = draw(st.lists(st.sampled_from(sorted(ATTRIBUTES)), unique=True, max_size=8))
    body = [f"{name} = {draw(ATTRIBUTES[name])}" for name in names]
    operations = [name.split()[1] for name in names if "xformOp" in name]
    if operations:
        body.append(f"uniform token[] xformOpOrder = [{quoted(operations)}]")
    if inner:
        body.append(draw(prims("inner")))
    return f'def {draw(st.sampled_from(KINDS))} "{name}" (\n' + "\n".join(head) + "\n)\n{\n" + "\n".join(body) + "\n}\n"


@st.composite
def scenes(draw: Any) -> bytes:
    """A stage of some such prims."""
    up = draw(st.sampled_from(['"Z"', '"Z"', '"Y"', '"X"']))
    head = HEAD.format(up=up, meters=draw(st.one_of(st.just("1"), NUMBER)))
    inside = "".join(draw(prims(name, draw(st.booleans()))) for name in "ABC"[: draw(st.integers(1, 3))])
    return f'{head}def Xform "World"\n{{\n{inside}}}\n'.encode()


BALL = 'def Sphere "P0" (\nprepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"]\n)\n{\n}\n'


def doubling(levels: int, how: str) -> str:
    """Prims that refer twice to the level below: two to the power of the levels in all."""
    text = BALL
    for level in range(1, levels + 1):
        arc = f"prepend references = </P{level - 1}>" + "\ninstanceable = true" * (how == "instances")
        inside = "".join(f'def "{name}" (\n{arc}\n)\n{{\n}}\n' for name in "ab")
        if how == "instancers":
            inside = (
                f'def PointInstancer "I"\n{{\nrel prototypes = [</P{level - 1}>]\nint[] protoIndices = [0, 0]\n'
                f"point3f[] positions = [(0, 0, 0), ({3 * 2 ** min(level, 60)}, 0, 0)]\n}}\n"
            )
        text += f'def Xform "P{level}"\n{{\n{inside}}}\n'
    return text


def chain(length: int, how: str) -> str:
    """Prims each of which refers to the next one."""
    arc = "prepend references = </P{}>" if how == "instances" else "prepend inherits = </P{}>"
    return BALL + "".join(f'def "P{i}" (\n{arc.format(i - 1)}\n)\n{{\n}}\n' for i in range(1, length))


def nest(depth: int, how: str) -> str:
    """Prims, or dictionaries, within each other."""
    if how == "instances":
        return 'def "a" {\n' * depth + BALL + "}\n" * depth
    return 'def "a" (\ncustomData = {\n' + "dictionary a = {\n" * depth + "}\n" * depth + "}\n)\n{\n}\n" + BALL


HOW = st.sampled_from(["references", "instances", "instancers"])
FAR_TOO_MUCH = st.one_of(
    st.builds(doubling, st.sampled_from([1, 3, 5, 40, 90, 3000]), HOW),
    st.builds(chain, st.sampled_from([2, 50, 150, 3000]), HOW),
    st.builds(nest, st.sampled_from([3, 900, 1100, 20_000, 100_000]), HOW),
).map(lambda text: ("#usda 1.0\n" + text).encode())


@functools.cache
def is_finite(suffix: str) -> bytes:
    """A file that this package wrote."""
    scene = wr.Scene()
    scene.add_static(wr.Plane())
    scene.add_body(wr.Box((0.1, 0.1, 0.1)), position=(0, 0, 0.1))
    corners, faces = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    scene.add_body(wr.Mesh(corners, faces, 8), position=(0, 0, 1))
    sim = wr.Simulator(scene, device="cpu")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"file{suffix}"
        wr.export_usd(wr.record(sim, 2), path)
        return path.read_bytes()


@st.composite
def damaged_files(draw: Any) -> tuple[str, bytes]:
    suffix = draw(st.sampled_from([".usda", ".usda", ".usdc", ".usdz", ".usd"]))
    return suffix, draw(damaged(is_finite(".usdc" if suffix == ".usd" else suffix)))


def try_file(case: tuple[str, bytes, str], folder: Path) -> None:
    """What can be done with a file."""
    suffix, content, use = case
    path = folder / f"file{suffix}"
    path.write_bytes(content)
    if use in ("import", "strict", "root"):
        root = "/World" if use == "root" else None
        scene = wr.import_usd(path, root, strict=use == "strict", sdf_resolution=8)
        str(scene.import_report)
        if len(scene.bodies) < 50:
            wr.Simulator(scene, device="cpu").step(1)
    elif use == "check":
        [str(problem) for problem in check_usd(path)]
    elif use == "flatten":
        flatten_usd(path, folder / "flat.usda")
    elif use == "mesh":
        wr.Mesh.from_file(path, sdf_resolution=8)
    else:
        film_duration(path)
        film_from_usd(path)


USES = ["import", "import", "import", "strict", "root", "check", "flatten", "mesh", "film"]
SOME_USE = st.sampled_from(USES)


def text(content: st.SearchStrategy) -> st.SearchStrategy:
    return st.tuples(st.just(".usda"), content, SOME_USE)


TARGETS = [
    Target("usd scenes", text(scenes()), try_file),
    Target("usd of far too much", text(FAR_TOO_MUCH), try_file),
    Target("usd files", st.tuples(damaged_files(), SOME_USE).map(lambda case: (*case[0], case[1])), try_file),
]
