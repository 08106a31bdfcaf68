"""Check settings against the annotated parameters of what they configure (docs/adr/0007).

Types are checked for every parameter that has one, ranges where it is ``Annotated``, as in
``rounds: Annotated[int, Ge(1)]`` or pydantic's ``PositiveInt``. Numbers must be finite.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache, wraps
from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError

from skin.core.files import CONF
from skin.errors import InputError

_Made = TypeVar("_Made")

_LIBRARIES = ("torch.", "torch_geometric.")  # which check their own settings
_FINITE = ConfigDict(allow_inf_nan=False)
_INNER = {"contact", "fusion", "model", "simulator"}
_SCALARS = {int, float, bool, str, dict, Path, NoneType, Ellipsis}
_COLLECTIONS = {Union, UnionType, Sequence, Mapping, list, tuple, dict}
_LONG = 80  # characters of a value, in a message
_FEW = "has too few entries"
_LENGTHS = {"missing": _FEW, "too_short": _FEW, "too_long": "has too many entries"}


def _check_rising(limits: tuple[Any, Any]) -> tuple[Any, Any]:
    if limits[0] > limits[1]:
        raise ValueError("must be a range [least, most]")
    return limits


def _check_unique(names: Sequence[str]) -> Sequence[str]:
    if len(set(names)) < len(names):
        raise ValueError("must hold each name once")
    return names


RISING = AfterValidator(_check_rising)
"""Makes a pair a range: ``Annotated[tuple[float, float], RISING]``."""
ONCE = AfterValidator(_check_unique)
"""Makes a list one of different names."""


def check_settings(
    target: Callable[..., Any], settings: Mapping[str, Any], name: str, whole: bool = False
) -> None:
    """Check settings against the parameters of a class or function.

    Args:
        target: the class or function.
        settings: in plain containers; keys that begin with ``_`` are Hydra's.
        name: their place in the configuration, for the message.
        whole: whether they are all arguments; if not, the program passes those without a default.

    Raises:
        InputError: naming the setting, its value and what is valid.
    """
    if not isinstance(settings, Mapping):
        raise InputError(f"{name} must be settings by name, got {settings!r}")
    parameters = signature(target).parameters
    hints = _hints(target)
    required = [key for key, its in parameters.items() if its.default is its.empty]
    for key, value in zip(map(str, settings), settings.values(), strict=True):
        if key.startswith("_"):
            continue
        label = f"{name}.{key}".removeprefix(".")
        if key not in parameters:
            if any(parameter.kind == Parameter.VAR_KEYWORD for parameter in parameters.values()):
                continue
            choices = [name for name in parameters if whole or name not in required or name in settings]
            near = get_close_matches(key, choices, 1)
            meant = f": did you mean {near[0]}?" if near else ":"
            raise InputError(f"{name} has no setting {key}{meant} it has {', '.join(choices)}")
        if key in hints and _takes_made(hints[key]) and _is_nothing_made(hints[key], value):
            raise InputError(f"{label}={str(value)[:_LONG]} must be an option with its settings")
        if key in hints and _is_plain(hints[key]) and (wrong := _explain_refusal(hints[key], value)):
            default = _written(parameters[key].default)
            example = f": as in {label}={default}" if default else ""
            text = str(list(value) if isinstance(value, tuple) else value)
            text = text if len(text) <= _LONG else f"{text[:_LONG]}..."
            raise InputError(f"{label}={text} {wrong}{example}")
    if whole and (missing := [key for key in required if key not in settings]):
        raise InputError(f"{name} needs {' and '.join(missing)}, got {', '.join(settings) or 'nothing'}")


def configured(target: Callable[..., _Made], settings: Mapping[str, Any], name: str) -> _Made:
    """Check settings and call a class or function with them.

    Args:
        target: the class or function; it takes no other arguments.
        settings: in plain containers.
        name: as in :func:`check_settings`.

    Raises:
        InputError: as :func:`check_settings`, and where a setting is missing.
    """
    check_settings(target, settings, name, whole=True)
    return target(**settings)


def checked(name: str) -> Callable[[type[_Made]], type[_Made]]:
    """Return a class decorator that checks arguments like settings of a configuration.

    Args:
        name: as in :func:`check_settings`.
    """

    def decorate(made: type[_Made]) -> type[_Made]:
        init, expected = made.__init__, signature(made)  # type: ignore[misc]

        @wraps(init)
        def checking(self: Any, *args: Any, **kwargs: Any) -> None:
            check_settings(made, expected.bind(*args, **kwargs).arguments, name)
            init(self, *args, **kwargs)

        made.__init__ = checking  # type: ignore[method-assign]
        return made

    return decorate


def check_groups(config: Mapping[str, Any]) -> None:
    """Check all parts of a configuration with a ``_target_``, except classes of libraries.

    Args:
        config: in plain containers.

    Raises:
        InputError: as :func:`check_settings`, or a class that cannot be imported.
    """
    for name, part in _parts(config, ""):
        # The model is inside the learner, but is set by the name of its group.
        inner = name.split(".")[-1]
        label = inner if inner in _INNER else name
        check_settings(import_target(part["_target_"], label), part, label)


def import_target(target: str, name: str) -> Callable[..., Any]:
    """Return a class or function by its dotted name.

    Args:
        target: the name.
        name: of the part of the configuration that has it as ``_target_``.

    Raises:
        InputError: it cannot be imported.
    """
    try:
        return import_name(target)
    except ImportError as error:
        raise InputError(
            f"{name}._target_={target} cannot be imported: {error}: correct the name, or add the folder of "
            "its module to PYTHONPATH"
        ) from error


def _parts(value: Any, name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield every mapping with a ``_target_`` outside of libraries, the innermost first, with its name."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _parts(entry, f"{name}.{key}" if name else str(key))
        if not isinstance(value.get("_partial_", False), bool):
            raise InputError(f"{name}._partial_={value['_partial_']} must be true or false")
        target = value.get("_target_")
        if target is None and (option := name.rpartition(".")[2]) in _INNER:
            raise InputError(f"{option} chooses no option: leave it out, or give one that --help lists")
        if target is not None and not str(target).startswith(_LIBRARIES):
            yield name, value


def _hints(target: Callable[..., Any]) -> dict[str, Any]:
    made = target.__init__ if isinstance(target, type) else target  # type: ignore[misc]
    try:
        return get_type_hints(made, include_extras=True)
    except NameError:
        if target.__module__.startswith("skin."):
            raise
        return {}  # annotations of others may need names that exist for type checkers only


def _takes_made(hint: Any) -> bool:
    """Return whether an annotation is that of a factory, which Hydra makes of the settings of an option."""
    return any(get_origin(part) is Callable for part in (hint, *get_args(hint)))


def _is_nothing_made(hint: Any, value: Any) -> bool:
    """Return whether a value cannot be what Hydra makes; None can where it is allowed."""
    return isinstance(value, str | int | float | list) or (value is None and NoneType not in get_args(hint))


def _is_plain(hint: Any) -> bool:
    """Return whether an annotation is made of numbers, text and collections of these alone."""
    if hint in _SCALARS:
        return True
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _is_plain(arguments[0])
    return origin is Literal or (origin in _COLLECTIONS and all(map(_is_plain, arguments)))


@cache
def _adapter(hint: Any) -> TypeAdapter:
    return TypeAdapter(hint, config=_FINITE)


def _explain_refusal(hint: Any, value: Any) -> str:
    """Return why a value is invalid, and what is valid; empty if it is valid."""
    try:
        taken = _adapter(hint).validate_python(value)
    except ValidationError as error:
        # Of a union, the message for the closest member: the deepest, or one whose type fits.
        fits = ("value_error", "greater_than", "greater_than_equal", "less_than", "less_than_equal")
        nearest = max(error.errors(), key=lambda detail: (len(detail["loc"]), detail["type"] in fits))
        sentence = nearest["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
        sentence = sentence.split(", unable to parse")[0].replace("an instance of Sequence", "a list")
        sentence = _LENGTHS.get(nearest["type"], sentence.replace("a valid tuple", "a list"))
        return sentence[0].lower() + sentence[1:]
    for original, number in _find_changed(value, taken):
        if isinstance(original, str):
            return "is text, and must be a number"
        return f"must be a {'whole ' * isinstance(number, int)}number"
    return ""


def _find_changed(value: Any, taken: Any) -> Iterator[tuple[Any, Any]]:
    """Yield values that pydantic converted to another type, because the class gets the original."""
    if isinstance(value, list | tuple):
        for pair in zip(value, taken, strict=True):
            yield from _find_changed(*pair)
    for kind in (bool, str, float):
        if isinstance(value, kind) and not isinstance(taken, kind | Path):
            yield value, taken


def _written(default: Any) -> str:
    """Return a default in the syntax of overrides; empty if it is not useful as an example."""
    if isinstance(default, list | tuple) and default:
        return f"[{','.join(map(_written, default))}]"
    return str(default) if isinstance(default, int | float | str) and not isinstance(default, bool) else ""


# Restrict what a stored run's configuration may build: it must not execute code.


GROUPS = {
    "body": "skin.body.base",
    "layout": "skin.body.layout",
    "simulator": "skin.mechanics.simulator.base",
    "contact": "skin.touch.sampler",
    "device": "skin.device.base",
    "representation": "skin.learning.representation",
    "model": "skin.learning.model",
    "fusion": "skin.learning.fusion",
    "learner": "skin.learning.learner",
}
"""Configuration groups whose options are classes -> module of the abstract class that they derive from."""

# Package -> base classes, as (module, name). Not every module of PyTorch Geometric: some of them fetch models
# from the network and run what these contain.
_TRUSTED_LIBRARIES = {
    "torch.optim": (("torch.optim", "Optimizer"),),
    "torch_geometric.nn": (
        ("torch_geometric.nn.aggr", "Aggregation"),
        ("torch_geometric.nn.conv", "MessagePassing"),
        ("torch_geometric.nn.models.basic_gnn", "BasicGNN"),
    ),
}
_BASES = {"skin": tuple((module, f"Abstract{group.capitalize()}") for group, module in GROUPS.items())}
_BASES |= _TRUSTED_LIBRARIES
# Models of other libraries: their learners run one program, which no setting can change.
_BASES["experiments.peers"] = (("skin.learning.learner", "AbstractLearner"),)


def check_targets(config: Any, where: str) -> None:
    """Check that a stored configuration builds only classes of this package and of its libraries.

    Allowed are subclasses of a group's base class that ``skin`` defines, learners of ``experiments.peers``,
    optimizers of ``torch.optim``, and aggregations, convolutions and networks (``BasicGNN``) of
    ``torch_geometric.nn``. Names are resolved, so that ``skin.runs.configuration.sys.exit`` is not taken for
    a part of ``skin``.

    Args:
        config: plain containers.
        where: its source, for the message.

    Raises:
        InputError: another class is named, or a value is an interpolation, which could become a name.
    """
    for path, value in walk_settings(config):
        for text in (*path[-1:], value):
            if isinstance(text, str) and "${" in text:
                _refuse(where, path, f"has the interpolation {text!r}, stored values are final")
        if path and path[-1] == "_target_" and not _is_allowed(value):
            _refuse(where, path, f"names {value!r}, which could run any code")
    row = config.get("row") if isinstance(config, dict) else None
    if row is not None and (not isinstance(row, str) or {"/", "\\", "\0"} & set(row)):
        _refuse(where, ("row",), f"is {row!r}, which is no name of a file")


def _refuse(where: str, path: tuple[str, ...], reason: str) -> None:
    raise InputError(
        f"{where}: {'.'.join(path)} {reason}; if you trust the author of the run, add trust=true to load it"
    )


def walk_settings(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield plain containers and every value in them, however deep, with their paths."""
    yield path, value
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, entry in entries:
        yield from walk_settings(entry, (*path, str(key)))


