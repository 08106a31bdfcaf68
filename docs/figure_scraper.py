"""Finds the figures that a script of the gallery or of a tutorial leaves in variables."""

import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst, matplotlib_scraper


def scrape(block: Any, variables: dict[str, Any], gallery_conf: Mapping[str, Any]) -> str:
    """Return the reST of the new figures of pyplot, and of other figures and pictures in variables.

    A variable is a figure, the path of a PNG or GIF file, or a list of them.
    """
    shown, paths = variables.setdefault("shown", []), []
    shown += map(plt.figure, plt.get_fignums())  # left to the scraper of pyplot
    for one in _pictures(variables["example_globals"]):
        if not any(one is other for other in shown):
            shown.append(one)
            path = Path(next(variables["image_path_iterator"]))
            if isinstance(one, Figure):
                one.savefig(path, dpi=120)
            else:
                path = Path(shutil.copy(one, path.with_suffix(one.suffix)))
            paths.append(str(path))
    text = figure_rst(paths, gallery_conf["src_dir"]) if paths else ""
    return text + matplotlib_scraper(block, variables, gallery_conf)


def _pictures(variables: Mapping[str, Any]) -> Iterator[Figure | Path]:
    for value in variables.values():
        for one in value if isinstance(value, list) else [value]:
            picture = isinstance(one, Path) and one.suffix in (".png", ".gif") and one.is_file()
            if picture or isinstance(one, Figure):
                yield one


def _get_sg_image_scraper() -> Callable[..., str]:
    return scrape
