"""Writer of USD files frame by frame; the file is readable after every flush."""

import contextlib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, UsdUtils, Vt

from warp_rigid.files.atomic import atomic_file, check_replaceable, hidden_beside, replace_files
from warp_rigid.render.appearance import Spread, drawn_surfaces, environment_offsets, is_tilted
from warp_rigid.runs.recording import Frame, Recording
from warp_rigid.usd.animation import Instancers
from warp_rigid.usd.cameras import CameraWriter
from warp_rigid.usd.contacts import ContactMarks
from warp_rigid.usd.conventions import MARK
from warp_rigid.usd.image_paths import ImagePaths
from warp_rigid.usd.library import Library
from warp_rigid.usd.options import MAX_SCENE_BODIES, UsdOptions
from warp_rigid.usd.rigid_bodies import Bodies
from warp_rigid.usd.specs import (
    SampleWriter,
    WrittenEnv,
    define,
    export_layer,
    open_layer,
    reload_layer,
    set_attribute,
    set_operations,
    stage_metadata,
)
from warp_rigid.usd.stage_look import define_look

WORLD = "/World"
FLUSH_EVERY = 24
"""Number of frames between flushes, and per clip."""


class UsdWriter:
    """Writes a recording frame by frame.

    An older film is replaced only when the new one is complete, which grows in a hidden folder beside it until then.

    Args:
        film: recording with the constant data and at least one frame, which determines the layout of environments.
        path: output file.
        rows: rows of the environments to write.
        options: export options.
        live: whether the simulation is still running, so that frames are flushed at intervals. A new file is then
            readable from the start.

    Raises:
        OSError: The file cannot be written.
    """

    def __init__(self, film: Recording, path: Path, rows: np.ndarray, options: UsdOptions, live: bool):
        """Create an empty file."""
        self._live = live or options.layout == "clips"
        self._film, self._path, self._rows, self._options = film, path, rows, options
        self._is_package = path.suffix == ".usdz"
        self._folder: Path | None = None
        self._hidden = contextlib.ExitStack()
        self._failure: OSError | None = None
        with self._writing():
            check_replaceable(path)
            if self._is_package or not live or path.exists():
                self._folder = self._hidden.enter_context(hidden_beside(path, is_folder=True))
        inner = (self._folder or path.parent) / path.name
        inner = inner.with_suffix(".usdc") if self._is_package else inner
        self._suffix = ".usda" if path.suffix == ".usda" else ".usdc"
        self._parts = inner.parent / f"{inner.stem}_parts"
        small = len(rows) * len(film.motion) <= MAX_SCENE_BODIES
        best = "scene" if small and film.scene is not None and not options.velocities else "animation"
        self._profile = best if options.profile == "auto" else options.profile
        self._spread = Spread(film)
        with self._writing():
            self._root = open_layer(inner)
        self._layers = [self._root]
        self._writers: list[Instancers | Bodies | ContactMarks | Library | CameraWriter] = []
        self._clips: Clips | None = None
        self._frames = self._flushed = 0

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Convert errors of the library. After an error nothing more is written: the layers may be incomplete."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except (Tf.ErrorException, OSError) as error:
            if isinstance(error, OSError) and error.errno:
                self._failure = OSError(error.errno, error.strerror, str(self._path))
            else:
                self._failure = OSError(f"{self._path}: cannot be written; is the disk full?")
            self.discard()
            raise self._failure from None

    def write(self, frame: Frame) -> None:
        """Append a frame.

        Raises:
            OSError: A file cannot be written, now or earlier.
        """
        with self._writing():
            with Sdf.ChangeBlock():
                if self._frames == 0:
                    self._define(frame)
                else:
                    for writer in self._writers:
                        writer.sample(float(self._frames), frame)
            self._spread.add(frame, self._rows)
            self._frames += 1
            if self._live and self._frames - self._flushed >= self._flush_interval():
                self._flush()

    def _flush_interval(self) -> int:
        """Maximum number of unflushed frames.

        A flush rewrites a text file completely and a file with many attributes almost completely. Their interval is
        therefore proportional to the number of frames.
        """
        if self._frames == 1:
            return 1
        cheap = self._options.layout == "clips" or (self._profile == "animation" and self._suffix == ".usdc")
        return FLUSH_EVERY if cheap else max(FLUSH_EVERY, self._flushed // 4)

    def _flush(self) -> None:
        """Write all pending frames to disk; the file is readable from then on."""
        for layer in self._layers:
            if layer.HasEndTimeCode():
                layer.endTimeCode = float(self._frames - 1)
        if self._clips is not None:
            self._clips.flush(self._frames - 1)
        # The root layer is saved last, so that it never refers to a missing file.
        for layer in reversed(self._layers):
            if layer.dirty and not layer.Save():
                raise OSError(f"{layer.realPath}: cannot be written")
        self._flushed = self._frames

    def close(self) -> None:
        """Set the final spacing of the environments and finish the file.

        Raises:
            OSError: A file cannot be written, now or earlier.
        """
        with self._writing():
            if self._frames:
                with Sdf.ChangeBlock():
                    self._arrange()
            if self._frames != self._flushed or any(layer.dirty for layer in self._layers):
                self._flush()
            if self._is_package:
                self._pack()
            elif self._live and self._profile == "scene":
                for layer in self._layers:  # without the data that later flushes replaced
                    export_layer(layer, Path(layer.realPath))
            if self._folder and not self._is_package:
                replace_files(self._folder, self._path.parent)
                reload_layer(self._path)
            self.discard()

    def discard(self) -> None:
        """Remove what is not published yet."""
        self._hidden.close()

    def _define(self, frame: Frame) -> None:
        """Write the constant data, and the first frame as default values."""
        stage_metadata(self._root, "World", self._film.fps)
        define(self._root, WORLD, "Xform")
        separate = self._options.layout == "payloads"
        if self._options.layout == "clips":
            base = self._new_part("topology", "World")
            self._root.GetPrimAtPath(WORLD).referenceList.prependedItems = [Sdf.Reference(self._asset(base), WORLD)]
        else:
            base = self._new_part("shapes", "Shapes") if separate else self._root
        define_look(self._root, WORLD, bool(self._film.looks))
        self._camera = CameraWriter(self._root, f"{WORLD}/Camera", self._film, int(self._rows[0]), frame)
        images = ImagePaths(Path(self._root.realPath), self._path, self._is_package)
        courses: dict[bytes, int] = {}
        rows = self._rows.tolist()
        alike = {row: courses.setdefault(self._film.times[:, row].tobytes(), row) for row in rows}
        self._library = Library(base, "/Shapes" if separate else f"{WORLD}/Shapes", frame, alike, images)
        self._writers = [self._library, self._camera]
        if self._profile == "animation":
            for index, surface in enumerate(self._film.surfaces):
                self._library.mesh(index, surface)
        shared = SampleWriter(base)
        for row in rows:
            name = f"env_{self._film.envs[row]:04d}"
            samples = SampleWriter(self._new_part(name, name)) if separate else shared
            self._define_env(samples, row, f"/{name}" if separate else f"{WORLD}/{name}", frame)
            if separate:
                prim = define(self._root, f"{WORLD}/{name}", "Xform")
                prim.payloadList.prependedItems = [Sdf.Payload(self._asset(samples.layer))]
        self._arrange()
        if self._options.layout == "clips":
            self._clips = Clips(self._root, shared, self._parts, self._suffix)

    def _define_env(self, samples: SampleWriter, row: int, root: str, frame: Frame) -> None:
        """Define one environment and the writers of its frames."""
        prim = define(samples.layer, root, "Xform")
        prim.SetInfo("customData", {MARK: {"environment": int(self._film.envs[row])}})
        if self._film.labels[row]:
            prim.SetInfo("displayName", self._film.labels[row])
        env = WrittenEnv(samples, root, self._film, row, frame)
        bodies: Bodies | Instancers
        if self._profile == "scene":
            bodies = Bodies(env, self._library, self._options, several=len(self._rows) > 1)
        else:
            bodies = Instancers(env, self._library, self._options)
        if row != self._rows[0]:
            self._hide(samples.layer, bodies)
        self._writers.append(bodies)
        if self._options.contacts:
            self._writers.append(ContactMarks(env))

    def _hide(self, layer: Sdf.Layer, written: Bodies | Instancers) -> None:
        """Hide the level planes of an environment: those of the first one coincide with them and reach below it.

        Coincident surfaces are black in path tracers.
        """
        for index, surface in enumerate(self._film.surfaces):
            if surface.endless and len(surface.faces) == 2 and not is_tilted(self._film, index):
                for body in np.flatnonzero(self._film.surface == index).tolist():
                    prim = layer.GetPrimAtPath(written.path_of(body))
                    set_attribute(prim, "visibility", Sdf.ValueTypeNames.Token, "invisible")

    def _arrange(self) -> None:
        """Offset the prims of the environments to a grid; poses inside stay unchanged."""
        layer = self._library.layer if self._options.layout == "clips" else self._root
        offsets = environment_offsets(len(self._rows), self._spread.spacing())
        for row, offset in zip(self._rows.tolist(), offsets.tolist(), strict=True):
            prim = layer.GetPrimAtPath(f"{WORLD}/env_{self._film.envs[row]:04d}")
            set_operations(prim, {"translate": (Sdf.ValueTypeNames.Double3, Gf.Vec3d(*offset))})
        self._camera.place(*self._spread.moving_corners(offsets), offsets[0])
        beyond = float(np.abs(offsets - offsets[0]).max())
        for index, surface in enumerate(drawn_surfaces(self._film, len(self._rows), self._spread, beyond)):
            original = self._film.surfaces[index]
            if surface is original:
                continue
            if self._profile == "animation":
                self._library.mesh(index, surface)
                for writer in self._writers:
                    if isinstance(writer, Instancers):
                        writer.resize(index, surface)
            elif self._film.scene is not None:
                shape = self._film.scene.bodies[int(np.flatnonzero(self._film.surface == index)[0])].shape
                self._library.fit_plane(shape, surface)

    def _new_part(self, name: str, default_prim: str) -> Sdf.Layer:
        """Create an additional file."""
        layer = open_layer(self._parts / f"{name}{self._suffix}")
        stage_metadata(layer, default_prim, self._film.fps)
        self._layers.append(layer)
        return layer

    def _asset(self, part: Sdf.Layer) -> str:
        """Path of an additional file relative to the root file."""
        return f"./{self._parts.name}/{Path(part.realPath).name}"

    def _pack(self) -> None:
        """Write the .usdz package. The library does not report a disk that becomes full, so the result is checked."""
        inner = Path(self._root.realPath)
        try:
            with atomic_file(self._path) as temporary:
                UsdUtils.CreateNewUsdzPackage(str(inner), str(temporary))
                with zipfile.ZipFile(temporary) as made:
                    complete = made.testzip() is None and made.getinfo(inner.name).file_size == inner.stat().st_size
                if not complete:
                    raise OSError(f"{temporary}: cannot be written")
        except (zipfile.BadZipFile, KeyError, EOFError):
            raise OSError(f"{self._path}: cannot be written; is the disk full?") from None


class Clips:
    """Value clips: one file of samples per time interval.

    Args:
        root: the layer that refers to the files.
        samples: the tracks; they are defined in a layer referenced by the root, since a default value in the root
            itself would override the samples of the files.
        folder: folder of the files.
        suffix: suffix of the files.
    """

    def __init__(self, root: Sdf.Layer, samples: SampleWriter, folder: Path, suffix: str):
        """Start the first clip and write the manifest of its attributes."""
        self._root, self._samples, self._folder, self._suffix = root, samples, folder, suffix
        self._starts: list[float] = []
        self._files: list[str] = []
        manifest = self._new_layer()
        for track in samples.tracks:
            Sdf.JustCreatePrimAttributeInLayer(manifest, track.path, track.type_name)
        self._manifest = self._export(manifest, "manifest")
        self._begin(0.0, first=True)

    def _new_layer(self) -> Sdf.Layer:
        layer = Sdf.Layer.CreateAnonymous(self._suffix)
        layer.timeCodesPerSecond = self._root.timeCodesPerSecond
        return layer

    def _begin(self, time: float, first: bool = False) -> None:
        """Start a new clip; the root refers to it after it is written."""
        self._layer, self._start = self._new_layer(), time
        self._samples.switch_layer(self._layer, time, first)

    def flush(self, time: float) -> None:
        """Finish the current clip, which ends with the frame at `time`."""
        if time == self._start:
            return
        finished = self._layer
        self._starts.append(self._start)
        with Sdf.ChangeBlock():
            self._begin(time)
        self._files.append(self._export(finished, f"clip_{len(self._files):04d}"))
        clips = {
            "assetPaths": Sdf.AssetPathArray([Sdf.AssetPath(file) for file in self._files]),
            "active": Vt.Vec2dArray([(start, index) for index, start in enumerate(self._starts)]),
            "times": Vt.Vec2dArray([(0.0, 0.0), (time, time)]),
            "primPath": WORLD,
            "manifestAssetPath": Sdf.AssetPath(self._manifest),
        }
        self._root.GetPrimAtPath(WORLD).SetInfo("clips", {"default": clips})

    def _export(self, layer: Sdf.Layer, name: str) -> str:
        """Write a file; returns its path relative to the root file."""
        path = self._folder / f"{name}{self._suffix}"
        export_layer(layer, path)
        return f"./{self._folder.name}/{path.name}"
