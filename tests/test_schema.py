"""The declarations of arrays, and what follows from them: structs, packed records, slices and the page of arrays."""

import ast
import importlib.util
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_rigid import Box, Scene, Settings
from warp_rigid.engine import model
from warp_rigid.engine.layout import layout_of
from warp_rigid.kernels import declare, enums, schema
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.joints import arrays
from warp_rigid.scene.shapes import HarmonicMotion, Heightfield

wp.set_module_options({"enable_backward": False})

ROOT = Path(__file__).resolve().parents[1]
KERNELS = sorted((ROOT / "kernels").rglob("*.py"))
DECLARED = {**declare.LAYOUTS, **declare.RECORDS}
ROWS = 37
BASE_UNITS = {"kg", "m", "s", "rad", "N", "J", "1"}
SYMBOLS = {**schema.SYMBOLS, **arrays.SYMBOLS}
CONTACT_FLAG = {"flag": "more", "optional_from": "surface"}


def make_arrays():
    """The program that writes the page of arrays."""
    spec = importlib.util.spec_from_file_location("make_arrays", ROOT / "docs" / "make_arrays.py")
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    return program


def fields():
    return [(struct, name, field) for struct, members in DECLARED.items() for name, field in members.items()]


def test_the_page_of_arrays_follows_the_declarations():
    assert (ROOT / "docs" / "arrays.md").read_text() == make_arrays().page(), "run docs/make_arrays.py"


def test_the_page_names_every_array_and_every_member():
    """Read from the page's text: a table that is left out would pass the test above."""
    sections = dict(part.split("\n", 1) for part in (ROOT / "docs" / "arrays.md").read_text().split("\n### ")[1:])
    for struct, name, field in fields():
        if not name.startswith("padding_"):
            (row,) = [line for line in sections[struct].splitlines() if line.startswith(f"`{name}` ")]
            assert row.endswith(f" | {field.description}")
            assert re.findall(r" \[([^]]*)\] ?\w* \|", row) == ([field.unit] if field.unit else [])
    for name, kind in vars(enums).items():
        if isinstance(kind, type) and kind.__module__ == enums.__name__:
            for member, value in kind.__members__.items():
                assert re.search(rf"`{member}`: {value.value}\b", sections[name])


def test_every_array_and_member_is_described():
    assert [f"{struct}.{name}" for struct, name, field in fields() if not field.description.strip()] == []
    assert [name for name in DECLARED if not declare.DESCRIPTIONS[name].strip()] == []


def test_units_are_products_of_si_units():
    """A unit is written as "N m s" or "1/(kg m^2)"; "SI" stands for several."""
    for struct, name, field in fields():
        symbols = field.unit.replace("/", " ").replace("(", " ").replace(")", " ").replace("^2", "").split()
        assert field.unit == "SI" or set(symbols) <= BASE_UNITS, f"{struct}.{name} [{field.unit}]"


def test_shapes_are_sums_of_known_symbols_and_numbers():
    known = set(SYMBOLS)
    used = set()
    for struct, members in declare.LAYOUTS.items():
        for name, field in members.items():
            terms = {term.strip() for size in field.shape.split(",") for term in size.split("+")}
            symbols = {term for term in terms if not term.isdigit()}
            assert symbols <= known, f"{struct}.{name} ({field.shape})"
            assert {field.index_of} <= known | {""}, f"{struct}.{name} counts {field.index_of}"
            used |= symbols
    assert set(SYMBOLS) == used & set(SYMBOLS), "a symbol that no array has"
    assert {field.shape for members in declare.RECORDS.values() for field in members.values()} == {""}


@pytest.mark.parametrize("struct", DECLARED)
def test_a_struct_has_the_declared_members(struct):
    declared = DECLARED[struct]
    made = declare.STRUCTS[struct].vars
    assert list(made) == list(declared)
    for name, field in declared.items():
        if struct in declare.RECORDS:
            assert wp.types.type_size_in_bytes(made[name].type) == wp.types.type_size_in_bytes(field.dtype)
            assert wp.types.types_equal(made[name].type, field.dtype)
        else:
            assert wp.types.types_equal(made[name].type.dtype, field.dtype)
            assert made[name].type.ndim == len(field.shape.split(","))


