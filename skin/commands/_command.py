"""Commands: functions of a configuration that Hydra composes from the command line."""

import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from functools import wraps
from inspect import signature
from pathlib import Path
from textwrap import indent
from typing import Any

from hydra import compose, initialize_config_dir, version
from hydra._internal.utils import _run_hydra, get_args_parser  # what hydra.main itself calls, with sys.argv
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from skin.core.files import CONF
from skin.core.messages import JobInputError, one_line, to_input_error
from skin.core.settings import check_settings, walk_settings
from skin.errors import InputError
from skin.runs.configuration import (
    Config,
    check_numbers,
    check_server,
    hide_password,
    plain_settings,
    refuse_unknown,
    validate_config,
)
from skin.runs.sweep import belongs_to_other_shard

_VERSION = "1.3"  # of Hydra, whose defaults hold

# What a person may have meant by an override that Hydra refuses.


_UNKNOWN = re.compile(r"Could not override '([^']+)'")
_NO_OPTION = re.compile(r"Could not find '(\S+)/([^/']+)'")
_OPTIONS = re.compile(r"Available options in '[^']+':((?:\s+\S+)+)")


def suggest(error: Exception, name: str) -> str | None:
    """Return a sentence on what to type instead, or None if nothing is near.

    Args:
        error: of Hydra.
        name: the primary configuration.
    """
    text = str(error).split("Config search path:")[0]
    if unknown := _UNKNOWN.search(text):
        with initialize_config_dir(str(CONF), version_base=_VERSION):
            names = [
                *(folder.name for folder in CONF.iterdir() if folder.is_dir()),
                *(".".join(path) for path, _ in walk_settings(OmegaConf.to_container(compose(name)))),
            ]
        group, _, key = unknown[1].partition(".")
        options = [path for path in sorted((CONF / group).glob("*.yaml")) if key in OmegaConf.load(path)]
        if options:
            return f"there is no setting or group {unknown[1]}, but {group}={options[0].stem} has it"
        if near := get_close_matches(unknown[1], names, 1, 0.8):
            return f"there is no setting or group {unknown[1]}: did you mean {near[0]}?"
        # Of a group that exists, Hydra's own answer is of use: with + a setting reaches its class.
        return None if group in names else f"there is no setting or group {unknown[1]}: --help lists them"
    chosen, listed = _NO_OPTION.search(text), _OPTIONS.search(text)
    if not chosen or not listed:
        return None
    near = get_close_matches(chosen[2], listed[1].split(), 1)
    hint = f"did you mean {near[0]}? There are" if near else "there are"
    return f"there is no {chosen[1]}={chosen[2]}: {hint} {', '.join(listed[1].split())}"


def output(out: str | None, example: str, *endings: str) -> Path:
    """Return the path that ``out=`` gives.

    Raises:
        InputError: no path, or one with another ending than these; the ending of a folder is empty.
    """
    if not out or not Path(out).name or Path(out).suffix not in endings:
        kinds = " or ".join(f"a {ending} file" if ending else "a folder" for ending in endings)
        raise InputError(f"out={out} must be {kinds}: add out={example}")
    return Path(out).expanduser()


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
            if HydraConfig.get().mode == RunMode.MULTIRUN and belongs_to_other_shard():
                return None
            try:
                own, checked = _verb_settings(config, task), validate_config(config)
                check_server(checked.tracking.uri)
                _check_port(checked.device)
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
            started.clear()  # where this process ran the command before
            arguments = [
                hide_password(word) if "tracking.uri=" in word else word
                for word in (sys.argv[1:] if words is None else words)
            ]
            traced = "HYDRA_FULL_ERROR" in os.environ
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
            try:
                _run(job, name, arguments)
            except Exception as error:
                refused = to_input_error(error)
                if refused is None and not started and isinstance(error, _WORDS):
                    refused = InputError(f"the configuration cannot be composed: {one_line(error)}")
                if refused is None or traced:
                    raise
                print(suggest(error, name) or refused, file=sys.stderr)
                sys.exit(1 if started else 2)
            finally:
                if not traced:
                    del os.environ["HYDRA_FULL_ERROR"]

        return main

    return decorate


