"""Draws docs/real_images.jpg, frames that splats were not fitted to, from a polished run on real images.

emgs run kitchen.mp4 hydra.run.dir=kitchen && emgs polish kitchen
python docs/real_images.py kitchen

kitchen.mp4: 60 images of 7-Scenes redkitchen/seq-01, every fourth of the first 240, at 7.5 a second.
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

TARGET = Path(__file__).with_name("real_images.jpg")
GAP = 6  # pixels between pictures
MARGIN = 34  # pixels, for the words on the left


def main(folder: Path) -> None:
    """Put the rows of polish.png, image, map and splats of a frame each, side by side as columns."""
    strip = np.asarray(Image.open(folder / "polish.png").convert("RGB"))
    run = json.loads((folder / "metrics.json").read_text())["provenance"]["data"]["frames"]["size"]
    found = json.loads((folder / "polish.json").read_text())
    (width, height), count = run, len(strip) // run[1]
    words = [
        "images that were held out",
        f"map, {found['polish/before_psnr_db']:.1f} dB",
        f"splats, {found['polish/after_psnr_db']:.1f} dB",
    ]
    page = Image.new("RGB", (MARGIN + count * (width + GAP), len(words) * (height + GAP)), "white")
    font = ImageFont.load_default(19)
    for row, text in enumerate(words):
        top = row * (height + GAP)
        label = Image.new("RGB", (height, MARGIN), "white")
        ImageDraw.Draw(label).text((height / 2, MARGIN / 2), text, "black", font, "mm")
        page.paste(label.rotate(90, expand=True), (0, top))
        for column in range(count):
            part = strip[column * height : (column + 1) * height, row * width : (row + 1) * width]
            page.paste(Image.fromarray(part), (MARGIN + column * (width + GAP), top))
    page.save(TARGET, quality=88, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
