"""Figure that notebooks show by itself. Imported where a figure is made, as matplotlib is optional."""

import io

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


class ShownFigure(Figure):
    """A figure that pyplot does not know, so that it is shown once: as the value of a cell."""

    def __init__(self) -> None:
        """Start an empty figure."""
        super().__init__(layout="constrained", dpi=100)
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()
