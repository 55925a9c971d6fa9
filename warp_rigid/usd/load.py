"""USD import of files with UsdPhysics."""

from os import PathLike
from pathlib import Path

from warp_rigid.scene.import_report import ImportReport
from warp_rigid.scene.scene import Scene


def import_usd(
    path: str | PathLike[str], root: str | None = None, *, strict: bool = False, sdf_resolution: int = 64
) -> Scene:
    """Read the rigid bodies and colliders of a USD file.

    Lengths, masses and the up axis are converted to metres, kilograms and z. Meshes collide as nonconvex solids with a
    signed distance grid. References, instances and PointInstancers are expanded. Poses are those at the start of the
    animation; animated kinematic bodies follow their motion as a path. A file that export_usd wrote with several
    environments becomes one scene with the bodies of all of them; root="/World/env_0000" reads the first one.

    Unsupported content, such as D6 joints, is listed in `scene.import_report`, with a warning.

    Args:
        path: .usd, .usda, .usdc or .usdz.
        root: path of the prim below which to read; poses are relative to it. None reads the whole stage.
        strict: reject a file that cannot be imported completely and unchanged.
        sdf_resolution: grid cells along the longest side of meshes without their own resolution.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is not a USD file, has no bodies, or `strict` is set and the import is incomplete.
    """
    path = Path(path)

    from warp_rigid.usd.opening import convert_errors
    from warp_rigid.usd.reader import Reader
    from warp_rigid.usd.usd_file import UsdFile

    with convert_errors(path):
        file = UsdFile(path, root)
        scene = Reader(file, sdf_resolution).scene()
    scene.import_report = ImportReport(str(path), tuple(file.findings), root, file.prims, file.files, file.cameras)
    scene.import_report.tell(strict, stacklevel=2)
    return scene


def film_duration(path) -> float:
    """Duration of the animation in a file [s]; 0 without animation.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is not a USD file, or its range of time codes is not that of a film.
    """
    from warp_rigid.usd.conventions import time_codes
    from warp_rigid.usd.opening import convert_errors, open_stage

    stage = open_stage(Path(path))
    with convert_errors(path):
        first, last, rate = time_codes(stage)
        return (last - first) / rate
