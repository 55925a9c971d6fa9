"""House rules of the source that a formatter cannot see, read from the syntax trees."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("warp_rigid", "kernels", "scenes", "tests", "benchmarks")
FILES = sorted(
    file
    for folder in FOLDERS
    for file in (ROOT / folder).rglob("*.py")
    if not any(parent.is_symlink() for parent in file.parents)
)
MAX_FILE_LINES = 600
MAX_KERNEL_LINES = 60
MAX_KERNEL_ARGUMENTS = 12


def decorator_name(node: ast.expr) -> str:
    return ast.unparse(node.func if isinstance(node, ast.Call) else node)


def kernels_of(tree: ast.AST) -> list[ast.FunctionDef]:
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and any(decorator_name(d) == "wp.kernel" for d in node.decorator_list)
    ]


def annotation_faults(annotation: ast.expr | None) -> list[str]:
    """Array arguments are written `wp.array[...]`, `wp.array2d[...]`, never called."""
    if annotation is None:
        return ["has no annotation"]
    if isinstance(annotation, ast.Call):
        return [f"is annotated by a call: {ast.unparse(annotation)}"]
    text = ast.unparse(annotation)
    if text.startswith("wp.array") and not isinstance(annotation, ast.Subscript):
        return [f"names no element type: {text}"]
    return []


def kernel_faults(kernel: ast.FunctionDef) -> list[str]:
    arguments = kernel.args
    lines = kernel.end_lineno - kernel.lineno + 1
    faults = []
    if lines > MAX_KERNEL_LINES:
        faults.append(f"has {lines} lines, at most {MAX_KERNEL_LINES}")
    if len(arguments.args) > MAX_KERNEL_ARGUMENTS:
        faults.append(f"has {len(arguments.args)} arguments, at most {MAX_KERNEL_ARGUMENTS}")
    if arguments.defaults or arguments.kw_defaults or arguments.vararg or arguments.kwarg:
        faults.append("has defaults or variable arguments")
    faults += [
        f"argument {argument.arg} {fault}"
        for argument in arguments.args
        for fault in annotation_faults(argument.annotation)
    ]
    return [f"{kernel.name} {fault}" for fault in faults]


def switches_adjoint_off(tree: ast.Module) -> bool:
    return any(
        ast.unparse(node).startswith("wp.set_module_options({'enable_backward': False")
        for node in tree.body
        if isinstance(node, ast.Expr)
    )


def shadow_imports(tree: ast.AST) -> list[str]:
    """Imports of kernels/ and scenes/ by a second name: each would compile every kernel twice."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.append(node.module)
    return [name for name in names if name.split(".")[0] in ("kernels", "scenes")]


def file_faults(source: str) -> list[str]:
    tree = ast.parse(source)
    kernels = kernels_of(tree)
    faults = [fault for kernel in kernels for fault in kernel_faults(kernel)]
    if kernels and not switches_adjoint_off(tree):
        faults.append("the module does not set enable_backward to False")
    lines = source.count("\n")
    if lines > MAX_FILE_LINES:
        faults.append(f"the file has {lines} lines, at most {MAX_FILE_LINES}")
    return faults + [f"imports {name} instead of warp_rigid.{name}" for name in shadow_imports(tree)]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_file_keeps_the_rules(file):
    assert file_faults(file.read_text()) == []


OPTIONS = 'wp.set_module_options({"enable_backward": False})\n'


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("@wp.kernel\ndef k(a: wp.array[float]):\n    pass\n", "enable_backward"),
        (OPTIONS + "@wp.kernel\ndef k(a: wp.array(dtype=float)):\n    pass\n", "by a call"),
        (OPTIONS + "@wp.kernel\ndef k(a: wp.array):\n    pass\n", "no element type"),
        (OPTIONS + "@wp.kernel\ndef k(a):\n    pass\n", "no annotation"),
        (OPTIONS + "@wp.kernel\ndef k(a: int = 1):\n    pass\n", "defaults"),
        (OPTIONS + "@wp.kernel(module='unique')\ndef k(a: int = 1):\n    pass\n", "defaults"),
        (OPTIONS + "@wp.kernel\ndef k(a: int):\n" + "    b = a\n" * 60, "61 lines"),
        (
            OPTIONS + f"@wp.kernel\ndef k({', '.join(f'a{i}: int' for i in range(13))}):\n    pass",
            "13 arguments",
        ),
        ("a = 1\n" * 601, "601 lines"),
        ("from scenes import box_stack\n", "imports scenes"),
        ("def f():\n    import kernels.bake\n", "imports kernels.bake"),
    ],
)
def test_rule_catches_its_fault(source, fault):
    assert any(fault in found for found in file_faults(source))


def test_rules_pass_a_good_kernel():
    good = OPTIONS + "@wp.kernel\ndef k(n: int, out: wp.array2d[wp.vec3]):\n    pass\n"
    assert file_faults(good) == []
