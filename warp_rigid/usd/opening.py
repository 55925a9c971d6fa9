"""Opening USD files after a check of their size and depth.

References that double at every level can expand a few lines to more prims than fit into memory, and deep nesting
overflows the stack of USD's recursive parser and composition, which ends the process. Size and depth are therefore
counted first from the layers, without composing them.
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

__all__ = ["MAX_PRIMS", "open_stage", "convert_errors"]

MAX_PRIMS = 1_000_000
"""Maximum number of prims of a stage; composing that many takes about a minute."""
MAX_LEVELS = 1000
"""Maximum nesting of prims, brackets and sublayers; some thousands overflow the stack of USD."""
MAX_ARCS = 100
"""Maximum length of a chain of references; the composition time grows with its third power."""

TEXT, PACKAGE = b"#usda", b"PK"
"""First bytes of text files and packages."""

UNREADABLE = (Tf.ErrorException, TypeError, IndexError, KeyError, AttributeError, OverflowError)
"""Exceptions raised for values that are damaged or of the wrong type."""


class Extent(NamedTuple):
    """Size of a composed prim: total number of prims, levels of nesting, and longest chain of arcs."""

    prims: int = 0
    levels: int = 0
    arcs: int = 0


Node = tuple[str, Sdf.Path]
"""A prim: the identifier of the strongest layer of its stack, and its path."""


def open_stage(path: Path) -> Usd.Stage:
    """Open a file.

    Raises:
        ValueError: It is not a USD file, or it is too large or nested too deeply to be composed.
    """
    try:
        layer = _open_layer(str(path))
        if layer is None:
            raise ValueError(f"{path}: not a readable USD file")
        _PrimCounter(path).check(layer)
        return Usd.Stage.Open(layer)
    except Tf.ErrorException as error:
        raise ValueError(f"{path}: not a readable USD file: {_reason(error)}") from None


@contextlib.contextmanager
def convert_errors(path: Any) -> Iterator[None]:
    """Convert the exceptions that unexpected or damaged values raise to a ValueError of one line."""
    try:
        yield
    except UNREADABLE as error:
        raise ValueError(f"{path}: cannot be read: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """The message of the first USD error, without its location in the source code of USD."""
    text = " ".join(str(error).split())
    found = re.search(r" : '(.*?)'(?: Error in |$)", text)
    return (found[1] if found else text)[:300]


def _open_layer(identifier: str) -> Sdf.Layer | None:
    """Open a layer; None if the file does not exist. The nesting of a text file is checked before it is parsed.

    Raises:
        ValueError: Its brackets are nested too deeply.
    """
    _check_brackets(Sdf.Layer.SplitIdentifier(identifier)[0])
    return Sdf.Layer.FindOrOpen(identifier)


def _check_brackets(path: str) -> None:
    """Check the nesting of a text file, or of the first file of a package, which is its root layer."""
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
        if depth.max(initial=0) > MAX_LEVELS:
            raise ValueError(f"{path}: must have at most {MAX_LEVELS} nested brackets")


class _PrimCounter:
    """Computes an upper bound for the size of a composed stage, visiting each prim of the files once.

    Args:
        path: path of the file, for messages.
    """

    def __init__(self, path: Path):
        """Start without known sizes."""
        self._path = path
        self._stacks: dict[str, list[Sdf.Layer]] = {}
        self._known: dict[Node, Extent] = {}

    def check(self, layer: Sdf.Layer) -> None:
        """Check that the stage of a layer can be composed.

        Raises:
            ValueError: It is too large or nested too deeply, or a prim refers to itself.
        """
        extent = self._follow((layer.identifier, Sdf.Path.absoluteRootPath), layer)
        limits = (
            ("prims including references", extent.prims, MAX_PRIMS),
            ("nested prims", extent.levels, MAX_LEVELS),
            ("chained references", extent.arcs, MAX_ARCS),
        )
        for what, count, most in limits:
            if count > most:
                raise ValueError(f"{self._path}: must have at most {most} {what}, has {_about(count)}")

    def _follow(self, root: Node, layer: Sdf.Layer) -> Extent:
        """Count depth first with an explicit stack, since the depth depends on the file."""
        self._stacks[root[0]] = self._stack(layer)
        tasks: dict[Node, Any] = {root: self._count(root)}
        answer = None
        while tasks:
            node, task = next(reversed(tasks.items()))
            try:
                needed = task.send(answer)
            except StopIteration as done:
                del tasks[node]
                answer = self._known[node] = done.value
                continue
            answer = self._known.get(needed)
            if answer is None and needed in tasks:
                raise ValueError(f"{self._path}: {needed[1]} must not refer to itself")
            if answer is None:
                tasks[needed] = self._count(needed)
        return self._known[root]

    def _count(self, node: Node) -> Generator[Node, Extent, Extent]:
        """Size of one prim; yields the prims it is composed of and receives their sizes."""
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
        """Targets of the references, payloads, inherits and specializes of a prim."""
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
        """A prim, or its nearest ancestor in the files if it exists only after composition."""
        requested = path
        while path.IsPrimPath():
            if any(layer.GetPrimAtPath(path) for layer in self._stacks[stack]):
                if path == requested or not (stack == node[0] and node[1].StripAllVariantSelections().HasPrefix(path)):
                    yield stack, path
                return
            path = path.GetParentPath()

    def _stack_behind(self, node: Node, layer: Sdf.Layer, asset: str) -> str | None:
        """The layer stack of a reference: the current one without an asset path; None if the file does not exist."""
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
            ValueError: There are too many sublayers.
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
            if len(found) > MAX_LEVELS:
                raise ValueError(f"{self._path}: must have at most {MAX_LEVELS} sublayers")
        return list(found.values())


def _children(specs: list[Sdf.PrimSpec]) -> list[Sdf.Path]:
    """Distinct paths of the children of a prim."""
    return list(dict.fromkeys(child.path for spec in specs for child in spec.nameChildren))


def _variants(specs: list[Sdf.PrimSpec]) -> list[list[Sdf.Path]]:
    """Paths of the variants of each variant set, of which one is selected."""
    return [
        [variant.path for variant in variants.variants.values()]
        for spec in specs
        for variants in spec.variantSets.values()
    ]


def _about(count: int) -> str:
    return str(count) if count < 10**9 else f"about {float(min(count, 10**300)):.0e}"
