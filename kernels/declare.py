"""Declarations of device arrays, and what is derived from them: Warp structs, allocation, packing and slices.

`schema` declares the arrays of the simulator with these functions. A declaration states a field's element type, its
symbolic shape, its unit, a description and its lifetime, from which follows what a reset, a checkpoint and the undoing
of a step work on. Records are elements of arrays; packed records are laid out in groups of
four words, so that a GPU reads each group with one 16-byte load.
"""

from collections.abc import Iterator, Mapping
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp


class Lifetime(Enum):
    """How long the values of an array are valid, and who writes them."""

    STEP = "written by each step before it reads it"
    SCENE = "follows from the scenes; no step changes it"
    SETTING = "users may change it, no step does; a reset keeps it"
    REMEMBERED = "left by a step to the next one, or to users; a reset returns it to its start"
    REUSED = "a step may reuse it instead of computing it again, with the same results"


class Field(NamedTuple):
    """One device array or one member of a record.

    Attributes:
        dtype: element type.
        shape: symbolic, such as "bodies + 1" or "pairs, 36"; empty for a member of a record.
        unit: SI unit; empty for pure numbers, indices and flags.
        description: contents.
        index_of: if the values are row indices, the symbol of the indexed rows; in a slice they count from its start.
        lifetime: of the values; None for that of the layout.
        start: value before the first step. For a reused array it is the one with which the next step computes the
            struct again; None where the step then does not read it.
    """

    dtype: Any
    shape: str
    unit: str
    description: str
    index_of: str = ""
    lifetime: Lifetime | None = None
    start: float | None = None


Fixed = partial(Field, lifetime=Lifetime.SCENE)
Setting = partial(Field, lifetime=Lifetime.SETTING)
Remembered = partial(Field, lifetime=Lifetime.REMEMBERED)
Reused = partial(Field, lifetime=Lifetime.REUSED)
Scratch = partial(Field, lifetime=Lifetime.STEP)

LAYOUTS: dict[str, dict[str, Field]] = {}
"""Declared structs of arrays, and their fields."""

RECORDS: dict[str, dict[str, Field]] = {}
"""Declared array elements, and their fields."""

DESCRIPTIONS: dict[str, str] = {}
"""Description of each declared struct or record."""

STRUCTS: dict[str, Any] = {}
"""The Warp struct of each declared struct or record."""

PACKED: list[str] = []
"""Names of the packed records."""

WORDS: dict[Any, int] = {float: 1, int: 1, wp.vec2: 2, wp.vec3: 3, wp.vec4: 4}
"""Size of a member of a packed record, in words of four bytes."""

WORDS_OF_A_GROUP = 4

PADDING = "padding_"
"""Start of the names of members that only fill a group."""


def layout(name: str, doc: str, lifetime: Lifetime = Lifetime.STEP, **fields: Field) -> Any:
    """Declare a Warp struct whose members are the arrays `fields`; `lifetime` is that of those that state none."""
    fields = {key: field._replace(lifetime=field.lifetime or lifetime) for key, field in fields.items()}
    annotations = {key: wp.array(dtype=f.dtype, ndim=f.shape.count(",") + 1) for key, f in fields.items()}
    LAYOUTS[name] = fields
    return _struct(name, doc, annotations)


def record(name: str, doc: str, **fields: Field) -> Any:
    """Declare a Warp struct that is the element of an array."""
    RECORDS[name] = fields
    return _struct(name, doc, {key: f.dtype for key, f in fields.items()})


def packed_record(name: str, doc: str, **fields: Field) -> Any:
    """Declare a record in groups of four words; a member that does not fit into a group starts the next one."""
    padded: dict[str, Field] = {}
    used = 0
    filler = int if all(field.dtype is int for field in fields.values()) else float
    for key, field in fields.items():
        left = -used % WORDS_OF_A_GROUP
        if WORDS[field.dtype] > left > 0:
            used = _pad(padded, used, left, filler)
        padded[key] = field
        used += WORDS[field.dtype]
    _pad(padded, used, -used % WORDS_OF_A_GROUP, filler)
    PACKED.append(name)
    return record(name, doc, **padded)


def _pad(fields: dict[str, Field], used: int, count: int, filler: type) -> int:
    for word in range(used, used + count):
        fields[f"{PADDING}{word}"] = Field(filler, "", "", "fills a group of four words")
    return used + count


def _struct(name: str, doc: str, annotations: dict[str, Any]) -> Any:
    DESCRIPTIONS[name] = doc
    STRUCTS[name] = wp.struct(type(name, (), {"__annotations__": annotations, "__module__": __name__, "__doc__": doc}))
    return STRUCTS[name]


def first_word(packed: Any, name: str) -> int:
    """The word of a packed record at which a member begins."""
    word = 0
    for key, field in RECORDS[packed.key].items():
        if key == name:
            return word
        word += WORDS[field.dtype]
    raise KeyError(f"{packed.key}: no member {name}")