def _is_allowed(name: Any) -> bool:
    """Return whether a name is that of an allowed class.

    The name's package is checked first, because to resolve a name imports modules, and then the class.
    """
    if not isinstance(name, str):
        return False
    package = next((prefix for prefix in _BASES if name.startswith(f"{prefix}.")), None)
    if package is None:
        return False
    try:
        kind = import_name(name)
    except Exception:  # any error means that there is no such class
        return False
    if not inspect.isclass(kind) or inspect.isabstract(kind):
        return False
    bases = tuple(getattr(import_module(module), base) for module, base in _BASES[package])
    return issubclass(kind, bases) and f"{kind.__module__}.".startswith(f"{package}.")


def import_name(name: str) -> Any:
    """Import an object by its dotted name, like Hydra, but without logging errors.

    Raises:
        ImportError: there is no such module, class or function.
    """
    first, *others = name.split(".")
    member, path = import_module(first), first
    for part in others:
        path = f"{path}.{part}"
        member = getattr(member, part) if hasattr(member, part) else import_module(path)
    return member


# The name of an option: of a simulator, device, model, ...


def option_name(made: object) -> str:
    """Return the name of the option that an object or its class is.

    It is that of the YAML file in ``conf/`` that names the class: ``PlatesAndBeams`` is the option ``fem``,
    as in ``simulator=fem``. A class from outside ``skin`` is named after its module.
    """
    kind = made if hasattr(made, "__qualname__") else type(made)
    return _options().get(f"{kind.__module__}.{kind.__qualname__}", kind.__module__.rpartition(".")[2])


@cache
def _options() -> dict[str, str]:
    """Return the names of the options of ``skin`` by the dotted name of their class."""
    paths = (path for group in GROUPS for path in (CONF / group).glob("*.yaml"))
    return {path.read_text().partition("_target_: ")[2].split()[0]: path.stem for path in paths}
