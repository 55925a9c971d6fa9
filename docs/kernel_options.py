"""A hook of mkdocs: options of mkdocstrings that all blocks `::: warp_rigid.kernels...` of docs/step/ share."""

import re
from typing import Any

OPTIONS = """\
      show_root_heading: false
      show_root_toc_entry: false
      show_signature: false
      separate_signature: false
"""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Add the options; those that a block states itself take precedence."""
    return re.sub(r"^(::: warp_rigid\.kernels\.\S+\n    options:\n)", rf"\1{OPTIONS}", markdown, flags=re.MULTILINE)