def group_of(packed: Any, name: str) -> int:
    """The group of four words in which a member of a packed record begins."""
    return first_word(packed, name) // WORDS_OF_A_GROUP


IN_BOUNDS = "assert(row >= 0 && row < records.shape[0]);"
"""Native check of a row, which the compiler leaves out except in Warp's debug mode, as it does for other arrays."""


def group_reader(packed: Any) -> Any:
    """Return a device function (records, row, group) that reads four words of a packed record, as a vec4 or vec4i."""
    if _is_of_integers(packed):

        @wp.func_native(f"""
            {IN_BOUNDS}
            const int* p = (const int*)__builtin_assume_aligned((const int*)(records.data + row) + 4 * group, 16);
            return wp::vec_t<4, int>(p[0], p[1], p[2], p[3]);
        """)
        def read_group(records: wp.array[packed], row: int, group: int) -> wp.vec4i:
            """Four words of a record."""
            ...

    else:

        @wp.func_native(f"""
            {IN_BOUNDS}
            const float* p = (const float*)__builtin_assume_aligned((const float*)(records.data + row) + 4 * group, 16);
            return wp::vec4(p[0], p[1], p[2], p[3]);
        """)
        def read_group(records: wp.array[packed], row: int, group: int) -> wp.vec4:
            """Four words of a record."""
            ...

    return read_group


def group_writer(packed: Any) -> Any:
    """Return a device function (records, row, group, xyz, w) that writes four words of a packed record of floats."""

    @wp.func_native(f"""
        {IN_BOUNDS}
        float* p = (float*)__builtin_assume_aligned((float*)(records.data + row) + 4 * group, 16);
        p[0] = xyz[0]; p[1] = xyz[1]; p[2] = xyz[2]; p[3] = w;
    """)
    def write_group(records: wp.array[packed], row: int, group: int, xyz: wp.vec3, w: float):
        """Write four words of a record."""
        ...

    return write_group


def record_reader(packed: Any, flag: str = "", optional_from: str = "") -> Any:
    """Return a device function (row, records) that reads a packed record group by group.

    Args:
        packed: the record.
        flag: a float member that is 0 if all members from `optional_from` on are 0; these are then not read.
        optional_from: the first member that is not always read; it must start a group.
    """
    word = "int" if _is_of_integers(packed) else "float"
    lines = [
        IN_BOUNDS,
        f"const {word}* p = (const {word}*)__builtin_assume_aligned((const {word}*)(records.data + row), 16);",
    ]
    for group, members in _groups(packed).items():
        if flag and group == group_of(packed, optional_from):
            lines.append(f"if (value.{flag} == 0.0f) {{ return; }}")
        lines += [f"value.{key} = {_from_words(packed, key, 4 * group + first)};" for key, first in members]

    @wp.func_native("\n".join(lines))
    def fill_record(row: int, records: wp.array[packed], value: wp.ref[packed]):
        """Fill a record from a row of the array."""
        ...

    @wp.func
    def read_record(row: int, records: wp.array[packed]):
        """The record of a row."""
        value = packed()
        fill_record(row, records, value)
        return value

    return read_record


def record_writer(packed: Any, flag: str = "", optional_from: str = "") -> Any:
    """Return a device function (row, value, records) that writes a packed record group by group.

    `flag` is written as 1 where a member from `optional_from` on is not 0, else as 0; see `record_reader`.
    """
    words = {
        4 * group + first + k: f"value.{key}" + (f"[{k}]" if size > 1 else "")
        for group, members in _groups(packed).items()
        for key, first in members
        for size in [WORDS[RECORDS[packed.key][key].dtype]]
        for k in range(size)
    }
    if flag:
        optional = [text for word, text in words.items() if word >= first_word(packed, optional_from)]
        words[first_word(packed, flag)] = f"({' || '.join(f'{text} != 0.0f' for text in optional)}) ? 1.0f : 0.0f"
    lines = [IN_BOUNDS, "float* p = (float*)__builtin_assume_aligned((float*)(records.data + row), 16);"]
    integers = {first_word(packed, key) for key, field in RECORDS[packed.key].items() if field.dtype is int}
    lines += [f"{'((int*)p)' if word in integers else 'p'}[{word}] = {text};" for word, text in words.items()]

    @wp.func_native("\n".join(lines))
    def write_record(row: int, value: packed, records: wp.array[packed]):
        """Write the record of a row."""
        ...

    return write_record


def _is_of_integers(packed: Any) -> bool:
    return all(field.dtype is int for field in RECORDS[packed.key].values())


