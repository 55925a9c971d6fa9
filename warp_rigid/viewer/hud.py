"""Text and plot over the page: rate, counts, deepest overlap, energies and verdicts of the scene."""

from collections import deque

import numpy as np

from warp_rigid.scene.scene import Motion
from warp_rigid.scenes.demo import AT_REST, Verdict, shown_value
from warp_rigid.viewer.session import Paced, Session

HISTORY = 240
"""Points of the energy plot."""


class Hud:
    """The values, updated at most as often as they can be read.

    Args:
        server: the viser server; its current container takes the figures.
    """

    def __init__(self, server):
        """Add an empty text and an empty plot."""
        self._text = server.gui.add_markdown("")
        # Closed at first, so that the tabs below are in sight.
        with server.gui.add_folder("Energy [J]", expand_by_default=False):
            server.gui.add_markdown("kinetic red, potential blue, total black")
            self._plot = server.gui.add_uplot(
                data=(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2)),
                series=(
                    {"label": "t [s]"},
                    {"label": "kinetic [J]", "stroke": "#d1495b", "width": 2},
                    {"label": "potential [J]", "stroke": "#3f7fbf", "width": 2},
                    {"label": "total [J]", "stroke": "#30343a", "width": 2},
                ),
                scales={"x": {"time": False}},
                legend={"show": False},
                height=110,
            )
        self._refresh = Paced(share=0.02, period=0.2, patience=0.5)
        self._overlap = Paced(share=0.01, period=0.5, patience=5.0)
        self.restart()

    def restart(self) -> None:
        """Clear the plot and the verdicts, after a restart or for another scene."""
        self._energy = deque(maxlen=HISTORY)
        self._deepest = 0.0
        # Those of meshes compute distances of all samples, which takes longer than several updates.
        self._judge = Paced(share=0.01, patience=10.0)
        self._verdicts: list[Verdict] = []

    def update(self, session: Session, rows: np.ndarray, rate: float, pace: float) -> bool:
        """Show the current values, unless they were updated very recently; return whether it did.

        Args:
            session: what runs.
            rows: environments on the page, whose bodies and energies count.
            rate: updates of the page per second.
            pace: simulated seconds per second.
        """
        deepest = self._overlap(session.sim.penetration)
        if deepest is not None:
            self._deepest = float(deepest[rows].max())
        return bool(self._refresh(self._show, session, rows, rate, pace))

    def _show(self, session: Session, rows: np.ndarray, rate: float, pace: float) -> bool:
        sim = session.sim
        kinetic = float(sim.get("kinetic_energy")[rows].sum())
        potential = float(sim.get("potential_energy")[rows].sum())
        if not self._energy or session.time > self._energy[-1][0]:
            self._energy.append((session.time, kinetic, potential, kinetic + potential))
        points = list(self._energy)
        if len(points) == 1:  # a line needs two points: before the first step it is level
            points.append((points[0][0] + session.sim.settings.dt, *points[0][1:]))
        self._plot.data = tuple(np.array(points).T.copy())
        judged = self._judge(lambda: session.verdicts) if session.running else session.verdicts
        self._verdicts = self._verdicts if judged is None else judged
        self._text.content = _text(session, rows, rate, pace, self._deepest, self._verdicts)
        return True


def _text(session: Session, rows: np.ndarray, rate: float, pace: float, deepest: float, verdicts: list[Verdict]) -> str:
    sim = session.sim
    counts = sim.counts()
    dynamic = np.array([body.motion == Motion.DYNAMIC for body in sim.scene.bodies])
    asleep = sim.get("asleep")[rows][:, dynamic]
    slow = np.linalg.norm(sim.get("linear_velocity")[rows][:, dynamic], axis=-1) < AT_REST
    lines = [
        f"**{'running' if session.running else 'paused'}** at {session.time:.2f} s, {pace:.2f} x real time, "
        f"{rate:.0f} updates/s",
        f"bodies **{dynamic.sum() * len(rows)}**, resting **{int((asleep | slow).sum())}** "
        f"({int(asleep.sum())} asleep), contacts **{counts['contacts']}**, levels **{counts['levels']}**",
        f"deepest overlap **{1e3 * deepest:.3f} mm**",
    ]
    failed = sim.status()
    for env in np.flatnonzero(failed["status"] != "ok")[:3]:
        lines.append(f"environment {env}: **{failed['status'][env]}** since step {failed['step'][env]}")
    for env in np.flatnonzero(failed["warning"] != "")[:3]:
        lines.append(f"environment {env}: warning: **{failed['warning'][env]}**")
    for verdict in verdicts:
        shown = _shown(verdict, rows)
        lines.append(f"{verdict.limit or verdict.name}: **{', '.join(shown[:4])}**{' ...' if len(shown) > 4 else ''}")
    return "\n\n".join(lines)


def _shown(verdict: Verdict, rows: np.ndarray) -> list[str]:
    """The value of each environment, and whether the condition holds if there is one."""
    values = [shown_value(value, verdict.unit) for value in verdict.values[rows]]
    if verdict.passed is None:
        return values
    answers = ["yes" if passed else "no" for passed in verdict.passed[rows]]
    if verdict.values.dtype == bool:
        return answers
    return [f"{answer} ({value})" for answer, value in zip(answers, values, strict=True)]
