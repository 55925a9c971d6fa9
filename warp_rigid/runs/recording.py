"""Recording: the poses of a simulation over time, with the surfaces needed to draw them.

A saved recording is self-contained: it stores the surfaces and names of the bodies, so that it can be exported or
drawn without the program that made it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_rigid import progress_bar
from warp_rigid.checks import number_in, shown, whole_in
from warp_rigid.display import Inline, film_of, html_of
from warp_rigid.engine import field_values, joint_quantities
from warp_rigid.engine.quantities import owner_of
from warp_rigid.engine.selection import Indices, env_indices
from warp_rigid.engine.step_reports import CONTACT_RECORD
from warp_rigid.extras import need
from warp_rigid.files import archive
from warp_rigid.files.archive import shaped
from warp_rigid.runs.drawn_surface import DrawnSurface, surfaces_of
from warp_rigid.scene.camera import Camera, camera_of_text, with_body_index
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.scene.look import Look, looks_from_data, looks_to_data
from warp_rigid.scene.scene import SURFACE_VELOCITIES, Motion, Scene

if TYPE_CHECKING:
    from warp_rigid.engine.simulator import Simulator

KIND = "recording"
VERSION = 3  # increase when older files can no longer be read
MAX_STEPS_PER_FRAME = 1_000_000
"""Maximum number of steps per frame."""
CAPTURED = {"position": np.float32, "orientation": np.float32, "asleep": bool, "level": np.int32, "active": bool}
"""Quantities recorded in every frame, by their name in the simulator."""
VELOCITIES = {"linear_velocity": np.float32, "angular_velocity": np.float32}
"""Quantities recorded on request."""
RECORDED_UNITS = {"time": "s", "position": "m", "linear_velocity": "m/s", "angular_velocity": "rad/s"}
VALUE_SHAPES = {"position": (3,), "orientation": (4,), "linear_velocity": (3,), "angular_velocity": (3,)}
START = (*VELOCITIES, "mass", *COEFFICIENTS, *SURFACE_VELOCITIES, "gravity")
"""Quantities recorded in the first frame only, besides those of joints and force fields."""
CONTACTS = {name: f"contact_{name}" for name in CONTACT_RECORD.names or ()}
"""Archive members for the contact fields, concatenated over frames."""


@dataclass(frozen=True, eq=False)
class Frame:
    """The recorded environments at one time; fields as in Recording, without the frame axis."""

    time: float
    times: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    asleep: np.ndarray
    level: np.ndarray
    active: np.ndarray
    linear_velocity: np.ndarray | None = None
    angular_velocity: np.ndarray | None = None
    contacts: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses of some environments over time.

    Attributes:
        time: (frames + 1,) float64 [s]; the first frame is the state before the first step.
        times: (frames + 1, envs) float64, time since the start or the last reset of each environment, which its moving
            ground follows [s].
        position: (frames + 1, envs, bodies, 3) float32, pose of the shape's frame [m].
        orientation: (frames + 1, envs, bodies, 4) float32, unit quaternions (x, y, z, w).
        asleep: (frames + 1, envs, bodies) bool.
        level: (frames + 1, envs, bodies) int32, level in the contact graph.
        active: (frames + 1, envs, bodies) bool; bodies that are switched off are not drawn.
        fps: frames per simulated second.
        envs: (envs,) int64, indices of these environments in the simulation.
        labels: one label per environment; may be empty.
        names: names of the bodies.
        motion: (bodies,) int64, values of Motion.
        surface: (bodies,) int64, index into surfaces.
        surfaces: the distinct surfaces.
        linear_velocity: (frames + 1, envs, bodies, 3) float32, of the centres of mass [m/s]; None if not recorded.
        angular_velocity: (frames + 1, envs, bodies, 3) float32, in the world frame [rad/s]; None if not recorded.
        contacts: per frame the records of Simulator.contacts; None if not recorded.
        scene: the simulated scene; None in a recording read from a file.
        start: (envs, bodies, ...) quantities of the first frame by name (see START), and those of joints (envs, joints)
            and force fields (envs, fields, ...); empty if read from a file.
        camera: where pictures are taken from, with the index of the body that it follows; None for a camera that keeps
            the moving bodies in view.
        looks: Look of bodies by their index.
    """

    time: np.ndarray
    times: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    asleep: np.ndarray
    level: np.ndarray
    active: np.ndarray
    fps: float
    envs: np.ndarray
    labels: tuple[str, ...]
    names: tuple[str, ...]
    motion: np.ndarray
    surface: np.ndarray
    surfaces: tuple[DrawnSurface, ...]
    linear_velocity: np.ndarray | None = None
    angular_velocity: np.ndarray | None = None
    contacts: tuple[np.ndarray, ...] | None = None
    scene: Scene | None = None
    start: dict[str, np.ndarray] = field(default_factory=dict)
    camera: Camera | None = None
    looks: dict[int, Look] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Show the size."""
        size = f"{len(self.envs)} environments of {len(self.names)} bodies"
        return f"Recording({len(self.time)} frames of {size}, {self.fps:g} frames/s)"

    @property
    def num_frames(self) -> int:
        """Number of frames after the initial one."""
        return len(self.time) - 1

    def frames(self) -> Iterator[Frame]:
        """Iterate over all frames, including the initial one."""
        return _frames({name: getattr(self, name) for name in ("time", "times", *self._kept)}, self.contacts)

    @property
    def _kept(self) -> list[str]:
        """Names of the quantities of bodies recorded in every frame."""
        return [*CAPTURED, *(name for name in VELOCITIES if getattr(self, name) is not None)]

    def rows(self, envs: Iterable[int] | None = None) -> np.ndarray:
        """Array rows of the environments `envs` (indices in the simulation; None: all).

        Raises:
            ValueError: One of them was not recorded.
        """
        if envs is None:
            return np.arange(len(self.envs))
        missing = sorted(set(envs) - set(self.envs.tolist()))
        if missing:
            raise ValueError(f"envs: {missing} were not recorded; recorded: {self.envs.tolist()}")
        return np.array([int(np.flatnonzero(self.envs == env)[0]) for env in envs])

    def to_xarray(self) -> Any:
        """All frames as an xarray.Dataset with units; its dimensions are time [s], env, body and the components.

        Raises:
            ModuleNotFoundError: xarray is not installed.
        """
        xarray = need("xarray")
        components = {(): (), (3,): ("axis",), (4,): ("component",)}
        variables = {
            name: (("time", "env", "body", *components[VALUE_SHAPES.get(name, ())]), getattr(self, name))
            for name in self._kept
        }
        coordinates = {"time": self.time, "env": self.envs, "body": list(self.names)}
        coordinates |= {"axis": list("xyz"), "component": list("xyzw")}
        found = xarray.Dataset(variables, coordinates, {"fps": self.fps})
        for name, unit in RECORDED_UNITS.items():
            if name in found:
                found[name].attrs["units"] = unit
        return found

    def save(self, path: str | PathLike[str]) -> None:
        """Write all frames to one .npz file of plain arrays and text.

        The scene is not stored: a loaded recording can be drawn, but not exported as a scene with physics.
        """
        names = ("time", "times", *self._kept, "envs", "motion", "surface")
        arrays = {name: getattr(self, name) for name in names}
        if self.contacts is not None:
            arrays |= _contact_arrays(self.contacts)
        for index, surface in enumerate(self.surfaces):
            arrays[f"vertices_{index}"] = surface.vertices
            arrays[f"faces_{index}"] = surface.faces
            arrays[f"swing_{index}"] = surface.swing
            if surface.uv is not None:
                arrays[f"uv_{index}"] = surface.uv
        text = {
            "fps": self.fps,
            "labels": self.labels,
            "names": self.names,
            "endless": [surface.endless for surface in self.surfaces],
            "angular_frequency": [surface.angular_frequency for surface in self.surfaces],
            "camera": None if self.camera is None else str(self.camera),
            "looks": looks_to_data(self.looks),
        }
        archive.save(path, KIND, VERSION, text, arrays, compress=True)

    def _repr_html_(self) -> str:
        return html_of(self)

    def _seen_from(self, camera: Camera | None) -> "Recording":
        return self if camera is None else replace(self, camera=with_body_index(camera, self.names))

    def show(self, *, envs: Sequence[int] | None = None, color: str = "body", camera: Camera | None = None) -> Inline:
        """Return the film for a notebook: the page of `to_html`, or a GIF if viser is missing or the page too large.

        Args:
            envs: see to_gif.
            color: see to_gif.
            camera: see to_gif.

        Raises:
            ValueError: An argument is out of range, or the film is too large for a notebook.
            ModuleNotFoundError: The extras "viewer" and "picture" are not installed.
        """
        shown = film_of(self._seen_from(camera), "", None, envs=envs, color=color)
        assert shown is not None
        return shown

    def to_html(
        self,
        path: str | PathLike[str] | None = None,
        *,
        envs: Sequence[int] | None = None,
        color: str = "body",
        camera: Camera | None = None,
    ) -> Inline | None:
        """Write the film as one .html file that plays without a server; see to_gif."""
        return film_of(self._seen_from(camera), ".html", path, envs=envs, color=color)

    def to_gif(
        self,
        path: str | PathLike[str] | None = None,
        *,
        envs: Sequence[int] | None = None,
        color: str = "body",
        width: int | None = None,
        height: int | None = None,
        camera: Camera | None = None,
    ) -> Inline | None:
        """Render the film in real time as an animated GIF. It ends soon after the bodies are at rest.

        Args:
            path: the file, whose folders are created; None returns the film for a notebook.
            envs: indices in the simulation of the environments to draw; None for all that were recorded. Up to 9 have a
                panel each.
            color: colour of the dynamic bodies by "body", "environment", "level", "speed" (of recorded velocities) or
                "asleep".
            width: width of a panel [pixel]; None for 640 pixels in all (`to_mp4`: 1280), and at least
                320.
            height: height of a panel [pixel]; None for 9/16 of its width.
            camera: where it is seen from; None for the camera of the recording.

        Returns:
            None with a path. Else an object that a notebook shows, with the HTML as its attribute `html`.

        Raises:
            ValueError: An argument is out of range, or the film is larger than 16 MB and there is no path.
            ModuleNotFoundError: The extra "picture", or for HTML "viewer", is not installed.
        """
        return film_of(self._seen_from(camera), ".gif", path, envs=envs, color=color, width=width, height=height)

    def to_mp4(
        self,
        path: str | PathLike[str] | None = None,
        *,
        envs: Sequence[int] | None = None,
        color: str = "body",
        width: int | None = None,
        height: int | None = None,
        camera: Camera | None = None,
    ) -> Inline | None:
        """Render the film in real time as an MP4 video (H.264); see to_gif."""
        return film_of(self._seen_from(camera), ".mp4", path, envs=envs, color=color, width=width, height=height)

    @staticmethod
    def load(path: str | PathLike[str]) -> "Recording":
        """Read a file written by `save`.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: It is not a complete recording of this version.
        """
        text, arrays = archive.load(path, KIND, VERSION)
        try:
            return Recording(**_checked(text, arrays))
        except archive.UNREADABLE as error:
            raise archive.unusable(path, KIND, error) from None


class Recorder:
    """Collects frames of a running simulation.

    Args:
        sim: the Simulator, or an object with its `scene`, `num_envs`, `time`, `times` and `get`.
        fps: frames per simulated second; stored only, the caller steps the simulation.
        envs: environments to record, as in Simulator.get; None records all.
        labels: one label per recorded environment.
        velocities: whether to record velocities.
        contacts: whether to record contacts.
        camera: where pictures are taken from; None for the camera of the scene.

    Raises:
        ValueError: An environment does not exist, environments have different scenes, labels and environments differ
            in number, or the camera follows a body that does not exist.
    """

    def __init__(self, sim, fps, envs=None, labels=None, velocities=False, contacts=False, camera=None):
        """Store the constant data; the first `capture` records the initial frame."""
        self.envs = env_indices(sim.num_envs, envs).astype(np.int64)
        self.labels = ("",) * len(self.envs) if labels is None else tuple(labels)
        if len(self.labels) != len(self.envs):
            raise ValueError(f"labels: must be {len(self.envs)}, one per environment, got {len(self.labels)}")
        self.fps = float(fps)
        self._captured = CAPTURED | (VELOCITIES if velocities else {})
        self._contacts = contacts
        self._scene = _common_scene(sim, self.envs)
        camera = self._scene.camera if camera is None else camera
        names = [body.name for body in self._scene.bodies]
        self._camera = None if camera is None else with_body_index(camera, names)
        self._start = {name: self._rows(sim, name, np.float32) for name in _at_start(self._scene)}
        self._frames: list[Frame] = []

    def snapshot(self, sim) -> Frame:
        """Return the current state without storing it."""
        contacts = sim.contacts() if self._contacts else None  # of all environments, by their index in the simulation
        return Frame(
            time=float(sim.time),
            times=np.asarray(sim.times, np.float64)[self.envs],
            **{name: self._rows(sim, name, dtype) for name, dtype in self._captured.items()},
            contacts=None if contacts is None else contacts[np.isin(contacts["env"], self.envs)],
        )

    def _rows(self, sim, name: str, dtype) -> np.ndarray:
        """A quantity of the recorded environments, without the bodies, joints and fields that only others have."""
        values = np.asarray(sim.get(name), dtype=dtype)[self.envs]
        scene, owner = self._scene, owner_of(name)
        counts = {"bodies": len(scene.bodies), "joints": len(scene.joints), "fields": len(scene.force_fields)}
        return values[:, : counts[owner]] if owner in counts else values

    def capture(self, sim) -> None:
        """Append the current state as a frame."""
        self._frames.append(self.snapshot(sim))

    @property
    def quantities(self) -> list[str]:
        """Names of the recorded quantities."""
        return [*self._captured, *(["contacts"] if self._contacts else [])]

    def arrays(self) -> dict[str, np.ndarray]:
        """All recorded data as arrays, by name."""
        return self._stacked() | (_contact_arrays(self._contact_frames()) if self._contacts else {})

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the frames that another recorder returned from `arrays`.

        Raises:
            ValueError: The arrays do not match the environments, bodies and quantities of this recorder.
        """
        time = shaped(arrays, "time", np.float64, (None,))
        rows = (len(time), len(self.envs), len(self._scene.bodies))
        contacts = _contacts(arrays, len(time)) if self._contacts else None
        kept = _quantities(arrays, self._captured, rows)
        self._frames = list(_frames({"time": time, "times": _times(arrays, time, rows[1]), **kept}, contacts))

    def recording(self) -> Recording:
        """Return all frames captured so far."""
        surfaces, surface = surfaces_of(self._scene.bodies)
        return Recording(
            **self._stacked(),
            fps=self.fps,
            envs=self.envs,
            labels=self.labels,
            names=tuple(body.name for body in self._scene.bodies),
            motion=np.array([int(body.motion) for body in self._scene.bodies], dtype=np.int64),
            surface=surface,
            surfaces=surfaces,
            contacts=self._contact_frames() if self._contacts else None,
            scene=self._scene,
            start=self._start,
            camera=self._camera,
            looks=dict(self._scene.looks),
        )

    def _stacked(self) -> dict[str, np.ndarray]:
        """The frames as arrays, without contacts."""
        return {name: np.stack([getattr(f, name) for f in self._frames]) for name in ("time", "times", *self._captured)}

    def _contact_frames(self) -> tuple[np.ndarray, ...]:
        return tuple(frame.contacts for frame in self._frames if frame.contacts is not None)


