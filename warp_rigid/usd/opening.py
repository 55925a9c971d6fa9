"""Opening USD files, after a look at what they would become.

A few lines can ask for more prims than any memory holds, by references that double at every level, or nest deeper than
USD's parser and composition can follow, which recurse and end the process. So size and depth are reckoned first, from
what the layers say, without composing anything.
"""

import contextlib
import re
import zipfile
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Ar, Sdf, Tf, Usd

from warp_rigid.files import archive

__all__ = ["MOST_PRIMS", "open_stage", "reading"]

MOST_PRIMS = 1_000_000
"""Prims of a stage; composing so many takes USD about a minute."""
MOST_LEVELS = 1000
"""Prims, brackets or sublayers within each other: some thousands exhaust the stack of USD's recursions."""
MOST_ARCS = 100
"""References that lead to each other: composing a chain takes time as its length to the third power."""

TEXT, PACKAGE = b"#usda", b"PK"
"""How files of these kinds begin."""

UNREADABLE = (Tf.ErrorException, TypeError, IndexError, KeyError, AttributeError, OverflowError)
"""What values of the wrong type or damaged ones lead to."""


class Extent(NamedTuple):
    """What becomes of a prim: prims in all, levels of prims within each other, arcs that follow each other."""

    prims: int = 0
    levels: int = 0
    arcs: int = 0


Node = tuple[str, Sdf.Path]
"""A prim as the strongest layer of its stack and its path."""


def open_stage(path: Path) -> Usd.Stage:
    """Open a file.

    Raises:
        ValueError: It is no USD file, or it would hold more prims, or nest deeper, than can be composed.
    """
    try:
        layer = _open_layer(str(path))
        if layer is None:
            raise ValueError(f"{path}: not a readable USD file")
        _Reckoning(path).check(layer)
        return Usd.Stage.Open(layer)
    except Tf.ErrorException as error:
        raise ValueError(f"{path}: not a readable USD file: {_reason(error)}") from None


