"""USD export of animations and of scenes with physics."""

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from warp_rigid.engine.simulator import Simulator
from warp_rigid.runs.recording import Recorder, Recording
from warp_rigid.scene.camera import Camera
from warp_rigid.usd.options import UsdOptions


def export_usd(
    recording: Recording,
    path: str | PathLike[str],
    envs: Iterable[int] | None = None,
    *,
    profile: str = "auto",
    color: str = "body",
    layout: str = "single",
    contacts: bool = False,
    velocities: bool = False,
) -> None:
    """Write a recording as USD: z up, metres, one time code per frame.

    Poses are in environment coordinates. The prims of the environments are offset to a grid, so that an environment
    can be extracted and float32 poses stay exact.

    Args:
        recording: the recording.
        path: output file, .usdc (compact), .usda (text), .usdz (single package) or .usd; missing folders are created.
        envs: indices of the environments to write; None writes all recorded ones.
        profile: "animation": one PointInstancer per shape, compact and fast for large batches; "scene": one prim per
            body with UsdPhysics, readable by import_usd and other simulators; "auto": a scene for up to 2000 bodies.
        color: colouring of the bodies: "body", "environment", "level", "speed" or "asleep".
        layout: "single": one file; "payloads": an additional file per environment, loaded on demand; "clips": an
            additional file per 24 frames; "override": a layer over the stage from which the scene was imported, which
            animates the stage's own prims; the other options do not apply to it.
        contacts: whether to write contact points and impulses, which must have been recorded.
        velocities: whether to write instance velocities for motion blur, which must have been recorded.

    Raises:
        ValueError: The path has another suffix, an environment or a quantity was not recorded, or an option is
            unknown.
        OSError: The file cannot be written.
    """
    options = UsdOptions(profile, color, layout, contacts, velocities)
    path = Path(path)
    options.check_path(path)
    options.check_film(recording)
    rows = recording.rows(envs)
    if layout == "override":
        from warp_rigid.usd.override import write_override

        if len(rows) != 1:
            raise ValueError(f"envs: must be one environment for the layout override, got {len(rows)}")
        write_override(recording, path, int(rows[0]))
        return

    from warp_rigid.usd.writer import UsdWriter

    writer = UsdWriter(recording, path, rows, options, live=False)
    try:
        for frame in recording.frames():
            writer.write(frame)
        writer.close()
    finally:
        writer.discard()


class UsdStream:
    """Writes an animation while the simulation runs, with constant memory.

    The first frame is the initial state; each `capture` appends one. The file is readable at any time, even if the
    process is killed: an animation lacks at most the last 24 frames, a scene or a text file at most the last 24 frames
    or a fifth of them. A film that exists already stays as it is until `close` replaces it.

    with wr.UsdStream(sim, "film.usdc", fps=60) as film:
        for _ in range(240):
            sim.step(4)
            film.capture(sim)

    Args:
        sim: the Simulator.
        path: as in export_usd.
        fps: frames per simulated second; stored only, the caller steps the simulation.
        envs: indices of the environments to write; None writes all.
        labels: one label per environment.
        camera: the camera of the file; None for that of the scene.
        **options: as in export_usd.

    Raises:
        ValueError: An argument is out of range.
        OSError: The file cannot be written.
    """

    def __init__(
        self,
        sim: Simulator,
        path: str | PathLike[str],
        fps: float = 60.0,
        envs: Iterable[int] | None = None,
        labels: Sequence[str] | None = None,
        camera: Camera | None = None,
        **options: Any,
    ):
        """Open the file and write the first frame."""
        chosen = UsdOptions(**options)
        path = Path(path)
        chosen.check_path(path)
        if chosen.layout == "override":
            raise ValueError("layout: override is written at the end, by export_usd, and not by a stream")
        velocities = chosen.velocities or chosen.color == "speed"
        self._recorder = Recorder(sim, fps, envs, labels, velocities, chosen.contacts, camera)
        self._recorder.capture(sim)
        start = self._recorder.recording()

        from warp_rigid.usd.writer import UsdWriter

        self._writer = UsdWriter(start, path, start.rows(), chosen, live=True)
        self._writer.write(next(start.frames()))

    def capture(self, sim: Simulator) -> None:
        """Append the current state as a frame.

        Raises:
            OSError: The file cannot be written.
        """
        self._writer.write(self._recorder.snapshot(sim))

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: The file cannot be written.
        """
        self._writer.close()

    def __enter__(self) -> "UsdStream":
        """Return the stream."""
        return self

    def __exit__(self, *error: object) -> None:
        """Finish the file, also after an exception."""
        self.close()
