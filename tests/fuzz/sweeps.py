"""Sweeps: axes, designs, the command line, and tables that are damaged or made by something else."""

import functools
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
from hypothesis import strategies as st

import warp_rigid as wr
from tests.fuzz.files import PLAIN, change
from tests.fuzz.harness import NUMBERS, ODDITIES, Target, damaged
from tests.fuzz.settings import WORD
from warp_rigid.commands import cli
from warp_rigid.sweep import Choice, Integers, LogUniform, Normal, Uniform, execution, merge, read, search
from warp_rigid.sweep.axes import clean_axes, parse_axis
from warp_rigid.sweep.design import DESIGNS, make_points
from warp_rigid.sweep.table import METADATA

execution._commit()  # runs git once

NAMES = ["angle", "friction", "dt", "shock_propagation", "mass[box]", "gravity", "seed", "status", "x", ""]

NUMBER = st.one_of(st.integers(-1, 4), NUMBERS, WORD).map(str)
AXIS_TEXT = st.one_of(
    st.lists(NUMBER, min_size=1, max_size=4).map(":".join),
    st.lists(NUMBER, min_size=1, max_size=3).map(",".join),
    st.tuples(
        st.sampled_from(["uniform", "log_uniform", "normal", "integers", "choice", "what"]),
        st.lists(NUMBER, max_size=3).map(",".join),
    ).map(lambda made: f"{made[0]}({made[1]})"),
    WORD,
)
DISTRIBUTION = st.tuples(
    st.sampled_from([Uniform, LogUniform, Normal, Integers, Choice]), st.tuples(*[st.one_of(NUMBERS, ODDITIES)] * 2)
)
VALUES = st.one_of(
    st.sampled_from([[0.1, 0.2], [0.3], ["off", "one_pass"], [(0, 0, -1)], np.linspace(0.1, 0.5, 3)]),
    st.sampled_from([[0.1, 0.2], [0.3], ["off", "one_pass"], [(0, 0, -1)], np.linspace(0.1, 0.5, 3)]),
    st.lists(st.one_of(st.floats(0, 1), NUMBERS, ODDITIES), max_size=3),
    st.just(range(10_000)),
    ODDITIES,
)
DESIGN = st.fixed_dictionaries(
    {},
    optional={
        "design": st.one_of(st.sampled_from(DESIGNS), ODDITIES),
        "samples": st.one_of(st.integers(-1, 4), st.sampled_from([10**7, 10**9, 10**30]), ODDITIES),
        "repeats": st.one_of(st.integers(-1, 4), st.sampled_from([10**7, 10**9, 10**30]), ODDITIES),
        "seed": st.one_of(st.integers(-1, 4), st.sampled_from([2**63 - 1, 2**64]), ODDITIES),
    },
)


def few(options: dict) -> bool:
    """Not millions of runs, which are allowed and take long."""
    return 10**7 not in (options.get("samples"), options.get("repeats"))


def try_axes(case: tuple[list[str], dict, dict], folder: Path) -> None:
    texts, given, options = case
    axes = dict(parse_axis(f"{name}={text}") for name, text in zip(NAMES, texts, strict=False))
    for name, values in given.items():
        axes[name] = values[0](*values[1]) if isinstance(values, tuple) else values
    if few(options):
        make_points(clean_axes(axes), **options)


def try_sweep(case: tuple[dict, dict, dict, str], folder: Path) -> None:
    """Whatever is not refused ahead runs, and its rows tell how it ended."""
    axes, options, fixed, use = case
    if not few(options) or any(isinstance(values, range) for values in axes.values()):
        return
    common = {"duration": 0.01, "fixed": fixed, "device": "cpu", "metrics": ["top_height"]}
    if use == "search":
        search("incline", axes, "top_height", trials=2, batch=2, seed=options.get("seed", 0), **common)
        return
    table = folder / "table.parquet"
    table.unlink(missing_ok=True)
    result = wr.sweep("incline", axes, output=table if use == "table" else None, **options, **common)
    result.to_arrow()
    if use == "table":
        assert len(read(table)) == len(result)


