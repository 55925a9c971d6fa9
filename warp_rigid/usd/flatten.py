"""Instancers to Xforms in a file, for programs that do not read instancers."""

from pathlib import Path

from pxr import Tf, Usd, UsdGeom

from warp_rigid.usd.instancing import expand_instancers
from warp_rigid.usd.opening import open_stage, reading
from warp_rigid.usd.options import SUFFIXES

__all__ = ["flatten_usd"]


def flatten_usd(source, target) -> int:
    """Write a file anew with one Xform for each instance of a PointInstancer, its motion included.

    Args:
        source: the file to read.
        target: the file to write: .usd, .usda or .usdc.

    Returns:
        How many instances there are.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no USD file, its instancers change in number, or the target has another ending.
        OSError: The target cannot be written.
    """
    source, target = Path(source), Path(target)
    if target.suffix not in SUFFIXES or target.suffix == ".usdz":
        raise ValueError(f"{target}: must end in .usd, .usda or .usdc")
    if not source.is_file():
        raise FileNotFoundError(f"{source}: no such file")
    stage = open_stage(source)
    with reading(source):
        # Times of a layer with another rate would be scaled to the stage's.
        stage.GetSessionLayer().timeCodesPerSecond = stage.GetTimeCodesPerSecond()
        stage.SetEditTarget(stage.GetSessionLayer())
        times = sorted(
            {
                time
                for prim in stage.Traverse()
                if prim.IsA(UsdGeom.PointInstancer)
                for attribute in prim.GetAttributes()
                for time in attribute.GetTimeSamples()
            }
        )
        moments = [Usd.TimeCode.Default(), *(Usd.TimeCode(time) for time in times)]
        count = expand_instancers(stage.GetPseudoRoot(), moments)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        written = stage.Flatten(addSourceFileComment=False).Export(str(target))
    except Tf.ErrorException:
        written = False
    if not written:
        raise OSError(f"{target}: cannot be written")
    return count
