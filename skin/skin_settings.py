"""A skin that is described in Python, as the settings that a configuration has for it."""

from dataclasses import asdict, fields
from typing import Any

from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.layout._listed import Listed
from skin.layout.base import AbstractLayout
from skin.paths import CONF
from skin.settings import check_groups


def with_skin(
    groups: dict[str, Any], body: AbstractBody | str | None, layout: AbstractLayout | str | None
) -> dict[str, Any]:
    """Return the settings of a run with another body or layout.

    Args:
        groups: plain settings; interpolations are resolved.
        body: the body, the name of an option (``arm``), or None for that of the settings.
        layout: the layout, the name of an option (``grid``), the path of a CSV file, or None.

    Raises:
        InputError: there is no such option or file, or a sensor lies outside the body.
    """
    if body is not None:
        groups = groups | {"body": _option("body", body) if isinstance(body, str) else _body(body)}
    if isinstance(layout, str):
        groups = groups | {"layout": _layout(layout)}
    elif layout is not None:
        check_groups({"body": groups["body"]})
        groups = groups | {"layout": _listed(layout, instantiate(groups["body"]))}
    return groups


def _body(body: AbstractBody) -> dict[str, Any]:
    """Return the settings of a body: the arguments that it was built from."""
    if not isinstance(body, AbstractBody):
        raise InputError(f"body must be a body such as skin.Sheet, or the name of one, got {body!r}")
    settings = {field.name: getattr(body, field.name) for field in fields(body) if field.init}
    settings["layers"] = [asdict(layer) for layer in body.layers]
    for layer in settings["layers"]:
        layer["material"] = {key: value for key, value in layer["material"].items() if value is not None}
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in settings.items()}
    return {"_target_": _name(body), "_convert_": "all", **plain}


def _listed(layout: AbstractLayout, body: AbstractBody) -> dict[str, Any]:
    """Return settings for the sensors that a layout has in a body."""
    if not isinstance(layout, AbstractLayout):
        raise InputError(f"layout must be a layout such as skin.Grid, a name or a CSV file, got {layout!r}")
    sensors = layout.sensors(body)
    return {
        "_target_": f"{Listed.__module__}.{Listed.__qualname__}",
        "_convert_": "all",
        "positions": sensors.positions.tolist(),
        "footprint": list(sensors.footprint),
        "normals": sensors.normals.tolist(),
    }


def _layout(given: str) -> dict[str, Any]:
    """Return the settings of a layout that is given by its name or by its file."""
    if given.lower().endswith(".csv"):
        return _option("layout", "file") | {"path": given}
    return _option("layout", given)


def _option(group: str, name: str) -> dict[str, Any]:
    """Return the default settings of an option.

    Raises:
        InputError: there is no such option.
    """
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    if name not in options:
        raise InputError(f"there is no {group} {name}: give one of {', '.join(options)}, or build one")
    settings: Any = OmegaConf.to_container(OmegaConf.load(CONF / group / f"{name}.yaml"))
    return settings


def _name(built: object) -> str:
    return f"{type(built).__module__}.{type(built).__qualname__}"
