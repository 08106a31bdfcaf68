"""Commands: functions of a configuration that Hydra composes from the command line."""

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from difflib import get_close_matches
from typing import Any

from hydra import compose, initialize_config_dir, version
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from skin.core.files import CONF
from skin.core.settings import check_groups

from skin.core import interrupt  # noqa: F401  # isort: skip
import logging
import os
import signal
import sys
import warnings
from functools import wraps
from pathlib import Path
from textwrap import indent

from hydra._internal.utils import _run_hydra, get_args_parser  # what hydra.main itself calls, with sys.argv
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from skin.core.messages import JobInputError, one_line, to_input_error
from skin.errors import InputError
from skin.runs.configuration import (
    Config,
    check_server,
    hide_password,
    overrides,
    validate_config,
    verb_settings,
)
from skin.runs.sweep import left_out

# What a person may have meant by an override that Hydra refuses.


_UNKNOWN = re.compile(r"Could not override '([^']+)'")
_NO_OPTION = re.compile(r"Could not find '(\S+)/([^/']+)'")
_OPTIONS = re.compile(r"Available options in '[^']+':((?:\s+\S+)+)")
_EXTRAS = {
    "'hydra/launcher/joblib'": "parallel",
    "'hydra/launcher/submitit_local'": "slurm",
    "'hydra/launcher/submitit_slurm'": "slurm",
    "'hydra/sweeper/optuna'": "optuna",
}  # options of Hydra's plugins -> extra of this package
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
        names, group = _names(name, words, unknown[1]), unknown[1].partition(".")[0]
        others = {
            f"{group}.{key}": path.stem
            for path in sorted((CONF / group).glob("*.yaml"), reverse=True)
            for key in map(str, OmegaConf.load(path))
        }
        if unknown[1] in others:
            return f"there is no setting or group {unknown[1]}, but {group}={others[unknown[1]]} has it"
        near = get_close_matches(unknown[1], [*names, *others], 1, 0.8)
        of = f", which {group}={others[near[0]]} has" if near and near[0] not in names else ""
        return f"there is no setting or group {unknown[1]}: did you mean {near[0]}{of}?" if near else None
    option, options = _NO_OPTION.search(text), _OPTIONS.search(text)
    if option and options:
        names = options[1].split()
        near = get_close_matches(option[2], names, 1)
        meant = f"did you mean {near[0]}? There are" if near else "there are"
        if extra := _EXTRAS.get(option[0].removeprefix("Could not find ")):
            meant = f'pip install "tactile-skin[{extra}]" adds it; there are'
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
    return [
        *(folder.name for folder in CONF.iterdir() if folder.is_dir()),
        *_settings(OmegaConf.to_container(config), ""),
    ]


def _settings(part: Any, above: str) -> Iterator[str]:
    for key, value in part.items():
        yield f"{above}{key}"
        if isinstance(value, dict):
            yield from _settings(value, f"{above}{key}.")


# Checks of a configuration that need no run, made before anything is loaded.


_GROUPS = ("body", "layout", "touch", "device", "contact")


def check_quickly(config: Config, run: str | None, overrides: Sequence[str]) -> None:
    """Refuse settings of a skin that no skin has, and a port that does not exist.

    Args:
        config: of a command; groups that it lacks are not checked.
        run: that the command uses; None: none.
        overrides: of its command line. The groups that they name are checked further, which imports torch.

    Raises:
        InputError: naming the setting, or the port.
    """
    # They import numpy, for which a mistyped setting must not wait.
    from skin.body.base import check_plausibility

    groups: dict[str, Any] = {name: group for name in _GROUPS if (group := getattr(config, name))}
    check_groups({name: groups[name] for name in ("body", "layout") if name in groups})
    check_plausibility(groups)
    device = groups.get("device", {})
    if isinstance(port := device.get("port"), str):
        from skin.wire.reader import Port, check_port

        Port.select({name: value for name, value in device.items() if value is not None})
        check_port(port)
    named = {override.split("=")[0].split(".")[0] for override in overrides}
    if run is not None and not run.endswith(".onnx"):
        check_groups({name: groups[name] for name in ("device", "contact") if name in groups.keys() & named})
        if "touch" in named:
            from skin.touch.fingertips import read_touch

            read_touch(groups["touch"])


_VERSION = "1.3"  # of Hydra, whose defaults hold
# What Hydra raises on overrides such as layout=[[1]] or model=1, and on files that are not YAML, before a
# command starts.
_WORDS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
    YAMLError,
)


