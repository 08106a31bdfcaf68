"""Restrict what a stored run's configuration may build: it must not execute code."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from skin.errors import InputError

GROUPS = (
    "body",
    "layout",
    "simulator",
    "contact",
    "device",
    "representation",
    "model",
    "fusion",
    "learner",
)
"""Configuration groups whose options are classes; ``skin/<group>/base.py`` holds what they derive from."""

# Package -> base classes, as (module, name). Not every module of PyTorch Geometric: some of them fetch models
# from the network and run what these contain.
_LIBRARIES = {
    "torch.optim": (("torch.optim", "Optimizer"),),
    "torch_geometric.nn": (
        ("torch_geometric.nn.aggr", "Aggregation"),
        ("torch_geometric.nn.conv", "MessagePassing"),
        ("torch_geometric.nn.models.basic_gnn", "BasicGNN"),
    ),
}
_BASES = {"skin": tuple((f"skin.{group}.base", f"Abstract{group.capitalize()}") for group in GROUPS)}
_BASES |= _LIBRARIES
# Models of other libraries: their learners run one program, which no setting can change.
_BASES["experiments.peers"] = (("skin.learner.base", "AbstractLearner"),)


def check_targets(config: Any, where: str) -> None:
    """Check that a stored configuration builds only classes of this package and of its libraries.

    Allowed are subclasses of a group's base class that ``skin`` defines, learners of ``experiments.peers``,
    optimizers of ``torch.optim``, and aggregations, convolutions and networks (``BasicGNN``) of
    ``torch_geometric.nn``. Names are resolved, so that ``skin.config.sys.exit`` is not taken for a part of
    ``skin``.

    Args:
        config: plain containers.
        where: its source, for the message.

    Raises:
        InputError: another class is named, or a value is an interpolation, which could become a name.
    """
    for path, value in _values(config, ()):
        if isinstance(value, str) and "${" in value:
            _refuse(where, path, f"has the interpolation {value!r}, stored values are final")
        if path and path[-1] == "_target_" and not _allowed(value):
            _refuse(where, path, f"names {value!r}, which could run any code")
    row = config.get("row") if isinstance(config, dict) else None
    if row is not None and (not isinstance(row, str) or {"/", "\\", "\0"} & set(row)):
        _refuse(where, ("row",), f"is {row!r}, which is no name of a file")


def _refuse(where: str, path: tuple[str, ...], reason: str) -> None:
    raise InputError(
        f"{where}: {'.'.join(path)} {reason}; if you trust the author of the run, add trust=true to load it"
    )


def _values(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every key with its value and every entry of a list, however deep."""
    if isinstance(value, dict):
        for key, entry in value.items():
            if isinstance(key, str) and "${" in key:
                yield (*path, key), key
            yield (*path, str(key)), entry
            yield from _values(entry, (*path, str(key)))
    elif isinstance(value, list):
        for number, entry in enumerate(value):
            yield (*path, str(number)), entry
            yield from _values(entry, (*path, str(number)))


def _allowed(name: Any) -> bool:
    """Return whether a name is that of an allowed class.

    The name's package is checked first, because to resolve a name imports modules, and then the class.
    """
    if not isinstance(name, str):
        return False
    package = next((one for one in _BASES if name.startswith(f"{one}.")), None)
    if package is None:
        return False
    try:
        found = import_name(name)
    except Exception:  # any error means that there is no such class
        return False
    if not inspect.isclass(found) or inspect.isabstract(found):
        return False
    bases = tuple(getattr(import_module(module), base) for module, base in _BASES[package])
    return issubclass(found, bases) and f"{found.__module__}.".startswith(f"{package}.")


def import_name(name: str) -> Any:
    """Import an object by its dotted name, like Hydra, but without logging errors.

    Raises:
        ImportError: there is no such module, class or function.
    """
    first, *others = name.split(".")
    found, path = import_module(first), first
    for part in others:
        path = f"{path}.{part}"
        found = getattr(found, part) if hasattr(found, part) else import_module(path)
    return found