@functools.cache
def is_finite() -> bytes:
    """The table of a small sweep."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.parquet"
        axes = {"angle": [10.0, 20.0], "shock_propagation": ["off", "two_pass"]}
        wr.sweep("incline", axes, duration=0.01, device="cpu", metrics=["top_height"], output=path)
        return path.read_bytes()


@st.composite
def tables(draw: Any) -> bytes:
    """Bytes changed at random, or a right file with other columns or with something else told beside them."""
    if draw(st.booleans()):
        return draw(damaged(is_finite()))
    table = pyarrow.parquet.read_table(io.BytesIO(is_finite()))
    about = json.loads(table.schema.metadata[METADATA])
    if draw(st.booleans()):
        change(draw, about)
    if draw(st.sampled_from([False, False, True])):
        about = draw(PLAIN)
    column = draw(st.sampled_from([None, *table.column_names]))
    if column is not None:
        place = table.column_names.index(column)
        table = table.remove_column(place)
        if draw(st.booleans()):
            plain = st.sampled_from([None, 1, -1.5, "x", True, [1, 2]])
            values = [draw(plain)] * table.num_rows
            table = table.add_column(place, column, pyarrow.array(values))
    if draw(st.sampled_from([False, False, False, True])):
        table = table.slice(0, draw(st.integers(0, 1)))
    table = table.replace_schema_metadata({METADATA: json.dumps(about).encode()})
    stream = io.BytesIO()
    pyarrow.parquet.write_table(table, stream)
    return stream.getvalue()


def try_table(case: tuple[bytes, str], folder: Path) -> None:
    content, use = case
    path, other = folder / "a.parquet", folder / "b.parquet"
    path.write_bytes(content)
    other.write_bytes(is_finite())
    if use == "merge":
        merge([other, path]).to_parquet(folder / "all.parquet")
    elif use == "resume":
        axes = {"angle": [10.0, 20.0], "shock_propagation": ["off", "two_pass"]}
        wr.sweep("incline", axes, duration=0.01, device="cpu", metrics=["top_height"], output=path, resume=True)
    else:
        result = read(path)
        repr(result), result.failed, result.axes, result.metrics
        result.to_parquet(folder / "again.parquet")
        if use == "plot":
            result.plot(folder / "table.png")
        elif use == "replay" and result.rows:
            result.replay(result.rows[0], device="cpu")


FLAG = st.one_of(
    st.tuples(st.just("--vary"), st.tuples(st.sampled_from(NAMES), AXIS_TEXT).map("=".join)),
    st.tuples(st.just("--set"), st.tuples(st.sampled_from(NAMES), WORD).map("=".join)),
    st.tuples(st.sampled_from(["--samples", "--repeats", "--seed", "--fps", "--batch", "--workers"]), NUMBER),
    st.tuples(st.just("--design"), st.one_of(st.sampled_from(DESIGNS), WORD)),
    st.tuples(st.sampled_from(["--shard", "--metrics", "--plot-x", "--plot-kind", "--device"]), WORD),
    st.sampled_from([("--json",), ("--resume",), ("--overwrite",), ("--no-such-flag",), ("stray",)]),
)


def try_command(case: list[tuple], folder: Path) -> None:
    flags = [part for flag in case for part in flag]
    if any(flag[0] in ("--samples", "--repeats") and len(flag[1]) > 2 for flag in case):
        return
    outputs = ["-o", str(folder / "c.parquet"), "--overwrite", "--plot", str(folder / "c.svg")]
    arguments = ["sweep", "incline", "--duration", "0.01", "--vary", "friction=0.1,0.2", *outputs, *flags]
    assert cli.main(arguments) in (0, 2, 3, 4, 5)


AXES = st.dictionaries(st.sampled_from([*NAMES[:6], *NAMES[:4], *NAMES]), st.one_of(VALUES, DISTRIBUTION), max_size=3)
ONE_VALUE = st.one_of(NUMBERS, ODDITIES)


def made(axes: dict) -> dict:
    """Distributions of what is right for them; others are told by their constructors."""
    return {name: values for name, values in axes.items() if not isinstance(values, tuple)}


TARGETS = [
    Target("sweep axes", st.tuples(st.lists(AXIS_TEXT, max_size=2), AXES, DESIGN), try_axes),
    Target(
        "sweeps",
        st.tuples(
            AXES.map(made),
            DESIGN,
            st.dictionaries(st.sampled_from(NAMES), ONE_VALUE, max_size=1),
            st.sampled_from(["memory", "memory", "table", "search"]),
        ),
        try_sweep,
    ),
    Target(
        "sweep tables", st.tuples(tables(), st.sampled_from(["read", "merge", "resume", "plot", "replay"])), try_table
    ),
    Target("sweep command", st.lists(FLAG, max_size=3), try_command),
]
