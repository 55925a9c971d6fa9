"""Make docs/pictures: run the commands and programs of the documentation that write pictures, and reduce the pictures.

A command or program that writes `out/NAME.png` (or .gif) makes the picture that is shown as `pictures/NAME.png`.
Run it from the top of the repository: `.venv/bin/python docs/make_pictures.py [NAME ...]`. Without names it makes all.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path

from PIL import Image, ImageSequence

from warp_rigid.render.images import shared_palette

DOCS = Path(__file__).parent
WIDEST = {".png": 1280, ".gif": 470}
"""Largest width of a picture [pixels]."""


def makers() -> dict[str, list[str]]:
    """Arguments of the Python that makes each picture, by file name."""
    text = "\n".join(page.read_text() for page in [*sorted(DOCS.glob("**/*.md")), DOCS.parent / "README.md"])
    shown = set(re.findall(r"pictures/(\w+\.(?:png|gif))", text))
    made: dict[str, list[str]] = {}
    for language, block in re.findall(r"```(bash|python)\n(.*?)```", text, flags=re.DOTALL):
        for source in block.splitlines() if language == "bash" else [block]:
            for name in shown & set(re.findall(r"out/(\w+\.(?:png|gif))", source)):
                command = ["-m", "warp_rigid", *shlex.split(source)[1:]] if language == "bash" else ["-c", source]
                made.setdefault(name, command)
    if shown - set(made):
        raise ValueError(f"nothing makes {', '.join(sorted(shown - set(made)))}")
    return made


def shrink(source: Path, target: Path) -> None:
    """Reduce size and colours."""
    with Image.open(source) as picture:
        width, height = picture.size
        scale = min(1.0, WIDEST[source.suffix] / width)
        size = (round(scale * width), round(scale * height))
        if source.suffix == ".png":
            small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
            palette = shared_palette([small], 256)
            small.quantize(palette=palette, dither=Image.Dither.NONE).save(target, optimize=True)
            return
        duration = picture.info["duration"]
        frames = [frame.convert("RGB").resize(size) for frame in ImageSequence.Iterator(picture)]
    palette = shared_palette(frames[::4], 160)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    first.save(target, save_all=True, append_images=others, duration=duration, loop=0, optimize=True)


def main(names: list[str]) -> None:
    """Make the pictures of these names, or all."""
    for name, command in sorted(makers().items()):
        if not names or Path(name).stem in names:
            subprocess.run([sys.executable, *command], check=True)
            shrink(Path("out", name), DOCS / "pictures" / name)


if __name__ == "__main__":
    main(sys.argv[1:])