def _groups(packed: Any) -> dict[int, list[tuple[str, int]]]:
    """Members of each group of four words, with the word within the group at which each begins."""
    groups: dict[int, list[tuple[str, int]]] = {}
    for key in RECORDS[packed.key]:
        if not key.startswith(PADDING):
            word = first_word(packed, key)
            groups.setdefault(word // WORDS_OF_A_GROUP, []).append((key, word % WORDS_OF_A_GROUP))
    return groups


def _from_words(packed: Any, key: str, word: int) -> str:
    """Native expression that reads a member from the words `p` of its record."""
    dtype = RECORDS[packed.key][key].dtype
    size = WORDS[dtype]
    source = "((const int*)p)" if dtype is int else "p"
    words = ", ".join(f"{source}[{word + k}]" for k in range(size))
    return words if size == 1 else f"wp::vec{size}({words})"


def allocate(struct: Any, sizes: Mapping[str, int], device: Any) -> Any:
    """Return an instance of `struct` with all its arrays sized by the symbols in `sizes`, at their start or zero."""
    instance = struct()
    for key, field in LAYOUTS[struct.key].items():
        shape = tuple(extent(term, sizes) for term in field.shape.split(","))
        array = wp.zeros(shape, dtype=field.dtype, device=device)
        if field.start:
            array.fill_(field.start)
        setattr(instance, key, array)
    return instance


def upload(struct: Any, rows: Mapping[str, np.ndarray], device: Any) -> Any:
    """Return an instance of `struct` with the given rows; an array without rows gets one of zeros, so none is empty."""
    instance = struct()
    for key, field in LAYOUTS[struct.key].items():
        array = wp.array(rows[key], dtype=field.dtype, device=device)
        setattr(instance, key, array if array.size else wp.zeros(1, dtype=field.dtype, device=device))
    return instance


def clone(instance: Any) -> Any:
    """Return an instance of the same struct with copies of all arrays."""
    copy = type(instance)()
    for key in LAYOUTS[instance._cls.key]:
        setattr(copy, key, wp.clone(getattr(instance, key)))
    return copy


def part(whole: Any, ranges: Mapping[str, tuple[int, int]]) -> Any:
    """Return a struct of views of the same arrays, restricted to the rows first to end - 1 of each symbol in `ranges`.

    Only arrays of indices are copied, so that they count from the first row of the part.
    """
    struct = type(whole)()
    for key, field in LAYOUTS[whole._cls.key].items():
        array = getattr(whole, key)
        symbol, _, more = field.shape.split(",")[0].partition(" + ")
        if symbol in ranges:
            first, end = ranges[symbol]
            last = end + int(more or 0)
            # A part without rows gets a row of its own, as no array is empty and none is shared by two parts.
            array = array[first:last] if last > first else wp.zeros((1, *array.shape[1:]), array.dtype, array.device)
        if ranges.get(field.index_of, (0, 0))[0] > 0:
            array = wp.array(array.numpy() - ranges[field.index_of][0], dtype=field.dtype, device=array.device)
        setattr(struct, key, array)
    return struct


def byte_size(struct: Any, sizes: Mapping[str, int]) -> int:
    """Return the number of bytes that `allocate` would use."""
    total = 0
    for field in LAYOUTS[struct.key].values():
        count = 1
        for term in field.shape.split(","):
            count *= extent(term, sizes)
        total += count * wp.types.type_size_in_bytes(field.dtype)
    return total


def field_names(struct: Any) -> list[str]:
    """Return the names of the arrays of `struct`, in the order of their declaration."""
    return list(LAYOUTS[struct.key])


class Declared(NamedTuple):
    """An array of an instance, with its name and its declaration."""

    name: str
    field: Field
    array: Any


def arrays_of(instance: Any, *lifetimes: Lifetime) -> Iterator[Declared]:
    """Iterate over the arrays of an instance that have one of these lifetimes."""
    for name, field in LAYOUTS[instance._cls.key].items():
        if field.lifetime in lifetimes:
            yield Declared(name, field, getattr(instance, name))


def compute_again(instance: Any) -> None:
    """Let the next step compute what it could otherwise reuse of an instance."""
    for _, field, array in arrays_of(instance, Lifetime.REUSED):
        if field.start is not None:
            array.fill_(field.start)


def counted_by(field: Field) -> str:
    """The symbol that counts the rows of an array; arrays of sums have one row more."""
    return field.shape.split(",")[0].partition(" + ")[0]


def is_sum(field: Field) -> bool:
    """Whether an array has a row more than its symbol counts, as sums have."""
    return " + " in field.shape.split(",")[0]


def extent(term: str, sizes: Mapping[str, int]) -> int:
    """Evaluate a sum of symbols and numbers such as "bodies + 1"; at least 1, so that no array is empty."""
    parts = (part.strip() for part in term.split("+"))
    return max(1, sum(int(part) if part.isdigit() else sizes[part] for part in parts))
