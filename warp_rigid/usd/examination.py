"""Examination of USD files in a child process, before the process of the caller opens them.

Damaged files can make the USD library take tens of gigabytes, minutes, or end the process. References that double at
every level can expand a few lines to more prims than fit into memory, and deep nesting overflows the stack of the
recursive parser. The child opens a file and all files behind it under limits on memory and time, reads all values, and
counts the composed prims without composing them.

This module runs as a script too (`serve`), so it imports nothing of the package: the child starts in a quarter second.
"""

import json
import math
import os
import re
import select
import signal
import stat
import sys
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Ar, Sdf, Tf

MAX_PRIMS = 1_000_000
"""Maximum number of prims of a stage; composing that many takes about a minute."""
MAX_LEVELS = 1000
"""Maximum nesting of prims, brackets and sublayers; some thousands overflow the stack of USD."""
MAX_ARCS = 100
"""Maximum length of a chain of references; the composition time grows with its third power."""

SECONDS_PER_BYTE, BYTES_PER_BYTE = 1e-6, 20.0
"""What the limits on time [s] and memory [bytes] grow with each byte of the files."""

TEXT, PACKAGE = b"#usda", b"PK"
"""First bytes of text files and packages."""

UNREADABLE = (Tf.ErrorException, UnicodeError, TypeError, IndexError, KeyError, AttributeError, OverflowError)
"""Exceptions raised for values that are damaged or of the wrong type."""
DAMAGED_PACKAGE = (zipfile.BadZipFile, zlib.error, OSError, ValueError, NotImplementedError, RuntimeError, EOFError)


class Extent(NamedTuple):
    """Size of a composed prim: total number of prims, levels of nesting, and longest chain of arcs."""

    prims: int = 0
    levels: int = 0
    arcs: int = 0

    def plus(self, other: "Extent", levels: int = 0, arcs: int = 0) -> "Extent":
        """That of a prim with another one, some levels below it, or behind some arcs."""
        return Extent(
            self.prims + other.prims, max(self.levels, other.levels + levels), max(self.arcs, other.arcs + arcs)
        )


Node = tuple[str, Sdf.Path]
"""A prim: the identifier of the strongest layer of its stack, and its path."""


def refusal(path: str, allow: Any = None, most_bytes: float = math.inf) -> str:
    """Open a file and all files behind it, read their values and count their prims.

    Args:
        path: the file.
        allow: function(bytes), called with the size of each file before it is opened; None for no limits.
        most_bytes: the limit on memory, for the message [bytes].

    Returns:
        Why the file must not be opened: it is not a USD file, or too large or nested too deeply to be composed. Empty
        if it can be.
    """
    try:
        _Examination(path, allow).check()
    except (MemoryError, ValueError, RuntimeError, *UNREADABLE) as error:
        text, reason = _text_of(error), reason_of(error)
        if isinstance(error, MemoryError) or "std::bad_alloc" in text:
            allowed = f"{most_bytes / 2**30:g} GiB; WARP_RIGID_USD_GIGABYTES raises the limit"
            reason = f"opening it takes more memory than allowed, {allowed}"
        return text if type(error) is ValueError else f"{path}: not a readable USD file: {reason}"
    return ""


def _text_of(error: Exception) -> str:
    """The message of an error; that of the conversion if USD's message, which can quote the file, is no UTF-8."""
    try:
        return str(error)
    except UnicodeError as broken:
        return str(broken)


def reason_of(error: Exception) -> str:
    """The message of the first USD error, without its location in the source code of USD."""
    text = " ".join(_text_of(error).split())
    found = re.search(r" : '(.*?)'(?: Error in |$)", text)
    return (found[1] if found else text)[:300]