def _at_start(scene: Scene) -> list[str]:
    """Names of the quantities of a scene that are recorded in the first frame only."""
    of_fields = {field_values.PREFIX + name: None for field in scene.force_fields for name in type(field).parameters()}
    of_joints = ("joint_position", *joint_quantities.WRITABLE) if scene.joints else ()
    return [*START, *of_joints, *of_fields]


def _common_scene(sim, envs: np.ndarray) -> Scene:
    """The scene of some environments.

    Raises:
        ValueError: They have different scenes.
    """
    found = np.unique(sim.scene_of[envs]).tolist()
    if len(found) > 1:
        raise ValueError(f"envs: must be environments of one scene, got those of scenes {found}; record one at a time")
    return sim.scenes[found[0]] if found else sim.scenes[0]


def record(
    sim: "Simulator",
    frames: int,
    fps: float = 60.0,
    on_frame: Callable[[int, Any], object] | None = None,
    envs: Indices = None,
    *,
    velocities: bool = False,
    contacts: bool = False,
    camera: Camera | None = None,
    progress: bool = True,
) -> Recording:
    """Step a simulation and record the poses of every frame.

    Args:
        sim: the Simulator; it ends at the time of the last frame.
        frames: number of frames to simulate, >= 0.
        fps: frames per simulated second; one frame must be a whole number of steps of dt.
        on_frame: function(index, sim), called after each captured frame; index 0 is the initial state.
        envs: environments to record, as in Simulator.get, which must have the same scene; None records all.
        velocities: whether to record velocities.
        contacts: whether to record the contacts of the last step of each frame.
        camera: where pictures, films and USD files of the recording show it from; None for the camera of the scene.
        progress: show a bar in terminals and notebooks.

    Returns:
        A Recording of frames + 1 frames; the first is the state before the first step.

    Raises:
        ValueError: sim is a Scene, fps does not divide the step rate, frames is no whole number >= 0, an environment
            does not exist, or the camera follows a body that does not exist.
    """
    if isinstance(sim, Scene):
        raise ValueError(f"sim: must be a Simulator, got {shown(sim)}")
    frames = whole_in("frames", frames, 0, 2**31)
    steps = steps_per_frame(sim.settings.dt, fps)
    recorder = Recorder(sim, fps, envs, velocities=velocities, contacts=contacts, camera=camera)
    with progress_bar.progress("recording", frames, progress) as advance:
        for index in range(frames + 1):
            if index > 0:
                sim.step(steps)
            recorder.capture(sim)
            if on_frame is not None:
                on_frame(index, sim)
            advance(index)
    return recorder.recording()


