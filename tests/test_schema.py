"""The declarations of arrays, and what follows from them: structs, packed records, slices and the page of arrays."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_rigid import Box, Scene
from warp_rigid.engine import model
from warp_rigid.engine.layout import layout_of
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.joints import arrays
from warp_rigid.scene.shapes import HarmonicMotion, Heightfield

wp.set_module_options({"enable_backward": False})

ROOT = Path(__file__).resolve().parents[1]
ROWS = 37
SYMBOLS = {**schema.SYMBOLS, **arrays.JOINT_SYMBOLS}


def make_arrays():
    """The program that writes the page of arrays."""
    spec = importlib.util.spec_from_file_location("make_arrays", ROOT / "docs" / "make_arrays.py")
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    return program


def test_the_page_of_arrays_follows_the_declarations():
    assert (ROOT / "docs" / "arrays.md").read_text() == make_arrays().page(), "run docs/make_arrays.py"


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


OPTIONAL = ("surface", "rolling_friction", "spinning_friction", "restitution", "surface_spin")


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


def test_a_part_without_rows_has_a_row_of_its_own():
    """A scene without filtered pairs between and behind others: a row of the others would be undone with its shard."""
    plain = Scene()
    plain.add_body(Box((1, 1, 1)))
    layout = layout_of([plain, scene_with_filters_and_moving_ground(moving=False), plain], 1)
    whole = model.build_model(layout, "cpu")
    parts = [whole.part(env, env + 1).bodies.filtered for env in range(3)]
    assert [part.shape for part in parts] == [(1,), (4,), (1,)]
    assert len({part.ptr for part in parts}) == 3 and parts[1].ptr == whole.bodies.filtered.ptr
