"""Configuration of the documentation site; ``make docs`` builds it."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

import skin  # noqa: E402

project = "Tactile skin"
author = "The skin developers"
copyright = "2026, the skin developers"
version = release = skin.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["results/*.md", "firmware", "tutorials", "gallery"]
myst_heading_anchors = 4  # links between pages name headings, as on GitHub

autosummary_generate = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_use_ivar = True  # attributes of a dataclass are listed once
templates_path = ["_templates"]

sphinx_gallery_conf = {
    "examples_dirs": ["tutorials", "gallery"],
    "gallery_dirs": ["generated/tutorials", "generated/gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ("figure_scraper",),
    "show_memory": False,
    "capture_repr": (),
    "write_computation_times": False,
    "min_reported_time": 1e6,
    "download_all_examples": False,
    "show_signature": False,
}

# Words such as "shape" in front of a colon name several attributes; no page needs these links.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_title = "Tactile skin"
html_show_sphinx = False


def link_cards(app, name, source):
    """Replace links to the cards of the models, which are outside ``docs/``, by links to their pages here."""
    source[0] = re.sub(r"\.\./models/(\w+)/README\.md", r"cards/\1.md", source[0])


def keep_first_line(app, what, name, value, options, lines):
    """Keep Napoleon from taking what is before a colon in the first line of an attribute for its type."""
    if what in ("attribute", "data", "property"):
        lines.insert(0, "")


def join_names(app, what, name, value, options, lines):
    """Keep names with one description together; Sphinx takes the first of several words for a type."""
    several = re.compile(r":(?:param|ivar) \w+(?:, \w+)+:")
    lines[:] = [several.sub(lambda match: match[0].replace(", ", ","), line) for line in lines]


def setup(app):
    """Connect the functions above; Sphinx calls this."""
    app.connect("source-read", link_cards)
    app.connect("autodoc-process-docstring", keep_first_line, priority=400)  # before Napoleon, at 500
    app.connect("autodoc-process-docstring", join_names, priority=600)  # behind it
