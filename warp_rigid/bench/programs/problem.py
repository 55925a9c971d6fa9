"""Shared by the programs of this folder: reading a problem, and timing a run.

Only NumPy is needed here, so that each engine can run in a separate Python environment; convex parts of meshes need
coacd, and engines on Warp need it.
"""

import hashlib
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

COACD_THRESHOLD = 0.05


class PeerProblem:
    """Bodies of one shape above the ground plane z = 0, in several environments.

    Attributes:
        engine: name of the engine.
        position: (envs, bodies, 3) [m].
        orientation: (envs, bodies, 4) unit quaternions (x, y, z, w).
        half_extents: (3,) of a box, or None for a mesh [m].
        vertices: (n, 3) of a mesh in its principal frame about its centre of mass [m], or None.
        faces: (m, 3) of a mesh.
        inertia: (3,) principal moments [kg m^2].
        mass: [kg].
        density: [kg/m^3].
        friction: Coulomb coefficient of every contact.
        restitution: coefficient of every body.
        gravity: (3,) [m/s^2].
        dt: time step [s].
        substeps: steps per frame.
        settle: frames before the timed ones.
        frames: timed frames.
        fixed: static boxes and upright cylinders.
        hinges: driven hinges, which make the bodies one tree in their order; empty if the bodies are free. The poses of
            their bodies at the start are those of angle 0.
        targets: (envs, hinges) target angles of the drives [rad], or None.
        device: such as "cpu" or "cuda:0".
        cache: folder for convex parts.
    """

    def __init__(self, path: str) -> None:
        """Read a file that `warp-rigid bench` wrote."""
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        for name, value in json.loads(str(arrays.pop("figures"))).items():
            setattr(self, name, value)
        self.half_extents = self.vertices = self.faces = self.targets = None
        for name, value in arrays.items():
            setattr(self, name, value)
        self.num_envs, self.num_bodies = self.position.shape[:2]

    @property
    def real_first(self) -> np.ndarray:
        """Orientations as (w, x, y, z)."""
        return self.orientation[..., [3, 0, 1, 2]]

    def convex_parts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Vertices and faces of the convex parts of the mesh by CoACD; cached, because this may take a minute."""
        key = hashlib.sha256(self.vertices.tobytes() + self.faces.tobytes()).hexdigest()[:24]
        path = Path(self.cache) / f"convex-{key}-{COACD_THRESHOLD}.npz"
        if not path.is_file():
            import coacd

            coacd.set_log_level("error")
            mesh = coacd.Mesh(np.asarray(self.vertices, np.float64), np.asarray(self.faces, np.int32))
            parts = coacd.run_coacd(mesh, threshold=COACD_THRESHOLD)
            path.parent.mkdir(parents=True, exist_ok=True)
            named = {f"{kind}{i}": np.asarray(part[k]) for i, part in enumerate(parts) for k, kind in enumerate("vf")}
            np.savez(path, **named)
        with np.load(path) as file:
            return [(file[f"v{i}"], file[f"f{i}"]) for i in range(len(file.files) // 2)]


def timed(problem: PeerProblem, advance: Callable[[int], None]) -> dict[str, float]:
    """Settle, then time the frames.

    Args:
        problem: gives the number of frames.
        advance: simulates a number of frames in all environments, and returns when they are complete.
    """
    advance(problem.settle)
    begin, start = time.perf_counter(), time.process_time()
    advance(problem.frames)
    return {"seconds": time.perf_counter() - begin, "processor_seconds": time.process_time() - start}


def timed_one_by_one(problem: PeerProblem, advance: Callable[[int, int], None]) -> dict[str, Any]:
    """Settle and time the environments one after another.

    Args:
        problem: gives the numbers of frames and environments.
        advance: simulates an environment, by its index, for a number of frames.

    Returns:
        As `timed`, and the processor time of each environment, "environment_seconds".
    """
    each = [timed(problem, partial(advance, env)) for env in range(problem.num_envs)]
    total = {name: sum(one[name] for one in each) for name in ("seconds", "processor_seconds")}
    return {**total, "environment_seconds": [one["processor_seconds"] for one in each]}


def timed_on_device(problem: PeerProblem, frame: Callable[[], None], restart: Callable[[], None]) -> dict[str, float]:
    """Settle and time all environments together, on Warp's current device; a frame is one graph on CUDA.

    Args:
        problem: gives the number of frames.
        frame: simulates a frame.
        restart: sets the state at the start.
    """
    import warp as wp

    frame()  # compiles
    graph = None
    if wp.get_device().is_cuda:
        with wp.ScopedCapture() as capture:
            frame()
        graph = capture.graph
    restart()

    def advance(frames: int) -> None:
        for _ in range(frames):
            frame() if graph is None else wp.capture_launch(graph)
        wp.synchronize_device()

    return timed(problem, advance)


def as_obj(parts: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """Text of an OBJ file with one object per part."""
    lines, first = [], 1
    for i, (vertices, faces) in enumerate(parts):
        lines.append(f"o part{i}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(faces) + first]
        first += len(vertices)
    return "\n".join(lines) + "\n"
