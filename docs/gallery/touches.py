"""
Touches, still and moving
=========================

``skin animate`` draws a touch: flat, with its sensors in space, or with the deformed surface in space.
"""

from contextlib import chdir
from pathlib import Path
from tempfile import mkdtemp

from skin.__main__ import main

folder = Path(mkdtemp())

# %%
# The strongest frame of a big press on an arm. ``view=skin3d simulator=solid`` shows the deformed surface as
# well (figure 9 of the report); it takes a minute to solve.

with chdir(folder):
    main(
        [
            "animate",
            "out=arm.png",
            "body=arm",
            "simulator=naive",
            "view=sensors3d",
            "labels=[press,big]",
            "shape=hand",
        ]
    )
arm = folder / "arm.png"

# %%
# A hand slides over the sheet.

with chdir(folder):
    main(["animate", "out=slide.gif", "simulator=naive", "labels=[big,dynamic,press]", "shape=hand"])
slide = folder / "slide.gif"
