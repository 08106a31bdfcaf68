"""Measure the plan of the house: ``python tests/house.py [skin VERB overrides ...]``.

Prints statements, files, rooms, names and words of this checkout. With a command behind it, runs the command
and prints the files of ``skin`` and ``experiments`` in which a function was executed.
``test_architecture.py`` holds the figures to their limits.
"""

import ast
import inspect
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("skin", "experiments")
PRONOUNS = frozenset(
    [
        "one",
        "found",
        "known",
        "own",
        "said",
        "there",
        "of",
        "each",
        "other",
        "kept",
        "asked",
        "given",
        "wanted",
        "shown",
        "here",
        "those",
        "these",
        "it",
        "more",
        "rest",
    ]
)


@cache
def trees() -> dict[Path, ast.Module]:
    """Return the syntax tree of each module, by its path from the root."""
    paths = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    return {path.relative_to(ROOT): ast.parse(path.read_text()) for path in paths}


def count_statements(tree: ast.Module) -> int:
    """Return the number of statements without docstrings; imports count."""
    return sum(isinstance(node, ast.stmt) and not is_docstring(node) for node in ast.walk(tree))


def is_docstring(node: ast.stmt) -> bool:
    """Return whether a statement is a text alone, which documents what stands before or around it."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def assigned_names(tree: ast.Module) -> list[str]:
    """Return each name that is assigned, once per assignment."""
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.Name))
    return [node.id for node in nodes if isinstance(node.ctx, ast.Store)]


def public_names(tree: ast.Module) -> Iterator[str]:
    """Yield the public classes and functions that a module defines."""
    for node in tree.body:
        if isinstance(
            node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ) and not node.name.startswith("_"):
            yield node.name


def doubled_names() -> dict[str, list[str]]:
    """Return the public names, case aside, that two or more modules define, with these modules.

    ``main`` is left out, which every verb defines.
    """
    modules = defaultdict(set)
    for path, tree in trees().items():
        for name in public_names(tree):
            modules[name.lower()].add(str(path))
    return {name: sorted(paths) for name, paths in modules.items() if len(paths) > 1 and name != "main"}


def loose_modules() -> set[str]:
    """Return the modules of ``skin/`` that are in no room."""
    return {path.stem for path in (ROOT / "skin").glob("*.py")}


def rooms() -> set[str]:
    """Return the packages of ``skin/``."""
    return {path.parent.name for path in (ROOT / "skin").glob("*/__init__.py")}


def count_words() -> int:
    """Return the words of ``docs/`` without the published results."""
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs/adr").glob("*.md")]
    return sum(len(page.read_text().split()) for page in pages)


def figures() -> dict[str, float]:
    """Return the figures of this checkout by name."""
    names = [name for tree in trees().values() for name in assigned_names(tree)]
    return {
        "statements": sum(map(count_statements, trees().values())),
        "files": len(trees()),
        "loose modules": len(loose_modules()),
        "rooms": len(rooms()),
        "public names defined twice": len(doubled_names()),
        "pronouns, % of assigned names": 100 * sum(name in PRONOUNS for name in names) / len(names),
        "studies": len(list((ROOT / "conf/study").glob("*.yaml"))),
        "YAML files of conf/": len(list((ROOT / "conf").rglob("*.yaml"))),
        "words of documentation": count_words(),
    }


def executed_files(arguments: list[str]) -> list[str]:
    """Run ``skin`` with arguments, and return the modules in which a function was executed."""
    executed = set()

    def note(frame, event, argument):
        code = frame.f_code
        if event == "call" and code.co_flags & inspect.CO_OPTIMIZED:  # bodies of modules and classes are not
            executed.add(code.co_filename)

    from skin.__main__ import main

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        main(arguments)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    folders = [str(ROOT / folder) for folder in FOLDERS]
    return sorted(str(Path(name).relative_to(ROOT)) for name in executed if name.startswith(tuple(folders)))


if __name__ == "__main__":
    if arguments := sys.argv[1:]:
        files = executed_files(arguments)
        print(*files, f"{len(files)} files executed", sep="\n")
    else:
        for name, value in figures().items():
            print(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