@pytest.mark.parametrize("struct", declare.LAYOUTS)
def test_arrays_are_allocated_with_the_declared_sizes(struct):
    """Symbols stand for different primes, so that no two shapes agree by accident."""
    primes = [n for n in range(2, 150) if all(n % k for k in range(2, n))]
    sizes = dict(zip(SYMBOLS, primes[: len(SYMBOLS)], strict=True))
    arrays = declare.allocate(declare.STRUCTS[struct], sizes, "cpu")
    total = 0
    for name, field in declare.LAYOUTS[struct].items():
        array = getattr(arrays, name)
        assert array.shape == tuple(eval(size, {}, sizes) for size in field.shape.split(","))
        assert (array.numpy() == field.start).all() if field.start else not array.numpy().view(np.uint8).any()
        total += array.size * array.strides[-1]
    assert declare.byte_size(declare.STRUCTS[struct], sizes) == total


@pytest.mark.parametrize("name", declare.PACKED)
def test_words_of_a_packed_record_are_those_of_its_memory(name):
    """Against the layout that Warp gives to NumPy. No member but one of a whole group crosses a group's end."""
    record = declare.STRUCTS[name]
    layout = record.numpy_dtype()
    dtype = np.dtype(layout)
    assert dtype.itemsize % 16 == 0
    for key in dtype.names:
        member, offset = dtype.fields[key][:2]
        assert offset == 4 * declare.first_word(record, key)
        assert offset // 16 == declare.group_of(record, key) == (offset + member.itemsize - 1) // 16
    with pytest.raises(KeyError, match="no member nothing"):
        declare.first_word(record, "nothing")


def random_records(name, seed):
    """Records whose members are random and not 0, with padding 0."""
    rng = np.random.default_rng(seed)
    records = np.zeros(ROWS, np.dtype(declare.STRUCTS[name].numpy_dtype()))
    for key in records.dtype.names:
        if not key.startswith("padding_"):
            member = records[key]
            numbers = rng.integers(1, 1 << 24, member.shape) * rng.choice([-1, 1], member.shape)
            records[key] = numbers if member.dtype == np.int32 else numbers / 4096.0
    return records


def is_of_integers(name):
    return all(field.dtype is int for field in declare.RECORDS[name].values())


def kernel_of(function, key):
    """A kernel of the module in which those of all records are compiled at once."""
    module = wp.get_module(f"{__name__}.records")
    module.options["enable_backward"] = False
    return wp.Kernel(function, key=key, module=module)


def copies(name, read, write, key):
    """Kernels that copy records with a device function: read by `read`, and written by `write`, if there is one."""
    record = declare.STRUCTS[name]

    def copy_read(source: wp.array[record], target: wp.array[record]):
        row = wp.tid()
        target[row] = read(row, source)

    def copy_written(source: wp.array[record], target: wp.array[record]):
        row = wp.tid()
        write(row, source[row], target)

    return kernel_of(copy_read, f"read_{key}"), write and kernel_of(copy_written, f"write_{key}")


def copies_of_groups(name):
    """Kernels that read all groups of records, and, unless they are of integers, write one."""
    record = declare.STRUCTS[name]
    four = wp.vec4i if is_of_integers(name) else wp.vec4
    read = declare.group_reader(record)

    def copy(source: wp.array[record], target: wp.array2d[four]):
        row, group = wp.tid()
        target[row, group] = read(source, row, group)

    if is_of_integers(name):
        return kernel_of(copy, f"groups_{name}"), None
    write = declare.group_writer(record)

    def change(group: int, target: wp.array[record]):
        row = wp.tid()
        write(target, row, group, wp.vec3(1.5, float(row), -2.0), float(group))

    return kernel_of(copy, f"groups_{name}"), kernel_of(change, f"change_{name}")


@pytest.fixture(scope="module")
def made():
    """The kernels that read and write packed records, by name: whole ones, groups, and contacts with a flag."""
    whole = {
        name: copies(
            name,
            declare.record_reader(declare.STRUCTS[name]),
            None if is_of_integers(name) else declare.record_writer(declare.STRUCTS[name]),
            name,
        )
        for name in declare.PACKED
    }
    groups = {name: copies_of_groups(name) for name in declare.PACKED}
    contacts = copies("ContactRecord", contact.read_contact, contact.write_contact, "contact")
    return SimpleNamespace(whole=whole, groups=groups, contacts=contacts)


