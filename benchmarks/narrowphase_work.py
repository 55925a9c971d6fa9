"""Work of the narrow phase while bodies fall and land; `python -m benchmarks.narrowphase_work`.

At moments spread over the first second of each scene, the clusters, samples and distances of one step are counted, as
for the roofline, and the stage is timed. The table gives the means per pair that touches, and the floor: the time in
which an H200 does this number of samples and distances at the rate of its fastest narrow phase, one that reads a
sample, transforms it and looks up its distance (118 G/s, measured).
"""

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import roofline
from warp_rigid.bench.cases import find_case

RATE = 118e9
"""Samples that an H200 tests per second."""

SCENES = ("stack:10:64", "pile_box:32:16", "pile_box:512:1", "pile_torus:16:4", "pile_bunny:8:4")
MOMENTS = 10
STEPS_PER_SECOND = roofline.FPS * roofline.SUBSTEPS


@dataclass
class Row:
    """Means over the first second of a scene; the last four per step.

    Attributes:
        scene: name, bodies and environments.
        pairs: pairs whose bounding boxes overlap.
        searched: pairs whose contacts were searched again.
        touching: pairs with contacts.
        clusters: clusters tested.
        samples: samples tested.
        distances: distances computed, of clusters and samples.
        seconds: time of the stage `find_contacts` [s].
        overlap: deepest overlap at any of the moments [m].
    """

    scene: str
    pairs: float
    searched: float
    touching: float
    clusters: float
    samples: float
    distances: float
    seconds: float
    overlap: float

    @property
    def floor(self) -> float:
        """Least time of a step on an H200 [s]."""
        return (self.samples + self.distances) / RATE

    def line(self) -> str:
        """The row of the table."""
        each = max(self.touching, 1.0)
        cells = (
            self.scene,
            f"{self.pairs:.0f}",
            f"{self.searched:.0f}",
            f"{self.touching:.0f}",
            f"{self.clusters / each:.1f}",
            f"{self.samples / each:.1f}",
            f"{self.distances / each:.1f}",
            f"{1e6 * self.floor:.3f}",
            f"{1e6 * self.seconds:.0f}",
            f"{1e6 * self.seconds / each:.2f}",
            f"{1e3 * self.overlap:.2f}",
        )
        return f"| {' | '.join(cells)} |"


COLUMNS = (
    "scene",
    "pairs",
    "searched",
    "touching",
    "clusters per touching pair",
    "samples",
    "distances",
    "floor on an H200 [µs/step]",
    "measured [µs/step]",
    "measured per touching pair [µs]",
    "deepest overlap [mm]",
)


def measure(text: str, device: Any = None, moments: int = MOMENTS) -> Row:
    """Run a scene for a second and count the work of the narrow phase.

    Args:
        text: name, bodies and environments, such as "pile_box:32:16".
        device: the Warp device.
        moments: number of steps in which the work is counted, from 1 to 240.

    Raises:
        ValueError: There is no such scene.
    """
    name, _, envs = text.rpartition(":")
    sim = roofline.settled(find_case(name), int(envs), device, 0)
    found = []
    for _ in range(moments):
        sim.step(STEPS_PER_SECOND // moments)
        c = roofline.count(sim)
        seconds = sim.stage_times(3)["find_contacts"]
        work = (c.clusters, c.samples, c.near + c.distances)
        found.append((c.pairs, c.searched, c.touching, *work, seconds, sim.penetration().max()))
    rows = np.array(found)
    return Row(text, *rows[:, :-1].mean(axis=0).tolist(), float(rows[:, -1].max()))


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.narrowphase_work", description=__doc__)
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE:BODIES:ENVS")
    parser.add_argument("--device", default=None)
    options = parser.parse_args(arguments)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    for text in options.scenes:
        print(measure(text, options.device).line(), flush=True)


if __name__ == "__main__":
    main()
