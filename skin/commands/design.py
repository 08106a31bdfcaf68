"""Compute how precisely a skin measures a touch, and where to put its sensors.

    skin design simulator=solid  # expected errors of position, radius and force of a touch
    skin design design=place simulator=solid design.count=16

Writes tables, pictures and JSON into out=.
"""

from functools import partial
from typing import Any

from skin.commands._command import command
from skin.core.files import results
from skin.core.settings import configured, import_target
from skin.runs.configuration import Config


@command("design")
def main(config: Config, out: str | None, design: dict[str, Any]) -> None:
    """Build the chosen analysis from its settings, run it and write its files."""
    settings = dict(design)
    analysis = configured(import_target(settings.pop("_target_"), "design._target_"), settings, "design")

    from skin.runs.build import build_device, build_skin

    analysis.run(build_skin(config), partial(build_device, config), results(out))
