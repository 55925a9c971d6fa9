"""Make docs/pictures: run the commands and programs of the documentation that write pictures, and reduce the pictures.

A command or program that writes `out/NAME.png` makes the picture that is shown as `pictures/NAME.png`, and one that
writes `out/NAME.gif` the film that is shown as `pictures/NAME.webp`, several times smaller than a GIF of its quality.
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
WIDEST = 1280
"""Largest width of a picture that is no film [pixels]."""
FILM_STRIDE = 2
"""Every so many frames of a film are shown: 10 per second."""
FILM_QUALITY = 70
"""Quality of the WebP encoder, of 100."""
PAUSE = 1000
"""Time for which the last frame is shown before the film starts again [ms]."""
WRITTEN = {".png": ".png", ".webp": ".gif"}
"""Suffixes of the pictures that are shown, and of the files from which they are made."""


def makers() -> dict[str, list[str]]:
    """Arguments of the Python that makes each picture, by file name."""
    text = "\n".join(page.read_text() for page in [*sorted(DOCS.glob("**/*.md")), DOCS.parent / "README.md"])
    shown = {Path(name) for name in re.findall(r"pictures/(\w+\.(?:png|webp))", text)}
    made: dict[str, list[str]] = {}
    for language, block in re.findall(r"```(bash|python)\n(.*?)```", text, flags=re.DOTALL):
        for source in block.splitlines() if language == "bash" else [block]:
            for picture in shown:
                if f"out/{picture.stem}{WRITTEN[picture.suffix]}" in source:
                    command = ["-m", "warp_rigid", *shlex.split(source)[1:]] if language == "bash" else ["-c", source]
                    made.setdefault(picture.name, command)
    missing = {picture.name for picture in shown} - set(made)
    if missing:
        raise ValueError(f"nothing makes {', '.join(sorted(missing))}")
    return made


def shrink(source: Path, target: Path) -> None:
    """Reduce the size and the colours of a picture."""
    with Image.open(source) as picture:
        width, height = picture.size
        scale = min(1.0, WIDEST / width)
        small = picture.convert("RGB").resize((round(scale * width), round(scale * height)), Image.Resampling.LANCZOS)
    palette = shared_palette([small], 256)
    small.quantize(palette=palette, dither=Image.Dither.NONE).save(target, optimize=True)


def shrink_film(source: Path, target: Path) -> None:
    """Reduce the rate of a film, and encode it as WebP."""
    with Image.open(source) as film:
        duration = FILM_STRIDE * film.info["duration"]
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(film)]
    # The last frame of the film is kept.
    first, *others = frames[(len(frames) - 1) % FILM_STRIDE :: FILM_STRIDE]
    durations = [duration] * len(others) + [PAUSE]
    first.save(target, save_all=True, append_images=others, duration=durations, loop=0, quality=FILM_QUALITY)


def main(names: list[str]) -> None:
    """Make the pictures of these names, or all."""
    for name, command in sorted(makers().items()):
        target = DOCS / "pictures" / name
        if not names or target.stem in names:
            subprocess.run([sys.executable, *command], check=True)
            reduce = shrink if target.suffix == ".png" else shrink_film
            reduce(Path("out", target.stem + WRITTEN[target.suffix]), target)


if __name__ == "__main__":
    main(sys.argv[1:])