def copied(kernel, name, source, device):
    """Records that a kernel copies; what its device function does not do, Warp does member by member."""
    record = declare.STRUCTS[name]
    given = wp.array(source, dtype=record, device=device)
    target = wp.zeros(len(source), dtype=record, device=device)
    wp.launch(kernel, len(source), [given], [target], device=device)
    return target.numpy()


@pytest.mark.parametrize("name", declare.PACKED)
def test_packed_records_are_read_and_written_whole(name, device, made):
    records = random_records(name, seed=1)
    for kernel in filter(None, made.whole[name]):
        np.testing.assert_array_equal(copied(kernel, name, records, device), records)


@pytest.mark.parametrize("name", declare.PACKED)
def test_groups_are_the_words_of_a_record(name, device, made):
    record, records = declare.STRUCTS[name], random_records(name, seed=2)
    word, four = (np.int32, wp.vec4i) if is_of_integers(name) else (np.float32, wp.vec4)
    words = records.view(word).reshape(ROWS, -1, 4)
    given = wp.array(records, dtype=record, device=device)
    target = wp.zeros(words.shape[:2], dtype=four, device=device)
    wp.launch(made.groups[name][0], words.shape[:2], [given], [target], device=device)
    np.testing.assert_array_equal(target.numpy(), words)


@pytest.mark.parametrize("name", [name for name in declare.PACKED if not is_of_integers(name)])
def test_a_group_is_written_alone(name, device, made):
    record, records = declare.STRUCTS[name], random_records(name, seed=3)
    groups = records.dtype.itemsize // 16
    for group in {0, groups // 2, groups - 1}:
        target = wp.array(records, dtype=record, device=device)
        wp.launch(made.groups[name][1], ROWS, [group], [target], device=device)
        expected = records.copy().view(np.float32).reshape(ROWS, -1, 4)
        expected[:, group] = [[1.5, row, -2.0, group] for row in range(ROWS)]
        found = target.numpy().view(np.float32).reshape(ROWS, -1, 4)
        np.testing.assert_array_equal(found, expected)


OPTIONAL = ("surface", "rolling_friction", "spinning_friction", "restitution")


def test_the_optional_members_of_a_contact_are_the_last_ones():
    members = [name for name in declare.RECORDS["ContactRecord"] if not name.startswith("padding_")]
    assert tuple(members[members.index("surface") :]) == OPTIONAL
    assert declare.first_word(schema.ContactRecord, "surface") % 4 == 0


@pytest.mark.parametrize("name", OPTIONAL)
def test_a_contact_notes_whether_it_has_optional_members(name, device, made):
    """One optional member of every second record is not 0, in one component; the flag follows from the members."""
    records = random_records("ContactRecord", seed=4)
    for other in OPTIONAL:
        records[other] = 0.0
    some = np.arange(0, ROWS, 2)
    if records[name].ndim == 2:
        records[name][some, some % 3] = -0.25
    else:
        records[name][some] = 0.25
    read, write = made.contacts
    written = copied(write, "ContactRecord", records, device)
    expected = records.copy()
    expected["more"] = np.arange(ROWS) % 2 == 0
    np.testing.assert_array_equal(written, expected)
    np.testing.assert_array_equal(copied(read, "ContactRecord", written, device), expected)


def test_a_contact_without_the_flag_has_optional_members_of_0(device, made):
    """What an earlier contact left in the memory behind the flag is not read."""
    records = random_records("ContactRecord", seed=5)
    records["more"] = np.arange(ROWS) % 2
    expected = records.copy()
    for name in OPTIONAL:
        expected[name][::2] = 0.0
    np.testing.assert_array_equal(copied(made.contacts[0], "ContactRecord", records, device), expected)


def scene_with_filters_and_moving_ground(moving):
    scene = Scene()
    if moving:
        waves = HarmonicMotion(0.01, 2.0, 0.0)
        scene.add_kinematic(Heightfield(np.zeros((4, 3)), (3.0, 2.0), waves))
    for i in range(4):
        scene.add_body(Box((0.1 + 0.01 * i,) * 3), position=(i, 0, 1), friction=0.1 * i)
    scene.filter_pair(0, 2)
    scene.filter_pair(1, 2)
    return scene


@pytest.mark.parametrize("moving", [False, True])
def test_a_part_of_the_arrays_counts_from_its_own_start(moving):
    """Environments 1 and 2 of 3 are what a model of 2 has. Places in the pool of shapes stay those of the whole."""
    scene = scene_with_filters_and_moving_ground(moving)
    whole, alone = (model.build_model(layout_of(scene, count), "cpu") for count in (3, 2))
    part = whole.part(1, 3)
    for struct, pooled in (("bodies", "shape"), ("surfaces", "sample")):
        found, expected = getattr(part, struct), getattr(alone, struct)
        for name in declare.field_names(found._cls):
            if name != pooled:
                np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(expected, name).numpy(), name)
    ranges = layout_of(scene, 3).ranges(1, 3)
    envs, expected = (model.initial_environments(layout_of(scene, count), Settings(), "cpu") for count in (3, 2))
    first_body = declare.part(envs, ranges).first_body.numpy()
    np.testing.assert_array_equal(first_body, expected.first_body.numpy())