def steps_per_frame(dt: float, fps: float) -> int:
    """Number of steps of dt [s] per frame.

    Raises:
        ValueError: The number is not whole; the message names the nearest valid frame rate.
    """
    fps = number_in("fps", fps, above=0.0)
    if 1.0 > MAX_STEPS_PER_FRAME * fps * dt:
        raise ValueError(
            f"fps: a frame must be at most {MAX_STEPS_PER_FRAME} steps of dt = {dt:g} s, "
            f"so fps >= {1.0 / (MAX_STEPS_PER_FRAME * dt):g}"
        )
    steps = max(1, round(1.0 / (fps * dt)))
    if abs(steps * fps * dt - 1.0) > 1e-6:
        raise ValueError(
            f"fps: a frame must be a whole number of steps of dt = {dt:g} s ({1.0 / dt:g} steps/s), got {fps:g} "
            f"frames/s; nearest valid rate: {1.0 / (steps * dt):g}"
        )
    return steps


def is_moving(motion: np.ndarray) -> np.ndarray:
    """Mask of the bodies that are not static, from their Motion."""
    return np.asarray(motion) != Motion.STATIC


def _checked(text: dict, arrays: Mapping[str, np.ndarray]) -> dict:
    """Validate the content of a file and return the fields of a Recording."""
    time = shaped(arrays, "time", np.float64, (None,))
    envs = shaped(arrays, "envs", np.int64, (None,))
    motion = shaped(arrays, "motion", np.int64, (None,))
    surface = shaped(arrays, "surface", np.int64, motion.shape)
    rows = (len(time), len(envs), len(motion))
    kept = CAPTURED | {name: kind for name, kind in VELOCITIES.items() if name in arrays}
    frames = {"times": _times(arrays, time, len(envs)), **_quantities(arrays, kept, rows)}
    properties = zip(text["endless"], text["angular_frequency"], strict=True)
    surfaces = tuple(
        _surface(arrays, index, bool(endless), frequency) for index, (endless, frequency) in enumerate(properties)
    )
    if not len(time) or not np.isin(motion, list(Motion)).all() or not np.isin(surface, range(len(surfaces))).all():
        raise ValueError("it must have at least one frame, valid motions and a surface for each body")
    labels, names = tuple(map(str, text["labels"])), tuple(map(str, text["names"]))
    if (len(labels), len(names)) != rows[1:]:
        raise ValueError(
            f"it has {len(labels)} labels and {len(names)} names for {rows[1]} environments, {rows[2]} bodies"
        )
    fps = number_in("fps", text["fps"], above=0.0)
    contacts = _contacts(arrays, len(time)) if "contact_count" in arrays else None
    camera = text.get("camera")  # older files have none
    camera = None if camera is None else with_body_index(camera_of_text(str(camera)), names)
    return {
        "time": time, **frames, "fps": fps, "envs": envs, "labels": labels, "names": names, "motion": motion,
        "surface": surface, "surfaces": surfaces, "contacts": contacts, "camera": camera,
        "looks": looks_from_data(text.get("looks", []), len(names)),
    }  # fmt: skip


