"""Check settings against the annotated parameters of what they configure (docs/adr/0016).

Types are checked for every parameter that has one, ranges where it is ``Annotated``, as in
``rounds: Annotated[int, Ge(1)]``. Numbers must be finite.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from skin.errors import InputError
from skin.trust import resolved

__all__ = ["check", "check_groups"]

_LIBRARIES = ("torch.", "torch_geometric.")  # which check their own settings
_FINITE = ConfigDict(allow_inf_nan=False)
_INNER = {"contact", "fusion", "model", "simulator"}
_SCALARS = {int, float, bool, str, Path, NoneType, Ellipsis}
_COLLECTIONS = {Union, UnionType, Sequence, Mapping, list, tuple, dict}


def check(target: Callable[..., Any], settings: Mapping[str, Any], name: str) -> None:
    """Refuse settings that a class or function does not have, or does not take.

    Args:
        target: what they configure.
        settings: in plain containers; keys that begin with ``_`` are Hydra's.
        name: where they stand in the configuration, for the message.

    Raises:
        InputError: naming the setting, its value and what is valid.
    """
    parameters = signature(target).parameters
    hints = _hints(target)
    for key, value in settings.items():
        if key.startswith("_"):
            continue
        if key not in parameters:
            if any(one.kind == Parameter.VAR_KEYWORD for one in parameters.values()):
                continue
            # What has no default is given by the program.
            known = [
                one for one, its in parameters.items() if its.default is not its.empty or one in settings
            ]
            near = get_close_matches(key, known, 1)
            meant = f": did you mean {near[0]}?" if near else ":"
            raise InputError(f"{name} has no setting {key}{meant} it has {', '.join(known)}")
        if key in hints and _plain(hints[key]):
            _fits(hints[key], value, f"{name}.{key}")


def check_groups(config: Mapping[str, Any]) -> None:
    """Check all parts of a configuration that build something, except classes of libraries.

    Args:
        config: in plain containers.

    Raises:
        InputError: as :func:`check`, or a class that cannot be imported.
    """
    for name, part in _parts(config, ""):
        # A learner holds its model: people set it by the name of the group.
        inner = name.split(".")[-1]
        shown = inner if inner in _INNER else name
        check(_imported(part["_target_"], shown), part, shown)


def _imported(target: str, name: str) -> Callable[..., Any]:
    try:
        return resolved(target)
    except ImportError as error:
        raise InputError(
            f"{name}._target_={target} cannot be imported: {error}: correct the name, or add the folder of "
            "its module to PYTHONPATH"
        ) from error


def _parts(value: Any, name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield every mapping with a ``_target_`` that is no library's, the innermost first, with its name."""
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _parts(one, f"{name}.{key}" if name else str(key))
        target = value.get("_target_")
        if target is not None and not str(target).startswith(_LIBRARIES):
            yield name, value


def _hints(target: Callable[..., Any]) -> dict[str, Any]:
    made = target.__init__ if isinstance(target, type) else target  # type: ignore[misc]
    return get_type_hints(made, include_extras=True)


def _plain(hint: Any) -> bool:
    """Return whether an annotation is made of numbers, text and collections of these alone."""
    if hint in _SCALARS:
        return True
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _plain(arguments[0])
    return origin is Literal or (origin in _COLLECTIONS and all(map(_plain, arguments)))


def _fits(hint: Any, value: Any, name: str) -> None:
    try:
        taken = TypeAdapter(hint, config=_FINITE).validate_python(value)
    except ValidationError as error:
        # Of a union, what is said of its first member.
        said = error.errors()[0]["msg"].replace("Input should be", "must be")
        said = said.split(", unable to parse")[0].replace("an instance of Sequence", "a list")
        said = said.replace("a valid tuple", "a list")
        raise InputError(f"{name}={value} {said[0].lower()}{said[1:]}") from error
    if isinstance(value, str) and not isinstance(taken, str | Path):
        raise InputError(f"{name}={value} is text, and must be a number")
