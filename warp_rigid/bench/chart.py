"""Chart of a benchmark: throughput over the number of environments, and the time of each stage of a step."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_rigid.bench.measure import OURS
from warp_rigid.bench.notes import duration
from warp_rigid.files.atomic import atomic_file

MARKERS = "oxsd^v"
"""Markers of the engines, this one first."""
SMALL = 0.02
"""Stages below this fraction of a step are merged in the chart."""


def save_chart(rows: Sequence[dict[str, Any]], path: str) -> None:
    """Draw rows of `measure` and `run_peer` as a PNG."""
    from matplotlib.figure import Figure

    rows = [row for row in rows if "fault" not in row]
    own = [row for row in rows if row["engine"] == OURS]
    chart = Figure(figsize=(11, max(4.5, 1.5 + 0.4 * len(own))), layout="constrained")
    chart.suptitle(", ".join(dict.fromkeys(_device(row) for row in own)), fontsize=9)
    left, right = chart.subplots(1, 2)
    _draw_throughput(left, rows)
    _draw_stages(right, own)
    with atomic_file(path) as temporary:
        chart.savefig(temporary, dpi=120)


def _draw_throughput(axes: Any, rows: Sequence[dict[str, Any]]) -> None:
    from matplotlib.ticker import EngFormatter, LogLocator

    lines: dict[tuple, list] = {}
    for row in rows:
        lines.setdefault((row["engine"], row["scene"], row["bodies"], row["substeps"]), []).append(row)
    engines = list(dict.fromkeys(key[0] for key in lines))
    scenes = list(dict.fromkeys(key[1:3] for key in lines))
    for (engine, scene, bodies, substeps), points in lines.items():
        points.sort(key=lambda row: row["envs"])
        axes.plot(
            [row["envs"] for row in points],
            [row["env_frames_per_second"] for row in points],
            color=f"C{scenes.index((scene, bodies)) % 10}",
            marker=MARKERS[engines.index(engine) % len(MARKERS)],
            ls="-" if engine == OURS else "--",
            label=f"{scene}:{bodies}, {substeps} steps/frame" + ("" if engine == OURS else f", {engine}"),
        )
    axes.set(xscale="log", yscale="log", xlabel="environments", ylabel="environment frames/s")
    axes.set_xticks(sorted({row["envs"] for row in rows}), minor=False)
    axes.set_xticks([], minor=True)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.set_yticks([], minor=True)
    axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)


def _draw_stages(axes: Any, rows: Sequence[dict[str, Any]]) -> None:
    parts = [row["stage_seconds"] for row in rows]
    totals = np.array([sum(seconds.values()) for seconds in parts])
    names = dict.fromkeys(name for seconds in parts for name in seconds)
    shares = {name: [seconds.get(name, 0.0) for seconds in parts] / totals for name in names}
    wide = {name: share for name, share in shares.items() if (share > SMALL).any()}
    bars = wide | {"others": 1.0 - sum(wide.values())}
    ends = np.zeros(len(rows))
    for k, (name, share) in enumerate(bars.items()):
        style = {"color": f"C{k % 10}", "hatch": "//" * (k // 10), "label": name.replace("_", " ")}
        axes.barh(range(len(rows)), 100.0 * share, left=100.0 * ends, **style)
        ends += share
    labels = [
        f"{r['scene']}:{r['bodies']} × {r['envs']}\n{duration(t)} per step" for r, t in zip(rows, totals, strict=True)
    ]
    axes.set_yticks(range(len(rows)), labels, fontsize=7)
    axes.set(xlabel="share of a step [%]", xlim=(0, 100))
    axes.invert_yaxis()
    axes.legend(fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _device(row: dict[str, Any]) -> str:
    """The device of a row, with the number of cores if it is a CPU."""
    return f"CPU, {row['cores']} cores" if row["device"] == "cpu" else row["device_name"]