def _surface(arrays: Mapping[str, np.ndarray], index: int, endless: bool, frequency: float) -> DrawnSurface:
    vertices = shaped(arrays, f"vertices_{index}", np.float32, (None, 3))
    faces = shaped(arrays, f"faces_{index}", np.int32, (None, 3))
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(f"faces_{index} must be from 0 to {len(vertices) - 1}")
    swing = shaped(arrays, f"swing_{index}", np.float32, (2, None))
    if swing.shape[1] not in (0, len(vertices)):
        raise ValueError(f"swing_{index} must have {len(vertices)} columns")
    uv = shaped(arrays, f"uv_{index}", np.float32, (len(faces), 3, 2)) if f"uv_{index}" in arrays else None
    return DrawnSurface(vertices, faces, endless, swing, number_in("angular_frequency", frequency, 0.0), uv)


def _times(arrays: Mapping[str, np.ndarray], time: np.ndarray, envs: int) -> np.ndarray:
    """The times of the environments; older files do not state those that are all the same."""
    own = "times" in arrays
    return shaped(arrays, "times", np.float64, (len(time), envs)) if own else np.tile(time[:, None], (1, envs))


def _quantities(arrays: Mapping[str, np.ndarray], kinds: dict, rows: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Validate quantities of shape (frames, envs, bodies, ...), by name."""
    stored = {name: kind for name, kind in kinds.items() if name != "active" or name in arrays}
    found = {name: shaped(arrays, name, kind, rows + VALUE_SHAPES.get(name, ())) for name, kind in stored.items()}
    return {"active": np.ones(rows, bool)} | found  # older files do not state it


def _frames(arrays: dict[str, np.ndarray], contacts: Sequence[np.ndarray] | None) -> Iterator[Frame]:
    """Iterate over the frames of stacked arrays."""
    captured = {name: array for name, array in arrays.items() if name != "time"}
    for index, time in enumerate(arrays["time"].tolist()):
        now = {name: array[index] for name, array in captured.items()}
        yield Frame(time=time, **now, contacts=contacts[index] if contacts is not None else None)


def _contact_arrays(contacts: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Contacts as plain arrays: the count per frame, and each field concatenated over frames."""
    records = np.concatenate(contacts)
    counts = np.array([len(part) for part in contacts], dtype=np.int64)
    return {"contact_count": counts} | {place: records[name] for name, place in CONTACTS.items()}


def _contacts(arrays: Mapping[str, np.ndarray], frames: int) -> tuple[np.ndarray, ...]:
    """Inverse of `_contact_arrays`, validated."""
    counts = shaped(arrays, "contact_count", np.int64, (frames,))
    total = len(shaped(arrays, CONTACTS["env"], np.int32, (None,)))
    if (counts < 0).any() or (counts > total).any() or counts.sum() != total:
        raise ValueError(f"contact_count must add up to {total}")
    records = np.zeros(total, CONTACT_RECORD)
    for name, place in CONTACTS.items():
        records[name] = shaped(arrays, place, records[name].dtype, records[name].shape)
    return tuple(np.split(records, np.cumsum(counts)[:-1]))
