"""House rules of the source that a formatter cannot see, read from the syntax trees."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("warp_rigid", "kernels", "scenes", "tests")
FILES = sorted(
    file
    for folder in FOLDERS
    for file in (ROOT / folder).rglob("*.py")
    if not any(parent.is_symlink() for parent in file.parents)
)
PACKAGE = [file for file in FILES if file.relative_to(ROOT).parts[0] in ("warp_rigid", "kernels", "scenes")]
MAX_FILE_LINES = 600
MAX_LINES = 60
MAX_ARGUMENTS = 12


def decorator_name(node: ast.expr) -> str:
    return ast.unparse(node.func if isinstance(node, ast.Call) else node)


def decorated(tree: ast.AST, *decorators: str) -> list[ast.FunctionDef]:
    """Functions with one of these decorators."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and any(decorator_name(d) in decorators for d in node.decorator_list)
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


def root_name(node: ast.expr) -> str:
    """The variable of `name.field[index]`, "" if there is none."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def written_names(function: ast.FunctionDef) -> set[str]:
    """Arguments whose elements are assigned or changed by an atomic operation."""
    stored = {root_name(n) for n in ast.walk(function) if isinstance(n, ast.Subscript) and isinstance(n.ctx, ast.Store)}
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    return stored | {root_name(call.args[0]) for call in calls if ast.unparse(call.func).startswith("wp.atomic_")}


def inputs_after_outputs(function: ast.FunctionDef) -> list[str]:
    """Arguments that are only read although an argument before them is written.

    An argument that is passed to another function, or a part of it, counts as neither: what that function does with it
    is not visible.
    """
    written = written_names(function)
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    passed = {root_name(part) for call in calls if not ast.unparse(call.func).startswith("wp.") for part in call.args}
    names = [argument.arg for argument in function.args.args]
    first = next((index for index, name in enumerate(names) if name in written), len(names))
    return [name for name in names[first:] if name not in written | passed]


def function_faults(function: ast.FunctionDef) -> list[str]:
    """What is wrong with a kernel or a device function."""
    arguments = function.args
    lines = function.end_lineno - function.lineno + 1
    faults = []
    if ast.get_docstring(function) is None:
        faults.append("has no docstring")
    if lines > MAX_LINES:
        faults.append(f"has {lines} lines, at most {MAX_LINES}")
    if len(arguments.args) > MAX_ARGUMENTS:
        faults.append(f"has {len(arguments.args)} arguments, at most {MAX_ARGUMENTS}")
    if arguments.defaults or arguments.kw_defaults or arguments.vararg or arguments.kwarg:
        faults.append("has defaults or variable arguments")
    faults += [
        f"argument {argument.arg} {fault}"
        for argument in arguments.args
        for fault in annotation_faults(argument.annotation)
    ]
    faults += [f"argument {name} is an input after an output" for name in inputs_after_outputs(function)]
    return [f"{function.name} {fault}" for fault in faults]


def switches_adjoint_off(tree: ast.Module) -> bool:
    return any(
        ast.unparse(node).startswith("wp.set_module_options({'enable_backward': False")
        for node in tree.body
        if isinstance(node, ast.Expr)
    )


def file_faults(source: str) -> list[str]:
    tree = ast.parse(source)
    functions = decorated(tree, "wp.kernel", "wp.func", "wp.func_native")
    faults = [fault for function in functions for fault in function_faults(function)]
    if decorated(tree, "wp.kernel") and not switches_adjoint_off(tree):
        faults.append("the module does not set enable_backward to False")
    return faults


def repeated(found: list[tuple[str, Path]]) -> dict[str, list[str]]:
    """Names that occur more than once, with the files that they occur in."""
    places = defaultdict(list)
    for name, file in found:
        places[name].append(file.relative_to(ROOT).as_posix())
    return {name: files for name, files in places.items() if len(files) > 1}


def test_a_file_name_occurs_once():
    """A file can be named without its folder; a command's file has the name of what it runs."""
    named = [(file.name, file) for file in PACKAGE if file.name != "__init__.py" and file.parent.name != "commands"]
    assert repeated(named) == {}


def test_a_class_name_is_defined_once():
    named = [
        (node.name, file)
        for file in PACKAGE
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.ClassDef)
    ]
    assert repeated(named) == {}


def test_no_file_is_long():
    lengths = {file.relative_to(ROOT).as_posix(): file.read_text().count("\n") for file in FILES}
    assert {name: lines for name, lines in lengths.items() if lines > MAX_FILE_LINES} == {}


def test_every_file_keeps_the_rules():
    found = {file.relative_to(ROOT).as_posix(): file_faults(file.read_text()) for file in PACKAGE}
    assert {name: faults for name, faults in found.items() if faults} == {}
