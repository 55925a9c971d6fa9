"""Report of the differences between an imported scene and its file."""

import warnings
from dataclasses import dataclass, field

from warp_rigid.scene.camera import Camera


@dataclass(frozen=True)
class ImportFinding:
    """One difference between a file and the imported scene.

    Attributes:
        path: path of the prim.
        kind: "left out" or "changed".
        reason: description of the difference.
    """

    path: str
    kind: str
    reason: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.path}: {self.kind}: {self.reason}"


@dataclass(frozen=True)
class ImportReport:
    """All differences found by an import; empty if the scene matches the file.

    Attributes:
        file: path of the imported file.
        findings: the differences, in file order.
        root: path of the prim whose descendants were read; None for the whole stage.
        prims: indices of the movable bodies in the scene, by the paths of their prims.
        cameras: cameras of the file by the paths of their prims; `Scene.camera` is the only one of a file.
        files: paths of all files that were read, with those that the imported file refers to.
    """

    file: str
    findings: tuple[ImportFinding, ...] = ()
    root: str | None = None
    prims: dict[str, int] = field(default_factory=dict)
    files: tuple[str, ...] = ()
    cameras: dict[str, Camera] = field(default_factory=dict)

    @property
    def left_out(self) -> list[ImportFinding]:
        """Findings about content that was not imported."""
        return [finding for finding in self.findings if finding.kind == "left out"]

    @property
    def changed(self) -> list[ImportFinding]:
        """Findings about content that was imported with changes."""
        return [finding for finding in self.findings if finding.kind == "changed"]

    def tell(self, strict: bool, stacklevel: int) -> None:
        """Warn about what was left out.

        Raises:
            ValueError: `strict` is set and there are findings.
        """
        if strict and self.findings:
            more = f" (and {len(self.findings) - 1} more)" if len(self.findings) > 1 else ""
            raise ValueError(f"{self.file}: {self.findings[0]}{more}")
        if self.left_out:
            text = f"{len(self.left_out)} left out, see scene.import_report; first: {self.left_out[0]}"
            warnings.warn(f"{self.file}: {text}", stacklevel=stacklevel + 1)

    def __str__(self) -> str:
        """One line per finding."""
        return "\n".join(str(finding) for finding in self.findings) or f"{self.file}: imported completely"
