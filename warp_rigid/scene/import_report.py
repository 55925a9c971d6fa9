"""What an import could not take over."""

from dataclasses import dataclass

__all__ = ["Finding", "ImportReport"]


@dataclass(frozen=True)
class Finding:
    """One thing of a file that the scene does not have, or has otherwise.

    Attributes:
        path: of the prim.
        kind: "left out" or "changed".
        reason: what and why, in words.
    """

    path: str
    kind: str
    reason: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.path}: {self.kind}: {self.reason}"


@dataclass(frozen=True)
class ImportReport:
    """All findings of an import; empty where the scene is what the file says.

    Attributes:
        file: what was read.
        findings: in the order in which they were found.
    """

    file: str
    findings: tuple[Finding, ...] = ()

    @property
    def left_out(self) -> list[Finding]:
        """What the scene does not have at all."""
        return [finding for finding in self.findings if finding.kind == "left out"]

    @property
    def changed(self) -> list[Finding]:
        """What the scene has otherwise than the file says."""
        return [finding for finding in self.findings if finding.kind == "changed"]

    def __str__(self) -> str:
        """One line for each finding."""
        return "\n".join(str(finding) for finding in self.findings) or f"{self.file}: everything was taken over"
