"""What a person may have meant by an override that Hydra refuses."""

import re
import shlex
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf

from skin.paths import CONF

_UNKNOWN = re.compile(r"Could not override '([^']+)'")
_NO_OPTION = re.compile(r"Could not find '(\S+)/([^/']+)'")
_OPTIONS = re.compile(r"Available options in '[^']+':((?:\s+\S+)+)")
_AMBIGUOUS = re.compile(r"Ambiguous value for argument '(.+?)'\n")


def suggest(error: Exception, name: str, words: Sequence[str]) -> str | None:
    """Return a sentence on what to type instead, or None if nothing is near.

    Args:
        error: of Hydra.
        name: the primary configuration.
        words: of the command line.
    """
    if not isinstance(error, HydraException):
        return None
    text = str(error).split("Config search path:")[0]
    ambiguous = _AMBIGUOUS.search(text)
    if isinstance(error, OverrideParseException) or ambiguous:
        override = ambiguous[1] if ambiguous else str(getattr(error, "override", ""))
        quoted = quote_value(override)
        return None if quoted is None else f"{override} cannot be read: quote the value, as in {quoted}"
    if unknown := _UNKNOWN.search(text):
        near = get_close_matches(unknown[1], _names(name, words, unknown[1]), 1, 0.8)
        return f"there is no setting or group {unknown[1]}: did you mean {near[0]}?" if near else None
    option, options = _NO_OPTION.search(text), _OPTIONS.search(text)
    if option and options:
        names = options[1].split()
        near = get_close_matches(option[2], names, 1)
        meant = f"did you mean {near[0]}? There are" if near else "there are"
        return f"there is no {option[1]}={option[2]}: {meant} {', '.join(names)}"
    return None


def quote_value(override: str) -> str | None:
    """Return an override with a quoted value, as a shell takes it; None if that does not help."""
    key, equals, value = override.partition("=")
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    quoted = f'{key}="{escaped}"'
    try:
        parsed = OverridesParser.create().parse_override(quoted)
    except HydraException:
        return None
    return shlex.quote(quoted) if equals and parsed.value() == value else None


def _names(name: str, words: Sequence[str], unknown: str) -> list[str]:
    """Return the groups and settings of a configuration by their names on the command line."""
    settings = [word for word in words if "=" in word and not word.startswith(("-", unknown))]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        try:
            config = compose(name, settings)
        except HydraException:
            config = compose(name)
    groups = [folder.name for folder in CONF.iterdir() if folder.is_dir()]
    return [*groups, *_settings(OmegaConf.to_container(config), "")]


def _settings(part: Any, above: str) -> Iterator[str]:
    for key, value in part.items():
        yield f"{above}{key}"
        if isinstance(value, dict):
            yield from _settings(value, f"{above}{key}.")
