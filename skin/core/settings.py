"""Check settings against the annotated parameters of what they configure (docs/adr/0007).

Types are checked for every parameter that has one, ranges where it is ``Annotated``, as in
``rounds: Annotated[int, Ge(1)]`` or pydantic's ``PositiveInt``. Numbers must be finite.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from functools import cache, wraps
from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from hydra._internal.utils import _locate  # hydra.utils.get_object, without its message in the log
from omegaconf import OmegaConf
from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import to_json

from skin.core.files import CONF
from skin.errors import InputError

_Made = TypeVar("_Made")

_LIBRARIES = ("torch.", "torch_geometric.")  # which check their own settings
_STRICT = ConfigDict(strict=True, allow_inf_nan=False)
_INNER = {"contact", "fusion", "model", "simulator"}
_SCALARS = {int, float, bool, str, dict, Path, NoneType, Ellipsis}
_COLLECTIONS = {Annotated, Union, UnionType, Sequence, Mapping, list, tuple, dict}
_LONGEST = 80  # characters of a value, in a message


def _rule(holds: Callable[[Any], bool], text: str) -> AfterValidator:
    """Return a validator that refuses values with a text."""

    def check(value: Any) -> Any:
        if not holds(value):
            raise ValueError(text)
        return value

    return AfterValidator(check)


RISING = _rule(lambda limits: limits[0] <= limits[1], "must be a range [minimum, maximum]")
"""Makes a pair a range: ``Annotated[tuple[float, float], RISING]``."""
ONCE = _rule(lambda names: len(set(names)) == len(names), "must hold each name once")
"""Makes a list one of different names."""


def check_settings(
    target: Callable[..., Any], settings: Mapping[str, Any], name: str, whole: bool = False
) -> None:
    """Check settings against the parameters of a class or function.

    Args:
        target: the class or function.
        settings: in plain containers; keys that begin with ``_`` are Hydra's.
        name: their group in the configuration, for the message.
        whole: whether they are all arguments; if not, the program passes those without a default.

    Raises:
        InputError: naming the setting, its value and what is valid.
    """
    if not isinstance(settings, Mapping):
        raise InputError(f"{name} must be settings by name, got {settings!r}")
    parameters = _parameters(target)
    required = [key for key, its in parameters.items() if its.default is its.empty]
    takes_others = any(parameter.kind == Parameter.VAR_KEYWORD for parameter in parameters.values())
    for key, value in ((str(key), value) for key, value in settings.items()):
        if key in parameters and (wrong := _explain_refusal(parameters[key].annotation, value)):
            label, default = f"{name}.{key}".removeprefix("."), _written(parameters[key].default)
            text = str(list(value) if isinstance(value, tuple) else value)[:_LONGEST]
            example = f": as in {label}={default}" if default else ""
            raise InputError(f"{label}={text} {wrong}{example}")
        if not (key in parameters or key.startswith("_") or takes_others):
            choices = [name for name in parameters if whole or name not in required or name in settings]
            near = get_close_matches(key, choices, 1)
            hint = f": did you mean {near[0]}?" if near else ":"
            raise InputError(f"{name} has no setting {key}{hint} it has {', '.join(choices)}")
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
    for path, part in reversed([*walk_settings(dict(config))]):
        if not path or not isinstance(part, dict):
            continue
        # The model is inside the learner, but is set by the name of its group.
        name = path[-1] if path[-1] in _INNER else ".".join(path)
        if (target := part.get("_target_")) is None and name in _INNER:
            raise InputError(f"{name} chooses no option: leave it out, or give one that --help lists")
        if target is not None and not str(target).startswith(_LIBRARIES):
            check_settings(import_target(target, f"{name}._target_"), part, name)


def import_target(target: str, name: str) -> Callable[..., Any]:
    """Return a class or function by its dotted name.

    Args:
        target: the name.
        name: of the setting that has it, as in ``model._target_``.

    Raises:
        InputError: it cannot be imported.
    """
    try:
        return _locate(str(target))
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{name}={target} cannot be imported: {error.__cause__ or error}: correct "
            "the name, or add the folder of its module to PYTHONPATH"
        ) from error


def _parameters(target: Callable[..., Any]) -> Mapping[str, Parameter]:
    """Return the parameters; their types stay text where only type checkers know the names in them."""
    try:
        return signature(target, eval_str=True).parameters
    except NameError:
        return signature(target).parameters


def _is_plain(hint: Any) -> bool:
    """Return whether an annotation is made of numbers, text and collections of these alone."""
    origin, arguments = get_origin(hint), get_args(hint)
    parts = arguments[:1] if origin is Annotated else arguments
    return origin is Literal or hint in _SCALARS or (origin in _COLLECTIONS and all(map(_is_plain, parts)))


@cache
def _adapter(hint: Any) -> TypeAdapter:
    return TypeAdapter(hint, config=_STRICT)


def _explain_refusal(hint: Any, value: Any) -> str:
    """Return why a value is invalid, and what is valid; empty if it is valid."""
    if any(get_origin(part) is Callable for part in (hint, *get_args(hint))):
        # Hydra makes a factory of the settings of an option.
        kinds = (str, int, float, list) if NoneType in get_args(hint) else (str, int, float, list, NoneType)
        return "must be an option with its settings" * isinstance(value, kinds)
    try:
        # As JSON, a list may be a tuple and text a path, but nothing else is converted.
        if _is_plain(hint):
            _adapter(hint).validate_json(to_json(value, fallback=_to_plain, inf_nan_mode="constants"))
        return ""
    except ValidationError as error:
        # Of a union, the message for the closest member: the deepest, or one whose type fits.
        fits = ("value_error", "greater_than", "greater_than_equal", "less_than", "less_than_equal")
        nearest = max(error.errors(), key=lambda detail: (len(detail["loc"]), detail["type"] in fits))
        words = [
            detail["msg"].replace("Input should be", " or")
            for detail in error.errors()
            if nearest["type"] == "int_type" and detail["type"] == "literal_error"
        ]
    if nearest["type"] in ("missing", "too_short", "too_long"):
        return f"has too {'many' if nearest['type'] == 'too_long' else 'few'} entries"
    sentence = (
        nearest["msg"]
        .removeprefix("Value error, ")
        .replace("Input should be", "must be")
        .replace("a valid array", "a list")
        .replace("a valid integer", "a whole number")
    )
    return sentence + (
        "".join(words) or ", not text" * (isinstance(nearest["input"], str) and sentence.endswith("number"))
    )


def _to_plain(value: Any) -> Any:
    """Return the content of a configuration or of an array as plain containers, anything else as text."""
    if OmegaConf.is_config(value):
        return OmegaConf.to_container(value, resolve=True)
    return value.tolist() if hasattr(value, "tolist") else str(value)


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
    "contact": "skin.touch.movie",
    "device": "skin.device.base",
    "representation": "skin.learning.representation",
    "model": "skin.learning.model",
    "fusion": "skin.learning.fusion",
    "learner": "skin.learning.learner",
}
"""Configuration groups whose options are classes -> module of the abstract class that they derive from."""

# Package -> base classes, as (module, name). Not every module of PyTorch Geometric: some of them fetch models
# from the network and run what these contain. Of other libraries' models, the learners run one program, which
# no setting can change.
_BASES = {
    "skin": tuple((module, f"Abstract{group.capitalize()}") for group, module in GROUPS.items()),
    "torch.optim": (("torch.optim", "Optimizer"),),
    "torch_geometric.nn": (
        ("torch_geometric.nn.aggr", "Aggregation"),
        ("torch_geometric.nn.conv", "MessagePassing"),
        ("torch_geometric.nn.models.basic_gnn", "BasicGNN"),
    ),
    "experiments.peers": (("skin.learning.learner", "AbstractLearner"),),
}


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
        _refuse(where, ("row",), f"is {row!r}, which cannot name a file")


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
    """Return whether a name belongs to an allowed class.

    The name's package is checked first, because to resolve a name imports modules, and then the class.
    """
    package = next((prefix for prefix in _BASES if str(name).startswith(f"{prefix}.")), None)
    if package is None:
        return False
    with suppress(Exception):  # any error means that there is no such class
        kind = _locate(name)
        bases = tuple(getattr(import_module(module), base) for module, base in _BASES[package])
        concrete = inspect.isclass(kind) and not inspect.isabstract(kind) and issubclass(kind, bases)
        return concrete and f"{kind.__module__}.".startswith(f"{package}.")
    return False


# The name of an option: of a simulator, device, model, ...


def option_name(made: object) -> str:
    """Return the name of the option that an object or its class is.

    The YAML file in ``conf/`` that names the class has this name: ``PlatesAndBeams`` is the option ``fem``,
    as in ``simulator=fem``. A class from outside ``skin`` is named after its module.
    """
    kind = made if hasattr(made, "__qualname__") else type(made)
    return _options().get(f"{kind.__module__}.{kind.__qualname__}", kind.__module__.rpartition(".")[2])


@cache
def _options() -> dict[str, str]:
    """Return the names of the options of ``skin`` by the dotted name of their class."""
    paths = (path for group in GROUPS for path in (CONF / group).glob("*.yaml"))
    return {path.read_text().partition("_target_: ")[2].split()[0]: path.stem for path in paths}
