"""Run the notebooks of the tutorials and keep their output: `.venv/bin/python docs/run_notebooks.py [NAME ...]`.

The cells of a notebook are executed one after the other in one namespace, as Jupyter does, but without Jupyter: what
they print, and the figures that they show, become their output. The tests run the notebooks in the same way.
"""

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

    shown: list = []
    names: dict = {"__name__": "__main__"}
    for number, cell in enumerate((c for c in notebook["cells"] if c["cell_type"] == "code"), start=1):
        printed = io.StringIO()
        code = compile("".join(cell["source"]), f"cell {number}", "exec")
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        figures = [plt.figure(k) for k in plt.get_fignums()]
        cell["execution_count"] = number
        cell["outputs"] = _stream(printed.getvalue()) + [_image(figure) for figure in figures]
        shown += figures
        for figure in figures:
            plt.close(figure)
    return shown


def _stream(text: str) -> list:
    if not text:
        return []
    return [{"name": "stdout", "output_type": "stream", "text": text.splitlines(keepends=True)}]


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