class _Examination:
    """Opens the layers of a stage once each, reads all their values, and computes an upper bound for its size.

    Each prim of the files is visited once.

    Args:
        path: the file.
        allow: as in `refusal`.
    """

    def __init__(self, path: str, allow: Any):
        """Start without layers."""
        self._path, self._allow = path, allow
        self._opened: dict[str, Sdf.Layer | None] = {}
        self._read: set[str] = set()
        self._stacks: dict[str, list[Sdf.Layer]] = {}
        self._known: dict[Node, Extent] = {}

    def check(self) -> None:
        """Check that the stage can be composed.

        Raises:
            ValueError: It is no USD file, too large or nested too deeply, or a prim refers to itself.
        """
        layer = self._open(self._path)
        if layer is None:
            raise ValueError(f"{self._path}: not a readable USD file")
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
        found = Extent(1)
        specs = [spec for layer in self._stacks[node[0]] if (spec := layer.GetPrimAtPath(node[1]))]
        for child in dict.fromkeys(child.path for spec in specs for child in spec.nameChildren):
            found = found.plus((yield node[0], child), levels=1)
        for variants in [variants for spec in specs for variants in spec.variantSets.values()]:
            largest = Extent()
            for variant in variants.variants.values():  # of which one is selected
                below = yield node[0], variant.path
                largest = Extent(*map(max, largest, below))
            found = found.plus(largest)
        for target in [target for spec in specs for target in self._targets(node, spec)]:
            found = found.plus((yield target), arcs=1)
        return found

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
            found = self._open(layer.ComputeAbsolutePath(asset))
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
                    below = self._open(above.ComputeAbsolutePath(path))
                except Tf.ErrorException:
                    continue
                if below is not None and below.identifier not in found:
                    found[below.identifier] = below
                    waiting.append(below)
            if len(found) > MAX_LEVELS:
                raise ValueError(f"{self._path}: must have at most {MAX_LEVELS} sublayers")
        return list(found.values())

    def _open(self, identifier: str) -> Sdf.Layer | None:
        """Open a layer; None if the file does not exist.

        Raises:
            ValueError: It is not a regular file, its brackets are nested too deeply, or a template names its clips.
        """
        if identifier not in self._opened:
            resolved = Ar.GetResolver().Resolve(Sdf.Layer.SplitIdentifier(identifier)[0]).GetPathString()
            self._check_file(Ar.SplitPackageRelativePathOuter(resolved)[0])
            _check_brackets(resolved)
            layer = self._opened[identifier] = Sdf.Layer.FindOrOpen(identifier)
            if layer is not None and layer.identifier not in self._read:
                self._read.add(layer.identifier)
                for clip in _read_values(layer):
                    self._open(layer.ComputeAbsolutePath(clip))
        return self._opened[identifier]

    def _check_file(self, path: str) -> None:
        """Check that a file is a regular one, and account for its size."""
        try:
            found = os.stat(path)
        except OSError:
            return  # the library reports what is missing
        if not stat.S_ISREG(found.st_mode):
            raise ValueError(f"{path}: must be a regular file")
        if self._allow is not None:
            self._allow(found.st_size)


def _check_brackets(path: str) -> None:
    """Check the nesting of a text file, or of the first file of a package, which is its root layer."""
    resolver = Ar.GetResolver()
    asset = resolver.OpenAsset(resolver.Resolve(path))
    start = asset.Read(len(TEXT), 0) if asset is not None and asset.GetSize() >= len(TEXT) else b""
    if start.startswith(PACKAGE) and Path(path).is_file():
        try:
            with zipfile.ZipFile(path) as package:
                names = package.namelist()
        except DAMAGED_PACKAGE as error:
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


def _read_values(layer: Sdf.Layer) -> list[str]:
    """Read all values of a layer one after another, which finds those that take too much memory.

    Returns:
        The files of its value clips, which USD opens only when it needs a value.
    """
    clips: list[str] = []
    paths: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, paths.append)
    for path in paths:
        spec = layer.GetObjectAtPath(path)
        names = [] if spec is None else spec.ListInfoKeys()
        if "clips" in names:
            clips += _files_of_clips(layer, path, spec.GetInfo("clips"))
        for name in names:
            if name != "timeSamples":
                _try_value(spec.GetInfo, name)
        for time in layer.ListTimeSamplesForPath(path) if path.IsPropertyPath() else ():
            _try_value(layer.QueryTimeSample, path, time)
    return clips


