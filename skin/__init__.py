"""Simulation of a soft robot skin with few force sensors, and classification of touches.

This module exports the public names for scripts; they are imported at first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skin.body.arm import Arm as Arm
    from skin.body.sheet import Sheet as Sheet
    from skin.errors import InputError as InputError
    from skin.layout.file import File as LayoutFile
    from skin.layout.grid import Grid as Grid
    from skin.model_of_run import load_run as load_run
    from skin.recording_file import read_recording as read_recording
    from skin.simulator.fem import PlatesAndBeams as PlatesAndBeams
    from skin.simulator.solid import Solid as Solid
    from skin.wire.skin import open_skin as open_skin

__version__ = "0.1.0"
__all__ = ["Arm", "Grid", "InputError", "LayoutFile", "PlatesAndBeams", "Sheet", "Solid"]
__all__ += ["load_run", "open_skin", "read_recording"]

_PLACES = {
    "Arm": "skin.body.arm",
    "Grid": "skin.layout.grid",
    "InputError": "skin.errors",
    "LayoutFile": "skin.layout.file:File",
    "PlatesAndBeams": "skin.simulator.fem",
    "Sheet": "skin.body.sheet",
    "Solid": "skin.simulator.solid",
    "load_run": "skin.model_of_run",
    "open_skin": "skin.wire.skin",
    "read_recording": "skin.recording_file",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'skin' has no attribute {name!r}")
    module, _, there = _PLACES[name].partition(":")
    return getattr(import_module(module), there or name)


def __dir__() -> list[str]:
    return [*globals(), *_PLACES]
