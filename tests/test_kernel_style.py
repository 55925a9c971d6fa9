"""Limits on sizes, and what a formatter cannot see, read from the syntax trees."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILES = {
    file.relative_to(ROOT).as_posix(): file.read_text()
    for folder in ("warp_rigid", "kernels", "scenes", "tests")
    for file in sorted((ROOT / folder).rglob("*.py"))
    if not any(parent.is_symlink() for parent in file.parents)
}
TREES = {name: ast.parse(text) for name, text in FILES.items() if not name.startswith("tests/")}
MAX_FILE_LINES = 600
MAX_LINES = 60
MAX_ARGUMENTS = 12


def device_functions(tree: ast.AST, *decorators: str) -> list[ast.FunctionDef]:
    """Functions with one of these decorators, also where these are called."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(each).partition("(")[0] in decorators for each in node.decorator_list)
    ]


def test_no_file_is_long():
    assert {name: text.count("\n") for name, text in FILES.items() if text.count("\n") > MAX_FILE_LINES} == {}


def test_kernels_and_device_functions_are_short():
    for name, tree in TREES.items():
        for function in device_functions(tree, "wp.kernel", "wp.func", "wp.func_native"):
            lines, arguments = function.end_lineno - function.lineno + 1, len(function.args.args)
            assert lines <= MAX_LINES and arguments <= MAX_ARGUMENTS, (name, function.name, lines, arguments)


def test_no_kernel_is_compiled_for_derivatives():
    """That would double the time of their compilation."""
    off = "wp.set_module_options({'enable_backward': False"
    kernels = {name: tree for name, tree in TREES.items() if device_functions(tree, "wp.kernel")}
    assert len(kernels) > 20
    assert [name for name, tree in kernels.items() if not any(ast.unparse(x).startswith(off) for x in tree.body)] == []


def test_a_name_of_a_constant_has_one_meaning():
    """No two files of kernels define the same constant; one imports it from the other."""
    found = {}
    for file in (ROOT / "kernels").rglob("*.py"):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.Assign):
                names = [name.id for name in ast.walk(node.targets[0]) if isinstance(name, ast.Name)]
                for name in names:
                    if name.isupper():
                        found.setdefault(name, set()).add(file.name)
    assert {name: files for name, files in found.items() if len(files) > 1} == {}