def _files_of_clips(layer: Sdf.Layer, path: Sdf.Path, sets: dict[str, dict[str, Any]]) -> list[str]:
    """The files of all value clips of a prim."""
    found = []
    for clips in sets.values():
        if "templateAssetPath" in clips:
            raise ValueError(f"{layer.identifier}: {path}: templates of value clips are not supported")
        found += [asset.path for asset in (*clips.get("assetPaths", ()), clips.get("manifestAssetPath")) if asset]
    return found


def _try_value(read: Any, *where: Any) -> None:
    """Read a value; one of the wrong type is reported by the reader of the scene, where it is used."""
    try:
        read(*where)
    except (*UNREADABLE, RuntimeError):
        pass


def _about(count: int) -> str:
    return str(count) if count < 10**9 else f"about {float(min(count, 10**300)):.0e}"


def serve() -> None:
    """Answer requests on standard input, one JSON object a line: path, seconds and bytes (the limits).

    Each file is examined in a process of its own, forked from this one, which never opens a file itself.
    """
    for line in sys.stdin.buffer:
        request = json.loads(line)
        reading, writing = os.pipe()
        worker = os.fork()
        if worker == 0:
            allow = _limited(request["seconds"], request["bytes"])
            # After a blank, since the answer of a process that ends early is empty.
            os.write(writing, f" {refusal(request['path'], allow, request['bytes'])}".encode()[:4096])
            os._exit(0)
        os.close(writing)
        answered, _, _ = select.select([reading, sys.stdin.fileno()], [], [])
        if reading not in answered:  # the process that asked has ended
            os.kill(worker, signal.SIGKILL)
            return
        with os.fdopen(reading, "rb") as stream:
            answer = stream.read().decode(errors="replace")
        status = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
        print(json.dumps(answer[1:] if answer else _how_it_ended(request, status)), flush=True)


def _how_it_ended(request: dict[str, Any], status: int) -> str:
    """Why there is no answer."""
    ended = signal.Signals(-status).name if status < 0 else f"exit status {status}"
    reason = f"the USD library stops on it ({ended}), or needs too much memory"
    if ended in ("SIGXCPU", "SIGALRM"):
        # Where memory runs out, the USD library sometimes waits for itself instead of ending.
        limits = f"{request['seconds']:g} s and {request['bytes'] / 2**30:g} GiB"
        names = "WARP_RIGID_USD_SECONDS and WARP_RIGID_USD_GIGABYTES"
        reason = f"opening it takes more time or memory than allowed, {limits}; {names} raise the limits"
    return f"{request['path']}: not a readable USD file: {reason}"


def _limited(seconds: float, size: float) -> Callable[[int], None]:
    """Limit the processor time [s] and the memory [bytes] of this process to those of a file without content.

    Returns:
        A function that lets the limits grow for a file of some size [bytes].
    """
    import resource  # exists only where processes can fork

    before, total = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize(), 0
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def grow(more: int) -> None:
        nonlocal total
        total += more
        longest, largest = seconds + SECONDS_PER_BYTE * total, before + int(size + BYTES_PER_BYTE * total)
        for kind, limit in ((resource.RLIMIT_CPU, max(1, round(longest))), (resource.RLIMIT_AS, largest)):
            most = resource.getrlimit(kind)[1]
            resource.setrlimit(kind, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))
        signal.setitimer(signal.ITIMER_REAL, 4.0 * longest)  # on a busy machine, or a slow network

    grow(0)
    return grow


if __name__ == "__main__":
    serve()