def command(name: str = "train") -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Return a decorator that turns a function into a command.

    The function gets a checked configuration, and the settings of the command as annotated parameters.

    Bad input ends the command with a message and exit code 2. In a multirun the job fails and the others
    continue. The command takes a list of arguments; None: those of the process.

    Args:
        name: the primary configuration, a file in ``conf/``.
    """

    def decorate(task: Callable[..., Any]) -> Callable[..., None]:
        started = []

        @wraps(task)
        def job(config: DictConfig) -> Any:
            started.append(True)
            if HydraConfig.get().mode == RunMode.MULTIRUN and left_out():
                return None
            try:
                own, checked = verb_settings(config, task), validate_config(config)
                check_server(checked.tracking.uri)
                check_quickly(checked, own.get("run"), overrides())
                return task(checked, **own)
            except Exception as error:
                refused = to_input_error(error)
                if refused is None:
                    raise
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    raise JobInputError(str(refused)) from error
                print(refused, file=sys.stderr)
                sys.exit(2)

        def main(words: Sequence[str] | None = None) -> None:
            _log_to_stderr()
            started.clear()  # where this process ran the command before
            arguments = [
                hide_password(word) if "tracking.uri=" in word else word
                for word in (sys.argv[1:] if words is None else words)
            ]
            try:
                _run(job, name, arguments)
            except Exception as error:
                refused = to_input_error(error)
                if refused is None and not started and isinstance(error, _WORDS):
                    refused = InputError(f"the configuration cannot be composed: {one_line(error)}")
                if refused is None or "HYDRA_FULL_ERROR" in os.environ:
                    raise
                print(suggest(error, name, arguments) or refused, file=sys.stderr)
                sys.exit(1 if started else 2)

        return main

    return decorate


def notify(text: str) -> None:
    """Write a message for the user to standard error; results go to standard output."""
    print(text, file=sys.stderr, flush=True)


def _log_to_stderr() -> None:
    """Write the messages of this package to standard error; results go to standard output."""
    logger = logging.getLogger("skin")
    logger.setLevel(logging.INFO)
    # A handler of an earlier command in this process would write to the standard error of that time.
    logger.handlers = [logging.StreamHandler()]


def _run(job: Callable[[DictConfig], Any], name: str, words: Sequence[str]) -> None:
    """Compose a configuration and run a job with it, or print help."""
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    version.setbase(_VERSION)
    parser = get_args_parser()
    parser.usage = "skin VERB [--OPTION ...] [NAME=VALUE ...]"
    # Neither the shell nor Hydra expands ~ in device.path=~/x.csv. An id such as 3e066519 is no number.
    options = parser.parse_intermixed_args(
        [
            re.sub(r"^run=(\d[\da-f]*)$", r"run='\1'", word.replace("=~/", f"={Path.home()}/", 1))
            for word in words
        ]
    )
    if options.help:
        _print(_help(sys.modules[job.__module__].__doc__ or "", options.config_name or name, options))
        return
    full_error = os.environ.get("HYDRA_FULL_ERROR")
    # Makes Hydra raise errors instead of printing them.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        _run_hydra(options, parser, job, str(CONF), name)
    finally:
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]


def _print(text: str) -> None:
    """Print a text; end quietly where nobody reads it to the end, as in ``skin VERB --help | head``."""
    if not hasattr(signal, "SIGPIPE"):
        print(text)
        return
    handler = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    print(text, flush=True)
    signal.signal(signal.SIGPIPE, handler)


def _help(about: str, name: str, options_given: Any) -> str:
    """Return the help of a command: its docstring, the options of its groups, and its settings."""
    folders = [CONF, *([Path(options_given.config_dir).resolve()] if options_given.config_dir else [])]
    words = [*options_given.overrides, f"hydra.searchpath=[{','.join(map(str, folders[1:]))}]"]
    with initialize_config_dir(str(CONF), version_base=_VERSION):
        config = compose(name, words, return_hydra_config=True)
        choices = config.hydra.runtime.choices.items()
        chosen = {group: option for group, option in choices if not group.startswith("hydra/")}
    options = {
        group: sorted({path.stem for folder in folders for path in (folder / group).glob("*.yaml")})
        for group in chosen
    }
    width = max(map(len, chosen), default=0)
    lines = [
        f"  {group:{width}}  {', '.join(f'[{name}]' if name == chosen[group] else name for name in choices)}"
        for group, choices in options.items()
    ]
    texts = [_text(folders, part) for part in reversed(_parts(folders, name))]
    for group, option in chosen.items():
        if option and (text := _text(folders, f"{group}/{option}")):
            texts.append(f"{group}:\n{indent(text, '  ')}")
    settings = indent("\n\n".join(texts), "  ")
    groups = "\n".join(["Groups, as in GROUP=OPTION; [what is chosen]:", *lines])
    return f"{about.strip()}\n\n{groups}\n\nSettings, as in NAME=VALUE or GROUP.NAME=VALUE:\n\n{settings}"


def _parts(folders: Sequence[Path], name: str) -> list[str]:
    """Return the configurations without a group that a configuration includes, itself last."""
    stored = OmegaConf.load(next(path for folder in folders if (path := folder / f"{name}.yaml").is_file()))
    assert isinstance(stored, DictConfig)
    below = [part for part in stored.get("defaults", []) if isinstance(part, str) and part != "_self_"]
    return [ancestor for part in below if part != "command" for ancestor in _parts(folders, part)] + [name]


def _text(folders: Sequence[Path], name: str) -> str:
    """Return the settings in a configuration's file, with its comments and without its defaults list."""
    files = [path for folder in folders if (path := folder / f"{name}.yaml").is_file()]
    lines = files[-1].read_text().splitlines() if files else []
    shown_lines, listed = [], False
    for line in lines:
        listed = line.startswith("defaults:") or (listed and line.startswith((" ", "-")))
        if not listed and not line.startswith(("_target_", "_convert_", "_partial_", "# @package")):
            shown_lines.append(line)
    return "\n".join(shown_lines).strip()
