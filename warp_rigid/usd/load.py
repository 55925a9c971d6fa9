"""USD import: a file with UsdPhysics as a Scene."""

import warnings
from pathlib import Path

from warp_rigid.scene.import_report import ImportReport
from warp_rigid.scene.scene import Scene

__all__ = ["film_duration", "import_usd"]


def import_usd(path, root: str | None = None, *, strict: bool = False, sdf_resolution: int = 64) -> Scene:
    """Read the rigid bodies and colliders of a USD file.

    Lengths, masses and the up axis become metres, kilograms and z. Meshes collide as what they are, by a grid of signed
    distances. References, instances and PointInstancers are expanded. The poses are those at the default time.

    What the file has and the scene cannot have (joints, articulations, unknown schemas) is in `scene.import_report`,
    and a warning says how much it is.

    Args:
        path: .usd, .usda, .usdc or .usdz.
        root: path of the prim below which to read, in whose frame the poses are taken; None reads the whole stage.
        strict: refuse a file that cannot be taken over completely.
        sdf_resolution: grid cells along the longest side of meshes that do not say it themselves.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no USD file, holds no bodies, or `strict` is set and something would be lost.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")

    from warp_rigid.usd.opening import reading
    from warp_rigid.usd.reader import Reader

    with reading(path):
        reader = Reader(path, root, sdf_resolution)
        scene = reader.scene()
    scene.import_report = ImportReport(str(path), tuple(reader.findings))
    lost = len(scene.import_report.left_out)
    if strict and reader.findings:
        more = f" (and {len(reader.findings) - 1} more)" if len(reader.findings) > 1 else ""
        raise ValueError(f"{path}: {reader.findings[0]}{more}")
    if lost:
        first = scene.import_report.left_out[0]
        warnings.warn(f"{path}: {lost} left out, see scene.import_report; the first: {first}", stacklevel=2)
    return scene


def film_duration(path) -> float:
    """How long the film in a file is [s]; 0 where it has none.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no USD file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")

    from warp_rigid.usd.opening import open_stage

    stage = open_stage(path)
    return (stage.GetEndTimeCode() - stage.GetStartTimeCode()) / stage.GetTimeCodesPerSecond()
