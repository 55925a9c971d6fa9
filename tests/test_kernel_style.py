"""Limits on sizes, and what a formatter cannot see, read from the syntax trees."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAX_FILE_LINES = 600
MAX_LINES = 60
MAX_ARGUMENTS = 12


@pytest.fixture(scope="module")
def files():
    """Text of each Python file, by its path."""
    return {
        file.relative_to(ROOT).as_posix(): file.read_text()
        for folder in ("warp_rigid", "kernels", "scenes", "tests")
        for file in sorted((ROOT / folder).rglob("*.py"))
        if not any(parent.is_symlink() for parent in file.parents)
    }


@pytest.fixture(scope="module")
def trees(files):
    """Syntax trees of those that are no tests."""
    return {name: ast.parse(text) for name, text in files.items() if not name.startswith("tests/")}


def device_functions(tree: ast.AST, *decorators: str) -> list[ast.FunctionDef]:
    """Functions with one of these decorators, also where these are called."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(each).partition("(")[0] in decorators for each in node.decorator_list)
    ]


def test_no_file_is_long(files):
    assert {name: text.count("\n") for name, text in files.items() if text.count("\n") > MAX_FILE_LINES} == {}


def test_kernels_and_device_functions_are_short(trees):
    for name, tree in trees.items():
        for function in device_functions(tree, "wp.kernel", "wp.func", "wp.func_native"):
            lines, arguments = function.end_lineno - function.lineno + 1, len(function.args.args)
            assert lines <= MAX_LINES and arguments <= MAX_ARGUMENTS, (name, function.name, lines, arguments)


def test_no_kernel_is_compiled_for_derivatives(trees):
    """That would double the time of their compilation."""
    off = "wp.set_module_options({'enable_backward': False"
    kernels = {name: tree for name, tree in trees.items() if device_functions(tree, "wp.kernel")}
    assert len(kernels) > 20
    assert [name for name, tree in kernels.items() if not any(ast.unparse(x).startswith(off) for x in tree.body)] == []


def test_a_name_of_a_constant_has_one_meaning(trees):
    """No two files of kernels define the same constant; one imports it from the other."""
    found = {}
    for file, tree in trees.items():
        for node in tree.body if file.startswith("kernels/") else ():
            if isinstance(node, ast.Assign):
                names = [name.id for name in ast.walk(node.targets[0]) if isinstance(name, ast.Name)]
                for name in names:
                    if name.isupper():
                        found.setdefault(name, set()).add(file)
    assert {name: files for name, files in found.items() if len(files) > 1} == {}
