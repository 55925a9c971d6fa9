"""Run the notebooks of the tutorials and keep their output: `.venv/bin/python docs/run_notebooks.py [NAME ...]`.

The cells of a notebook are executed one after the other in one namespace, as Jupyter does, but without Jupyter: what
they print, the figures that they show, and their last value become their output. The tests do the same.
"""

import ast
import base64
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path

NOTEBOOKS = Path(__file__).parent / "notebooks"


def run_cells(notebook: dict) -> list:
    """Execute the code cells of a notebook in place, in the working folder; returns all figures.

    Args:
        notebook: content of the file, whose outputs are replaced.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.figure import Figure

    shown: list = []
    names: dict = {"__name__": "__main__"}
    for number, cell in enumerate((c for c in notebook["cells"] if c["cell_type"] == "code"), start=1):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            value = _execute("".join(cell["source"]), names, number)
        figures = [plt.figure(k) for k in plt.get_fignums()]
        cell["execution_count"] = number
        text = printed.getvalue().splitlines(keepends=True)
        stream = {"name": "stdout", "output_type": "stream", "text": text}
        cell["outputs"] = [stream] * bool(text) + [_image(figure) for figure in figures]
        if value is not None:
            cell["outputs"].append(_result(value, number))
        shown += [*figures, value] if isinstance(value, Figure) else figures
        for figure in figures:
            plt.close(figure)
    return shown


def _execute(source: str, names: dict, number: int):
    """Execute a cell; returns the value of its last line if that is an expression, else None."""
    tree = ast.parse(source)
    last = tree.body.pop().value if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, f"cell {number}", "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last), f"cell {number}", "eval"), names)


def _result(value, number: int) -> dict:
    """The output of a value: its picture or HTML if it has one, and its text."""
    data: dict = {"text/plain": repr(value).splitlines(keepends=True)}
    if hasattr(value, "_repr_png_"):
        data["image/png"] = base64.b64encode(value._repr_png_()).decode()
    elif hasattr(value, "_repr_html_"):
        data["text/html"] = value._repr_html_().splitlines(keepends=True)
    return {"data": data, "execution_count": number, "metadata": {}, "output_type": "execute_result"}


def _image(figure) -> dict:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=min(100, figure.dpi))
    data = base64.b64encode(file.getvalue()).decode()
    return {"data": {"image/png": data}, "metadata": {}, "output_type": "display_data"}


def main(names: list[str]) -> None:
    """Run the notebooks of these names, or all, and write them with their output."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if not names or path.stem in names:
            notebook = json.loads(path.read_text())
            with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
                run_cells(notebook)
            path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")
            print(f"ran {path.name}")


if __name__ == "__main__":
    main(sys.argv[1:])
