"""Write docs/arrays.md: all device arrays and enumerations, from their declarations in kernels/.

Run it from the top of the repository: `.venv/bin/python docs/make_arrays.py`.
"""

import ast
import inspect
from collections import Counter
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any

import warp_rigid.kernels.collide.near_samples  # noqa: F401  declares the list of near samples
from warp_rigid.kernels import declare, enums, schema
from warp_rigid.kernels.graph import heap_arrays  # noqa: F401  declares the arrays of heaps
from warp_rigid.kernels.joints import arrays

PAGE = Path(__file__).parent / "arrays.md"

INTRODUCTION = """
# Arrays

All device arrays, as declared in `kernels/schema.py`; the Warp structs, the allocation and the packing of records
follow from the same declarations. The rows of all environments are in one array: the bodies of environment `e` are
rows `first_body[e]` to before `first_body[e + 1]`. `docs/make_arrays.py` generates this page.

## Sizes

The name of an array is followed by its type, its shape in parentheses, its unit in brackets and its lifetime. The first
dimension of a shape is a symbol, or a symbol plus a number. No array is empty: a size of 0 becomes 1.
"""

LIFETIMES = """
## Lifetimes

The lifetime of an array states who writes its values and how long they are valid. It decides what a reset, a checkpoint
and the undoing of a step work on.
"""

RECORDS = """
## Records

Records are elements of arrays. A packed record consists of groups of 16 bytes, each of which a GPU reads or writes
with one request. Unused bytes at the end of a group are not listed.
"""

ENUMERATIONS = """
## Enumerations

Integers shared by the host and the kernels, as declared in `kernels/enums.py`.
"""


def page() -> str:
    """The whole page."""
    symbols = {**schema.SYMBOLS, **arrays.JOINT_SYMBOLS}
    sizes = table("symbol", "counts", rows=[(f"`{name}`", text) for name, text in symbols.items()])
    lifetimes = table("lifetime", "values", rows=[(f"`{one.name.lower()}`", one.value) for one in declare.Lifetime])
    structs = [section(name, struct_table(fields)) for name, fields in declare.LAYOUTS.items()]
    records = [section(name, record_table(name, fields)) for name, fields in declare.RECORDS.items()]
    parts = [
        INTRODUCTION,
        sizes,
        LIFETIMES,
        lifetimes,
        "## Structs of arrays",
        *structs,
        RECORDS,
        *records,
        ENUMERATIONS,
        *enumerations(),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def section(name: str, content: str) -> str:
    """A struct or a record with its description."""
    return f"### {name}\n\n{declare.DESCRIPTIONS[name]}\n\n{content}"


def struct_table(fields: dict[str, declare.Field]) -> str:
    """The arrays of a struct. The most frequent shape and lifetime are stated once, above the table."""
    shape = Counter(f.shape for f in fields.values()).most_common(1)[0][0]
    lifetime = Counter(f.lifetime for f in fields.values()).most_common(1)[0][0]
    lines = []
    for key, f in fields.items():
        told = declaration(key, f, shape=f.shape != shape)
        told += f" {f.lifetime.name.lower()}" if f.lifetime != lifetime else ""
        lines.append((told, f.description))
    same = all((f.shape, f.lifetime) == (shape, lifetime) for f in fields.values())
    above = f"Shape ({shape}), lifetime {lifetime.name.lower()}{'' if same else ' unless stated'}."
    return f"{above}\n\n{table('array', 'description', rows=lines)}"


def record_table(name: str, fields: dict[str, declare.Field]) -> str:
    """The members of a record, in the order of their place in it."""
    lines = [
        (declaration(key, f, shape=False), f.description)
        for key, f in fields.items()
        if not key.startswith(declare.PADDING)
    ]
    size = f"{declare.STRUCTS[name].numpy_dtype()['itemsize']} bytes{', packed' if name in declare.PACKED else ''}."
    return size + "\n\n" + table("member", "description", rows=lines)


def declaration(name: str, field: declare.Field, shape: bool) -> str:
    """As in "`mass` float32 (bodies) [kg]"."""
    parts = [f"`{name}`", type_name(field.dtype)]
    if shape:
        parts.append(f"({field.shape})")
    if field.unit:
        parts.append(f"[{field.unit}]")
    return " ".join(parts)


def enumerations() -> Iterator[str]:
    """All enumerations. The descriptions of their members are strings below them in the source."""
    for node in ast.parse(inspect.getsource(enums)).body:
        if isinstance(node, ast.ClassDef):
            yield enumeration(node, getattr(enums, node.name))


def enumeration(node: ast.ClassDef, declared: type[IntEnum]) -> str:
    """One enumeration: a list if a member has a description, else a line."""
    described = {
        above.targets[0].id: below.value.value
        for above, below in zip(node.body, node.body[1:], strict=False)
        if isinstance(above, ast.Assign) and isinstance(below, ast.Expr)
    }
    members = [f"`{name}`: {int(value)}" for name, value in declared.__members__.items()]
    line = ", ".join(members) + "."
    if described:
        texts = [f", {described[name]}" if name in described else "." for name in declared.__members__]
        line = "\n".join(f"- {member}{text}" for member, text in zip(members, texts, strict=True))
    return f"### {node.name}\n\n{inspect.getdoc(declared)}\n\n{line}"


def table(*columns: str, rows: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    lines = [columns, ("---",) * len(columns), *rows]
    return "\n".join(" | ".join(cell.replace("|", r"\|") for cell in line).rstrip() for line in lines)


def type_name(dtype: Any) -> str:
    """An element type; a record links to its table."""
    if dtype in (int, float):
        return f"{dtype.__name__}32"
    return dtype.__name__ if isinstance(dtype, type) else f"[{dtype.key}](#{dtype.key.lower()})"


if __name__ == "__main__":
    PAGE.write_text(page())
