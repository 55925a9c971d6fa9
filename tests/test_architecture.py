"""Which module imports which, read from the syntax trees: imports in functions and for type checkers count, too."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "warp_rigid"

LAYERS = (
    ("version", "errors", "checks", "rotations", "interruption", "display", "extras", "progress_bar", "warp_start"),
    ("threads",),
    ("kernels",),
    ("files",),
    ("kernel_cache",),
    ("scene",),
    ("engine",),
    ("scenes",),
    ("runs",),
    ("render",),
    ("usd",),
    ("diagnostics",),
    ("sweep", "bench", "validation", "viewer"),
    ("notebook",),
    ("commands",),
    ("__main__",),
    (PACKAGE,),
)
"""Subpackages and modules of the package, the lowest layer first. A module imports from its own subpackage and from
the layers below it. The last one is the package's own __init__.py, which collects the public names.
"""

UPWARD = {
    ("files.mesh_files", "usd.conventions"): "opens meshes in USD files",
    ("files.mesh_files", "usd.opening"): "opens meshes in USD files",
    ("render.film", "usd.conventions"): "draws a film that is a USD file",
    ("render.film", "usd.opening"): "draws a film that is a USD file",
    ("render.film", "usd.prims"): "draws a film that is a USD file",
    ("render.film", "usd.preview_surface"): "draws a film that is a USD file",
    ("runs.runner", "usd"): "runs a scene that is a USD file",
    ("runs.runner", "usd.load"): "runs a scene that is a USD file",
    ("runs.runner", "usd.robots"): "runs a scene that is an MJCF or URDF file",
    ("scene.shapes.distance_grid", "engine.cores"): "bakes a grid on several cores",
    ("viewer.live", "commands.terminal"): "prints its address as the commands do",
}
"""Imports of a higher layer (importer, imported), with the reason. None of them makes a cycle of modules."""


def modules_in(root: Path) -> dict[str, Path]:
    """Files by the names that they are imported by; kernels/ and scenes/ lie at the top of the checkout."""
    found = {}
    for top, parent in ((PACKAGE, ()), ("kernels", (PACKAGE,)), ("scenes", (PACKAGE,))):
        for file in (root / top).rglob("*.py"):
            if not any(folder.is_symlink() for folder in file.parents):
                parts = (*parent, *file.relative_to(root).with_suffix("").parts)
                found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports_of(name: str, source: str, modules) -> set[str]:
    """Modules of the package that a module imports anywhere in its source."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: a relative import"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            # A name that is no module is defined in the module that it is imported from.
            found |= {module if module in modules else node.module for module in inner}
    return (found & set(modules)) - {name}


@cache
def graph() -> dict[str, set[str]]:
    """Imported modules of each module."""
    modules = modules_in(ROOT)
    return {name: imports_of(name, file.read_text(), modules) for name, file in modules.items()}


def cycles(edges: dict[str, set[str]]) -> list[set[str]]:
    """Sets of modules each of which imports all others of its set, directly or through others."""

    @cache
    def reached(start: str) -> frozenset[str]:
        seen, pending = set(), list(edges[start])
        while pending:
            name = pending.pop()
            if name not in seen:
                seen.add(name)
                pending += edges[name]
        return frozenset(seen)

    found = {frozenset(other for other in reached(name) if name in reached(other)) for name in edges}
    return sorted((set(members) for members in found if members), key=sorted)


def short(name: str) -> str:
    """A module's name within the package."""
    return name.removeprefix(f"{PACKAGE}.")


def level(name: str) -> int:
    """The layer of a module."""
    top = short(name).split(".")[0]
    found = [index for index, layer in enumerate(LAYERS) if top in layer]
    assert len(found) == 1, f"{name}: {top} must be in one layer"
    return found[0]


def may_import(importer: str, imported: str) -> bool:
    """Whether the layers allow it: lower ones, and one's own subpackage."""
    return level(imported) < level(importer) or short(imported).split(".")[0] == short(importer).split(".")[0]


def test_no_module_imports_itself_through_others():
    assert cycles(graph()) == []


def test_modules_import_from_lower_layers():
    upward = {
        (short(importer), short(imported))
        for importer, names in graph().items()
        for imported in names
        if not may_import(importer, imported)
    }
    assert upward == set(UPWARD), "each upward import needs a reason, and a reason that is not needed goes"
