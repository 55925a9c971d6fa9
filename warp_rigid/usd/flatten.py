"""Expansion of the instancers of a file to Xforms, for programs that do not support instancers."""

from pathlib import Path

from pxr import Usd, UsdGeom

from warp_rigid.files.atomic import check_unread
from warp_rigid.usd.instancing import expand_instancers
from warp_rigid.usd.opening import convert_errors, open_stage
from warp_rigid.usd.options import SUFFIXES
from warp_rigid.usd.specs import export_layer


def flatten_usd(source, target) -> int:
    """Copy a file and replace each PointInstancer by one Xform per instance, including its motion.

    Args:
        source: the file to read.
        target: the file to write: .usd, .usda or .usdc.

    Returns:
        The number of instances.

    Raises:
        FileNotFoundError: The source does not exist.
        ValueError: The source is not a USD file, its number of instances changes over time, or the target has another
            suffix or is a file that is read.
        OSError: The target cannot be written.
    """
    source, target = Path(source), Path(target)
    if target.suffix not in SUFFIXES or target.suffix == ".usdz":
        raise ValueError(f"{target}: must end in .usd, .usda or .usdc")
    stage = open_stage(source)
    check_unread([target], [layer.realPath for layer in stage.GetUsedLayers() if layer.realPath])
    with convert_errors(source):
        # Equal rates keep USD from scaling the times of the session layer.
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
    export_layer(stage.Flatten(addSourceFileComment=False), target)
    return count