def test_a_part_shares_memory_with_the_whole():
    scene = scene_with_filters_and_moving_ground(moving=False)
    state = model.initial_state(layout_of(scene, 3), "cpu")
    part = declare.part(state, layout_of(scene, 3).ranges(1, 3))
    part.position.fill_(wp.vec3(7.0, 8.0, 9.0))
    changed = (state.position.numpy() == [7.0, 8.0, 9.0]).all(axis=1)
    np.testing.assert_array_equal(changed, np.arange(3 * len(scene.bodies)) >= len(scene.bodies))


def test_a_part_without_rows_has_a_row_of_its_own():
    """A scene without filtered pairs between and behind others: a row of the others would be undone with its shard."""
    plain = Scene()
    plain.add_body(Box((1, 1, 1)))
    layout = layout_of([plain, scene_with_filters_and_moving_ground(moving=False), plain], 1)
    whole = model.build_model(layout, "cpu")
    parts = [whole.part(env, env + 1).bodies.filtered for env in range(3)]
    assert [part.shape for part in parts] == [(1,), (4,), (1,)]
    assert len({part.ptr for part in parts}) == 3 and parts[1].ptr == whole.bodies.filtered.ptr


def repeated_members(source):
    """Constants of a module that have the name and the value of a member of an enumeration, and bare numbers that
    something named after an enumeration is compared with."""
    kinds = [kind for kind in vars(enums).values() if isinstance(kind, type) and kind.__module__ == enums.__name__]
    members = {(name, int(member)) for kind in kinds for name, member in kind.__members__.items()}
    tree = ast.parse(source)
    found = []
    for node in tree.body:
        if isinstance(node, ast.Assign):
            value = node.value.args[0] if isinstance(node.value, ast.Call) and node.value.args else node.value
            if isinstance(value, ast.Constant):
                names = [target.id for target in node.targets if isinstance(target, ast.Name)]
                found += [
                    name
                    for name in names
                    for member, number in members
                    if value.value == number and (name == member or name.endswith(f"_{member}"))
                ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            named = {ast.unparse(side).split("[")[0].split(".")[-1] for side in sides}
            if named & {"kind", "motion", "role", "shock_propagation"} and any(
                isinstance(side, ast.Constant) and isinstance(side.value, int) for side in sides
            ):
                found.append(ast.unparse(node))
    return found


def test_a_member_of_an_enumeration_is_not_written_again():
    found = {file.name: repeated_members(file.read_text()) for file in KERNELS if file.name != "enums.py"}
    assert {name: members for name, members in found.items() if members} == {}


@pytest.mark.parametrize(
    "source",
    [
        "HEIGHTFIELD = 6",
        "SAMPLE_EDGE = wp.constant(1)",
        "def f(kind: int):\n    return kind == 3",
        "if bodies.motion[b] != 2: pass",
    ],
)
def test_a_repeated_member_is_found(source):
    assert len(repeated_members(source)) == 1