@contextlib.contextmanager
def reading(path: Any) -> Iterator[None]:
    """Say in one line what no reader can expect: USD has values of any type at any name, and some are damaged."""
    try:
        yield
    except UNREADABLE as error:
        raise ValueError(f"{path}: cannot be read: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """What the first of USD's errors says, without where in USD it was raised."""
    text = " ".join(str(error).split())
    found = re.search(r" : '(.*?)'(?: Error in |$)", text)
    return (found[1] if found else text)[:300]


def _open_layer(identifier: str) -> Sdf.Layer | None:
    """A layer, None where there is no such file; text is looked at before it is parsed.

    Raises:
        ValueError: Its brackets nest too deep.
    """
    _check_brackets(Sdf.Layer.SplitIdentifier(identifier)[0])
    return Sdf.Layer.FindOrOpen(identifier)


def _check_brackets(path: str) -> None:
    """Refuse text that nests too deep; of a package its first file, which is the layer."""
    resolver = Ar.GetResolver()
    asset = resolver.OpenAsset(resolver.Resolve(path))
    start = asset.Read(len(TEXT), 0) if asset is not None and asset.GetSize() >= len(TEXT) else b""
    if start.startswith(PACKAGE) and Path(path).is_file():
        try:
            with zipfile.ZipFile(path) as package:
                names = package.namelist()
        except (*archive.UNREADABLE, OSError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{path}: not a readable package: {reason}") from None
        for name in names[:1]:
            _check_brackets(Ar.JoinPackageRelativePath([path, name]))
    elif start == TEXT:
        content = np.frombuffer(asset.GetBuffer(), np.uint8)
        opening, closing = (np.isin(content, np.frombuffer(which, np.uint8)) for which in (b"([{", b")]}"))
        depth = np.cumsum(opening.astype(np.int8) - closing.astype(np.int8), dtype=np.int32)
        if depth.max(initial=0) > MOST_LEVELS:
            raise ValueError(f"{path}: must have at most {MOST_LEVELS} brackets within each other")


class _Reckoning:
    """Counts the prims of a composed stage from above, each prim of the files once.

    Args:
        path: of the file, for messages.
    """

    def __init__(self, path: Path):
        """Nothing is known yet."""
        self._path = path
        self._stacks: dict[str, list[Sdf.Layer]] = {}
        self._known: dict[Node, Extent] = {}

    def check(self, layer: Sdf.Layer) -> None:
        """Refuse what cannot be composed.

        Raises:
            ValueError: It is too much or too deep, or a prim refers to itself.
        """
        extent = self._follow((layer.identifier, Sdf.Path.absoluteRootPath), layer)
        told = (
            ("prims, references followed", extent.prims, MOST_PRIMS),
            ("prims within each other", extent.levels, MOST_LEVELS),
            ("references that lead to each other", extent.arcs, MOST_ARCS),
        )
        for what, count, most in told:
            if count > most:
                raise ValueError(f"{self._path}: must have at most {most} {what}, has {_about(count)}")

    def _follow(self, root: Node, layer: Sdf.Layer) -> Extent:
        """Reckon depth first, but without recursion: the files decide how deep that goes."""
        self._stacks[root[0]] = self._stack(layer)
        tasks: dict[Node, Any] = {root: self._reckon(root)}
        answer = None
        while tasks:
            node, task = next(reversed(tasks.items()))
            try:
                wanted = task.send(answer)
            except StopIteration as done:
                del tasks[node]
                answer = self._known[node] = done.value
                continue
            answer = self._known.get(wanted)
            if answer is None and wanted in tasks:
                raise ValueError(f"{self._path}: {wanted[1]} must not refer to itself")
            if answer is None:
                tasks[wanted] = self._reckon(wanted)
        return self._known[root]

    def _reckon(self, node: Node) -> Generator[Node, Extent, Extent]:
        """One prim: yields the prims of which it is made, takes what they become."""
        prims, levels, arcs = 1, 0, 0
        specs = [spec for layer in self._stacks[node[0]] if (spec := layer.GetPrimAtPath(node[1]))]
        for child in _children(specs):
            below = yield node[0], child
            prims, levels, arcs = prims + below.prims, max(levels, below.levels + 1), max(arcs, below.arcs)
        for variants in _variants(specs):
            largest = Extent()
            for path in variants:
                below = yield node[0], path
                largest = Extent(*map(max, largest, below))
            prims, levels, arcs = prims + largest.prims, max(levels, largest.levels), max(arcs, largest.arcs)
        for target in [target for spec in specs for target in self._targets(node, spec)]:
            behind = yield target
            prims, levels, arcs = prims + behind.prims, max(levels, behind.levels), max(arcs, behind.arcs + 1)
        return Extent(prims, levels, arcs)

    def _targets(self, node: Node, spec: Sdf.PrimSpec) -> Iterable[Node]:
        """What a prim refers to, inherits or specializes."""
        for arc in (*spec.referenceList.GetAddedOrExplicitItems(), *spec.payloadList.GetAddedOrExplicitItems()):
            stack = self._stack_behind(node, spec.layer, arc.assetPath)
            path = arc.primPath
            if stack is not None and path.isEmpty and self._stacks[stack][0].HasDefaultPrim():
                path = self._stacks[stack][0].GetDefaultPrimAsPath()
            if stack is not None and not path.isEmpty:
                yield from self._existing(node, stack, path)
        for path in (*spec.inheritPathList.GetAddedOrExplicitItems(), *spec.specializesList.GetAddedOrExplicitItems()):
            yield from self._existing(node, node[0], path)

    def _existing(self, node: Node, stack: str, path: Sdf.Path) -> Iterable[Node]:
        """A prim; where it is only there once others are composed, the one above it that is in the files."""
        asked = path
        while path.IsPrimPath():
            if any(layer.GetPrimAtPath(path) for layer in self._stacks[stack]):
                if path == asked or not (stack == node[0] and node[1].StripAllVariantSelections().HasPrefix(path)):
                    yield stack, path
                return
            path = path.GetParentPath()

    def _stack_behind(self, node: Node, layer: Sdf.Layer, asset: str) -> str | None:
        """The layer stack of a reference: the present one without a file; None where there is no such file."""
        if not asset:
            return node[0]
        try:
            found = _open_layer(layer.ComputeAbsolutePath(asset))
        except Tf.ErrorException:
            return None
        if found is not None and found.identifier not in self._stacks:
            self._stacks[found.identifier] = self._stack(found)
        return None if found is None else found.identifier

    def _stack(self, layer: Sdf.Layer) -> list[Sdf.Layer]:
        """A layer and all its sublayers.

        Raises:
            ValueError: They are too many.
        """
        found = {layer.identifier: layer}
        waiting = [layer]
        while waiting:
            above = waiting.pop()
            for path in above.subLayerPaths:
                try:
                    below = _open_layer(above.ComputeAbsolutePath(path))
                except Tf.ErrorException:
                    continue
                if below is not None and below.identifier not in found:
                    found[below.identifier] = below
                    waiting.append(below)
            if len(found) > MOST_LEVELS:
                raise ValueError(f"{self._path}: must have at most {MOST_LEVELS} sublayers")
        return list(found.values())


def _children(specs: list[Sdf.PrimSpec]) -> list[Sdf.Path]:
    """Paths of the prims within a prim, each once."""
    return list(dict.fromkeys(child.path for spec in specs for child in spec.nameChildren))


def _variants(specs: list[Sdf.PrimSpec]) -> list[list[Sdf.Path]]:
    """For each set of variants their paths; only one of them counts."""
    return [
        [variant.path for variant in variants.variants.values()]
        for spec in specs
        for variants in spec.variantSets.values()
    ]


def _about(count: int) -> str:
    return str(count) if count < 10**9 else f"about {float(min(count, 10**300)):.0e}"
