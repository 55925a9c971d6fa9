"""What objects show in notebooks, and the films of recordings: declared here, below the classes that use it.

The renderer imports these classes, so they cannot import it: `warp_rigid.notebook` registers what each function does
for each class.
"""

import html
from functools import singledispatch
from typing import Any


class Inline:
    """HTML that a notebook shows where it is the value of a cell.

    Attributes:
        html: the text.
    """

    def __init__(self, text: str) -> None:
        """Keep the text."""
        self.html = text

    def __repr__(self) -> str:
        """Show the size, instead of megabytes of text."""
        return f"Inline({len(self.html) / 1e6:.2g} MB of HTML)"

    def _repr_html_(self) -> str:
        return self.html


@singledispatch
def html_of(shown: Any) -> str:
    """What a notebook shows of an object, as HTML."""
    return f"<pre>{html.escape(repr(shown))}</pre>"


@singledispatch
def film_of(recorded: Any, suffix: str, path: Any = None, **options: Any) -> Inline | None:
    """Write the film of a recording to a file, or return it for a notebook if there is no path.

    Args:
        recorded: the recording.
        suffix: ".html", ".gif" or ".mp4".
        path: the file; None returns the film.
        **options: see Recording.to_gif.
    """
    raise TypeError(f"no film of {type(recorded).__name__}")
