"""Stability of a leaning tower with each mode of shock propagation.

By statics, N boxes of width w, each shifted by d relative to the one below, are stable while N d <= w.
"""

import argparse
from pathlib import Path

import numpy as np

import warp_rigid as wr


def main(arguments=None):
    """Sweep offset and height for the three modes, and plot a map of each with the prediction of statics."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=24, help="number of offsets")
    parser.add_argument("--heights", type=int, nargs="+", default=[3, 4, 5, 6, 8, 10, 12, 15], help="numbers of boxes")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)

    result = wr.sweep(
        "leaning_tower",
        {
            "offset": np.linspace(0.04, 0.4, options.size),
            "height": options.heights,
            "shock_propagation": ["off", "one_pass", "two_pass"],
        },
        metrics=["toppled", "drift"],
        output=options.out / "stability.parquet",
        resume=True,
    )

    figure = result.plot(options.out / "stability.png", x="offset", y="toppled", kind="heatmap")
    heights = np.linspace(min(options.heights), max(options.heights), 100)
    for panel in figure.axes[:3]:
        panel.plot(1.0 / heights, heights, "r--", linewidth=1)
        panel.set_xlim(0.04, 0.4)
    figure.savefig(options.out / "stability.png")

    for mode in ("off", "one_pass", "two_pass"):
        rows = [row for row in result.rows if row["shock_propagation"] == mode]
        right = sum(row["toppled"] == (row["height"] * row["offset"] > 1.0) for row in rows)
        print(f"{mode}: {right} of {len(rows)} towers agree with statics")
    return result


if __name__ == "__main__":
    main()
