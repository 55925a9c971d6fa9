"""USD export: films that any USD viewer plays, and scenes with physics."""

from pathlib import Path

from warp_rigid.runs.recording import Recorder, Recording
from warp_rigid.usd.options import UsdOptions

__all__ = ["UsdStream", "export_usd"]


def export_usd(
    recording: Recording,
    path,
    envs=None,
    *,
    profile: str = "auto",
    color: str = "body",
    layout: str = "single",
    contacts: bool = False,
    velocities: bool = False,
) -> None:
    """Write a recording as USD: z up, metres, one time code a frame.

    Poses are in the environment's own coordinates. Several environments stand on a grid, by their own prims only, so
    that one of them can be taken out and float32 stays exact.

    Args:
        recording: what to write.
        path: ends in .usdc (compact), .usda (text), .usdz (one file to pass on) or .usd; folders
            are made.
        envs: numbers of the environments to write; None writes all that were recorded.
        profile: "animation": one PointInstancer for each shape, small and quick for large batches; "scene": one prim
            for each body with UsdPhysics, which import_usd and other simulators read; "auto": a scene
            up to 2000 bodies.
        color: what a body's colour tells: "body", "environment", "level", "speed" or "asleep".
        layout: "single": one file; "payloads": one file for each environment beside it, loaded on demand; "clips": one
            file for each stretch of time.
        contacts: whether contact points and impulses are drawn; they must have been recorded.
        velocities: whether instances carry velocities for motion blur; they must have been recorded.

    Raises:
        ValueError: The path has another ending, an environment or a quantity was not recorded, or an option is
            unknown.
        OSError: The file cannot be written.
    """
    options = UsdOptions(profile, color, layout, contacts, velocities)
    path = Path(path)
    options.check_path(path)
    options.check_film(recording)
    rows = recording.rows(envs)

    from warp_rigid.usd.writer import UsdWriter

    writer = UsdWriter(recording, path, rows, options, live=False)
    for frame in recording.frames():
        writer.write(frame)
    writer.close()


class UsdStream:
    """Writes a film while the simulation runs, without keeping it in memory.

    The first frame is the state at the start; each `capture` appends one. The file can be opened at any time, also
    when the program is killed: of an animation at most the last 24 frames are missing, of a scene or a text file at
    most the last 24 or a fifth.

    with wr.UsdStream(sim, "film.usdc", fps=60) as film:
        for _ in range(240):
            sim.step(4)
            film.capture(sim)

    Args:
        sim: the Simulator.
        path: as in export_usd.
        fps: frames per simulated second, only noted here: the caller steps.
        envs: numbers of the environments to write; None writes all.
        labels: a text for each of them.
        **options: as in export_usd.

    Raises:
        ValueError: An argument is out of its range.
        OSError: The file cannot be written.
    """

    def __init__(self, sim, path, fps: float = 60.0, envs=None, labels=None, **options):
        """Open the file and write the first frame."""
        chosen = UsdOptions(**options)
        path = Path(path)
        chosen.check_path(path)
        velocities = chosen.velocities or chosen.color == "speed"
        self._recorder = Recorder(sim, fps, envs, labels, velocities=velocities, contacts=chosen.contacts)
        self._recorder.capture(sim)
        start = self._recorder.recording()

        from warp_rigid.usd.writer import UsdWriter

        self._writer = UsdWriter(start, path, start.rows(), chosen, live=True)
        self._writer.write(next(start.frames()))

    def capture(self, sim) -> None:
        """Append the state of now as a frame.

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
        """The stream itself."""
        return self

    def __exit__(self, *error) -> None:
        """Finish the file, also after an error: the frames so far are worth keeping."""
        self.close()
