"""The command ``skin VERB overrides...``: a verb is a module of ``skin.commands``."""

import ast
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path

__all__ = ["main", "verbs"]

_FOLDER = Path(__file__).parent / "commands"


def verbs() -> dict[str, str]:
    """Return each verb with the first line of its documentation, without importing anything."""
    paths = sorted(path for path in _FOLDER.glob("*.py") if not path.stem.startswith("_"))
    texts = {path.stem: ast.get_docstring(ast.parse(path.read_text())) or "" for path in paths}
    return {name: text.split("\n")[0] for name, text in texts.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a verb.

    Args:
        arguments: the verb and what follows it; None: those of the command line.

    Raises:
        SystemExit: with code 2 for bad input.
    """
    verb, *rest = (sys.argv[1:] if arguments is None else list(arguments)) or ["--help"]
    known = verbs()
    if verb in ("-h", "--help"):
        width = max(map(len, known))
        print("usage: skin VERB [OVERRIDE=VALUE ...]\n")
        print(*(f"  {name:{width}}  {text}" for name, text in known.items()), sep="\n")
        print("\n`skin VERB --help` lists the settings of a verb. Overrides have Hydra's syntax.")
    elif verb == "--version":
        from skin import __version__

        print(f"skin {__version__}")
    elif verb in known:
        import_module(f"skin.commands.{verb}").main(rest)
    else:
        near = get_close_matches(verb, known, 1)
        said = f": did you mean {near[0]}?" if near else f": {', '.join(known)}"
        print(f"skin has no verb {verb}{said}", file=sys.stderr)
        sys.exit(2)
