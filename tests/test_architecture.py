"""A room of ``skin/`` imports only the rooms below it, and the house stays small (``house.py``)."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from skin.core.files import CONF, ROOT

# From the ground up.
ROOMS = [
    "errors",
    "core",
    "body",
    "touch",
    "mechanics",
    "device",
    "inference",
    "learning",
    "plot",
    "evaluation",
    "runs",
    "design",
    "hardware",
    "commands",
    "__main__",
]
LEVEL = {room: number for number, room in enumerate(ROOMS)}

_spec = importlib.util.spec_from_file_location("house", Path(__file__).with_name("house.py"))
assert _spec is not None
assert _spec.loader is not None
house = importlib.util.module_from_spec(_spec)
sys.modules["house"] = house
_spec.loader.exec_module(house)


@pytest.fixture(scope="module", autouse=True)
def parsed():
    """Parse all modules once."""
    house.trees()


def modules(folder: Path) -> dict[str, Path]:
    """Return every module under a folder by its dotted name."""
    paths = {}
    for path in folder.rglob("*.py"):
        parts = path.relative_to(folder.parent).with_suffix("").parts
        paths[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return paths


def imports(path: Path) -> set[str]:
    """Return what a module imports, wherever in it: also what only type checkers or functions import."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            names |= {name.name for name in node.names}
    return names


ALL = modules(ROOT / "skin")


def test_every_module_is_in_a_room():
    assert {name.split(".")[1] for name in ALL if "." in name} <= set(ROOMS)
    assert house.loose_modules() == {"__init__", "__main__", "errors"}
    assert house.rooms() == set(ROOMS) - {"errors", "__main__"}


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_below_it(room):
    wrong = set()
    for name, path in ALL.items():
        if name.split(".")[1:2] == [room]:
            targets = {target.split(".")[1] for target in imports(path) if target in ALL and "." in target}
            wrong |= {(name, target) for target in targets - {room} if LEVEL[target] >= LEVEL[room]}
    assert not wrong


def test_nothing_outside_of_their_room_imports_a_device():
    """The interface says what a device can do, so that a device of one's own can do it too."""
    devices = {OmegaConf.load(path)["_target_"] for path in (CONF / "device").glob("*.yaml")}
    assert len(devices) >= 4
    for name, path in ALL.items():
        room = ".".join(name.split(".")[:2])
        assert not {target for target in imports(path) & devices if not target.startswith(f"{room}.")}, name


def test_the_library_needs_nothing_of_the_experiments():
    theirs = {path.stem for path in (ROOT / "experiments").iterdir()} - {"__pycache__"}
    for name, path in ALL.items():
        assert not {target.split(".")[0] for target in imports(path)} & theirs, name


def test_a_file_is_read_in_one_sitting():
    long = {str(path): len((ROOT / path).read_text().splitlines()) for path in house.trees()}
    assert not {path: lines for path, lines in long.items() if lines > 600}


def test_no_two_public_things_share_a_name():
    assert not house.doubled_names()


@pytest.mark.parametrize(
    ("figure", "limit"), [("statements", 24_980), ("files", 205), ("words of documentation", 26_950)]
)
def test_the_house_stays_small(figure, limit):
    """Raise a limit only for a new capability, and say so in the change log."""
    assert house.figures()[figure] <= limit