def _verb_settings(config: DictConfig, verb: Callable[..., Any]) -> dict[str, Any]:
    """Return the settings of a verb alone, by the names of its parameters after the first.

    Args:
        config: as Hydra composes it.
        verb: its function; ``from_`` is the setting ``from``, which is a keyword of Python.

    Raises:
        InputError: a value does not fit the annotation of its parameter, a group is null, or a setting is
            unknown.
    """
    hints = {name: str(hint) for name, hint in (Config.__annotations__ | verb.__annotations__).items()}
    for name in sorted(name for name, hint in hints.items() if "dict" in hint or "skin." in hint):
        if name in config and config[name] is None:
            raise InputError(
                f"{name}=null leaves nothing to use: give settings or an option, or leave it out"
            )
    names = [*signature(verb).parameters][1:]
    refuse_unknown(config, [name.removesuffix("_") for name in names])
    plain = plain_settings(config)
    settings = {name: plain[name.removesuffix("_")] for name in names}
    check_numbers({name.removesuffix("_"): value for name, value in settings.items()})
    check_settings(verb, settings, "")
    return settings


def notify(text: str) -> None:
    """Write a message for the user to standard error; results go to standard output."""
    print(text, file=sys.stderr, flush=True)


def _check_port(device: Mapping[str, Any] | None) -> None:
    """Refuse a port that does not exist, before anything that takes seconds."""
    if isinstance(port := (device or {}).get("port"), str):
        from skin.wire.reader import check_port

        check_port(port)


def _run(job: Callable[[DictConfig], Any], name: str, words: Sequence[str]) -> None:
    """Compose a configuration and run a job with it, or print help."""
    logger = logging.getLogger("skin")
    logger.setLevel(logging.INFO)
    # To standard error; a handler of an earlier command in this process would write to that of its time.
    logger.handlers = [logging.StreamHandler()]
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    version.setbase(_VERSION)
    parser = get_args_parser()
    parser.usage = "skin VERB [--OPTION ...] [NAME=VALUE ...]"
    # Neither the shell nor Hydra expands ~ in device.path=~/x.csv, and Hydra reads 3e066519 as a number.
    options = parser.parse_intermixed_args(
        [
            re.sub(r"^run=(\d[\da-f]*)$", r"run='\1'", word.replace("=~/", f"={Path.home()}/", 1))
            for word in words
        ]
    )
    if options.help:
        print(_help(sys.modules[job.__module__].__doc__ or "", options.config_name or name, options))
        return
    _run_hydra(options, parser, job, str(CONF), name)


_UNSHOWN = re.compile(
    r"^(?:defaults:.*(?:\n[ -].*)*|(?:_target_|_convert_|_partial_|# @package).*)\n?", re.MULTILINE
)  # lines of a configuration that set nothing


def _help(description: str, name: str, given: Any) -> str:
    """Return the help of a command: its docstring, the options of its groups, and its settings."""
    folders = [CONF, *([Path(given.config_dir).resolve()] if given.config_dir else [])]
    words = [*given.overrides, f"hydra.searchpath=[{','.join(map(str, folders[1:]))}]"]
    with initialize_config_dir(str(CONF), version_base=_VERSION):
        choices = compose(name, words, return_hydra_config=True).hydra.runtime.choices
        loader = GlobalHydra.instance().config_loader()
        listed = loader.compute_defaults_list(name, words, RunMode.RUN).defaults
    chosen = {group: option for group, option in choices.items() if not group.startswith("hydra/")}
    width, lines = max(map(len, chosen), default=0), []
    for group, option in chosen.items():
        names = sorted({path.stem for folder in folders for path in (folder / group).glob("*.yaml")})
        shown = ", ".join(f"[{name}]" if name == option else name for name in names)
        lines.append(f"  {group:{width}}  {shown}")
    own = [part.config_path for part in listed if part.config_path and "/" not in part.config_path]
    texts = [_text(folders, part) for part in reversed(own) if part != "command"]
    texts += [
        f"{group}:\n{indent(text, '  ')}"
        for group, option in chosen.items()
        if option and (text := _text(folders, f"{group}/{option}"))
    ]
    groups = "\n".join(["Groups, as in GROUP=OPTION; [what is chosen]:", *lines])
    syntax = "Settings, as in NAME=VALUE or GROUP.NAME=VALUE:"
    return "\n\n".join([description.strip(), groups, syntax, indent("\n\n".join(texts), "  ")])


def _text(folders: Sequence[Path], name: str) -> str:
    """Return the settings in a configuration's file, with its comments and without its defaults list."""
    files = [path for folder in folders if (path := folder / f"{name}.yaml").is_file()]
    return _UNSHOWN.sub("", files[-1].read_text() if files else "").strip()
