"""Simulation of a soft robot skin with few force sensors, and classification of touches.

This module exports the public names for scripts; they are imported at first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skin.body.arm import Arm as Arm
    from skin.body.layout import File as LayoutFile
    from skin.body.layout import Grid as Grid
    from skin.body.sheet import Sheet as Sheet
    from skin.device.files import read_recording as read_recording
    from skin.errors import InputError as InputError
    from skin.inference.candidates import FingertipPrior as FingertipPrior
    from skin.inference.noise import Noise as Noise
    from skin.inference.posterior import Posterior as Posterior
    from skin.mechanics.contact.rigid import solve_contact as solve_contact
    from skin.mechanics.contact.rigid import surface_compliance as surface_compliance
    from skin.mechanics.simulator.fem import PlatesAndBeams as PlatesAndBeams
    from skin.mechanics.simulator.solid import Solid as Solid
    from skin.runs.build import load_run as load_run
    from skin.runs.build import training_data as data
    from skin.wire.skin import open_skin as open_skin

__version__ = "0.3.0"
__all__ = ["Arm", "Grid", "InputError", "LayoutFile", "PlatesAndBeams", "Sheet", "Solid"]
__all__ += ["FingertipPrior", "Noise", "Posterior", "data", "load_run", "open_skin", "read_recording"]
__all__ += ["solve_contact", "surface_compliance"]

_PLACES = {
    "FingertipPrior": "skin.inference.candidates",
    "Noise": "skin.inference.noise",
    "Posterior": "skin.inference.posterior",
    "Arm": "skin.body.arm",
    "Grid": "skin.body.layout",
    "InputError": "skin.errors",
    "LayoutFile": "skin.body.layout:File",
    "PlatesAndBeams": "skin.mechanics.simulator.fem",
    "Sheet": "skin.body.sheet",
    "Solid": "skin.mechanics.simulator.solid",
    "data": "skin.runs.build:training_data",
    "load_run": "skin.runs.build",
    "open_skin": "skin.wire.skin",
    "read_recording": "skin.device.files",
    "solve_contact": "skin.mechanics.contact.rigid",
    "surface_compliance": "skin.mechanics.contact.rigid",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'skin' has no attribute {name!r}")
    module, _, member = _PLACES[name].partition(":")
    return getattr(import_module(module), member or name)


def __dir__() -> list[str]:
    return [*globals(), *_PLACES]
