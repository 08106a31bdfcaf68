"""A room of ``skin/`` imports only the rooms below it, and a public name has one meaning."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from skin.core.files import CONF, ROOT

# From the ground up.
FLOORS = """
errors core body touch mechanics device inference learning wire plot evaluation runs calibration record
design robot live commands __main__
"""
ROOMS = FLOORS.split()
LEVEL = {room: number for number, room in enumerate(ROOMS)}


@cache
def trees() -> dict[Path, ast.Module]:
    paths = [path for folder in ("skin", "experiments") for path in (ROOT / folder).rglob("*.py")]
    return {path.relative_to(ROOT): ast.parse(path.read_text()) for path in paths}


@cache
def imports(path: Path) -> frozenset[str]:
    """Return what a module imports, wherever in it: also what only type checkers or functions import."""
    names = set()
    for node in ast.walk(trees()[path]):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            names |= {name.name for name in node.names}
    return frozenset(names)


@pytest.fixture(scope="module", autouse=True)
def parsed():
    trees()


def dotted_name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def library() -> dict[str, Path]:
    return {dotted_name(path): path for path in trees() if path.parts[0] == "skin"}


def test_every_module_is_in_a_room():
    rooms = {path.parent.name for path in (ROOT / "skin").glob("*/__init__.py")}
    assert rooms == set(ROOMS) - {"errors", "__main__"}
    assert {name.split(".")[1] for name in library() if "." in name} <= set(ROOMS)
    assert {path.stem for path in (ROOT / "skin").glob("*.py")} == {"__init__", "__main__", "errors"}


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_below_it(room):
    wrong = set()
    for name, path in library().items():
        if name.split(".")[1:2] == [room]:
            modules = [target.split(".") for target in imports(path) & library().keys()]
            targets = {module[1] for module in modules if len(module) > 1}
            wrong |= {(name, target) for target in targets - {room} if LEVEL[target] >= LEVEL[room]}
    assert not wrong


def test_nothing_outside_of_their_room_imports_a_device():
    """The interface says what a device can do, so that a device of one's own can do it too."""
    devices = {OmegaConf.load(path)["_target_"] for path in (CONF / "device").glob("*.yaml")}
    devices.remove("skin.device.simulated.Simulated")  # what `AbstractDevice.simulation` returns
    assert len(devices) >= 3
    for name, path in library().items():
        room = ".".join(name.split(".")[:2])
        assert not {target for target in imports(path) & devices if not target.startswith(f"{room}.")}, name


def test_a_file_is_read_in_one_sitting():
    long = {str(path): len((ROOT / path).read_text().splitlines()) for path in trees()}
    assert not {path: lines for path, lines in long.items() if lines > 600}


def test_no_two_public_things_share_a_name():
    """``main`` is left out, which every verb defines."""
    modules = defaultdict(set)
    for path, tree in trees().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                modules[node.name.lower()].add(str(path))
    doubled = {name: paths for name, paths in modules.items() if len(paths) > 1 and name[0] != "_"}
    assert not {name: paths for name, paths in doubled.items() if name != "main"}
