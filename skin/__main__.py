"""The command ``skin VERB overrides...``: a verb is a module of ``skin.commands``, or of an entry point.

Other packages add verbs in the entry-point group ``skin.verbs``: name = module with a function ``main``.
"""

import ast
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from skin.core import interrupt


def verbs() -> dict[str, str]:
    """Return the module of each verb."""
    names = sorted(path.stem for path in (Path(__file__).parent / "commands").glob("[!_]*.py"))
    others = {entry.name: entry.module for entry in entry_points(group="skin.verbs")}
    return {name: f"skin.commands.{name}" for name in names} | dict(sorted(others.items()))


def main(arguments: Sequence[str] | None = None, before: Sequence[str] = ()) -> None:
    """Run a verb.

    Args:
        arguments: the verb and what follows it; None: those of the command line.
        before: what stands before those of the command line, such as the verb of a program.

    Raises:
        SystemExit: with code 2 for bad input.
    """
    verb, *overrides = ([*before, *sys.argv[1:]] if arguments is None else list(arguments)) or ["--help"]
    modules = verbs()
    if verb in ("-sc", "--shell-completion"):
        _complete(" ".join(overrides), modules)
    elif verb in ("-h", "--help"):
        print(_help(modules))
    elif verb == "--version":
        from skin import __version__

        print(f"skin {__version__}")
    elif verb not in modules:
        near = get_close_matches(verb, modules, 1)
        hint = f": did you mean {near[0]}?" if near else f": {', '.join(modules)}"
        sys.exit(_refused(f"skin has no verb {verb}{hint}"))
    elif _source(modules[verb]) is None:
        sys.exit(_refused(f"skin {verb} needs files that an installed package lacks: clone the repository"))
    else:
        try:
            import_module(modules[verb]).main(overrides)
            sys.stdout.flush()
        except BrokenPipeError:
            if not {"-h", "--help"} & {*overrides}:
                raise
            # Nobody reads the help to its end. Python flushes once more when it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except SystemExit as end:
            if end.code == 128 + signal.SIGTERM and arguments is None:
                interrupt.leave(end.code)
            raise


def _help(modules: Mapping[str, str]) -> str:
    """Return the first line of each verb's docstring, without importing it."""
    sources = {name: _source(module) for name, module in modules.items()}
    width = max(map(len, modules))
    lines = [
        f"  {name:{width}}  {(ast.get_docstring(ast.parse(path.read_text())) or '').split(chr(10))[0]}"
        for name, path in sources.items()
        if path
    ]
    completion = 'Completion in bash: eval "$(skin -sc install=bash)"'
    usage, syntax = "usage: skin VERB [OVERRIDE=VALUE ...]", "Overrides have Hydra's syntax."
    return "\n".join(
        [usage, "", *lines, "", f"`skin VERB --help` lists the settings of a verb. {syntax}", completion]
    )


# Of bash; other shells can load it with bashcompinit.
_SCRIPT = """\
_skin() {
    local choices
    choices=$(COMP_LINE="${COMP_LINE:0:COMP_POINT}" "${COMP_WORDS[0]}" -sc query=bash 2>/dev/null)
    COMPREPLY=($(compgen -W "$choices" -- "${COMP_WORDS[COMP_CWORD]}"))
}
COMP_WORDBREAKS=${COMP_WORDBREAKS//=}
complete -o nospace -o default -F _skin skin
"""


def _complete(request: str, modules: Mapping[str, str]) -> None:
    """Print the script that completes a command line in bash, or the choices for ``COMP_LINE``."""
    if request == "install=bash":
        print(_SCRIPT, end="")
        return
    if request != "query=bash":
        sys.exit(_refused(f'skin -sc {request}: give install=bash, as in eval "$(skin -sc install=bash)"'))
    program, *words = os.environ.get("COMP_LINE", "skin ").split(" ")
    if len(words) < 2:
        print(*(name for name in modules if name.startswith("".join(words))))
        return
    verb, *overrides = words
    if verb not in modules:
        return
    # Hydra completes groups, options and settings, and knows no verbs.
    os.environ["COMP_LINE"] = " ".join([program, *overrides])
    import_module(modules[verb]).main(["-sc", "query=bash"])


def _source(module: str) -> Path | None:
    """Return the file of a module, without importing it; None where it is not installed."""
    try:
        spec = find_spec(module)
    except ModuleNotFoundError:
        return None
    return Path(spec.origin) if spec and spec.origin else None


def _refused(reason: str) -> int:
    print(reason, file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()
