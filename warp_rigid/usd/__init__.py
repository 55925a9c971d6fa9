"""USD in and out: films and scenes with physics; nothing here imports the USD library before it is used."""

from warp_rigid.scene.import_report import ImportReport
from warp_rigid.usd.export import UsdStream, export_usd
from warp_rigid.usd.load import import_usd
from warp_rigid.usd.robots import import_robot

__all__ = ["ImportReport", "UsdStream", "export_usd", "import_robot", "import_usd"]
