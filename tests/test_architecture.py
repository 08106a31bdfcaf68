"""A package of ``skin`` imports only packages above it in the list, so that there are no cycles."""

import ast
import re
from pathlib import Path

import pytest

from skin.paths import CONF, ROOT

# From the ground up; a name is a package or a module of skin/. Names on one line do not import each other.
LAYERS = """
errors interrupt paths option safe_loading
trust checksum suggestions
settings
error_messages fingerprint labels rng material model sensor_dynamics sensors
config recording body gesture_measures shard
files recording_metadata layout summary plausibility
recording_file touch tracking array_cache
simulator data_set
contact sensor_geometry skin_distribution
signal
device
wire representation progress
quick_checks
command
fusion
classifier class_balance
datamodule
learner
evaluation build unfinished claim run_logger run_overrides trained_model
finished_run exported
alarm_threshold model_folder
model_of_run
hardware
design
console
run generation
sweep adaptation
commands
cli
__main__
"""
LEVEL = {name: number for number, line in enumerate(LAYERS.split("\n")) for name in line.split()}


def modules(folder: Path) -> dict[str, Path]:
    """Return every module under a folder by its dotted name."""
    found = {}
    for path in folder.rglob("*.py"):
        parts = path.relative_to(folder.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path) -> set[str]:
    """Return what a module imports, wherever in it: also what only type checkers or functions import."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return found


ALL = modules(ROOT / "skin")
PACKAGES = sorted({name.split(".")[1] for name in ALL if "." in name})


def test_every_package_has_a_place():
    assert sorted(LEVEL) == PACKAGES


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_what_is_above_it(package):
    wrong = set()
    for name, path in ALL.items():
        if name.split(".")[1:2] == [package]:
            targets = {target.split(".")[1] for target in imports(path) if target in ALL and "." in target}
            wrong |= {(name, target) for target in targets - {package} if LEVEL[target] >= LEVEL[package]}
    assert not wrong


def test_nothing_outside_of_their_package_imports_a_device():
    """The interface says what a device can do, so that a device of one's own can do it too."""
    targets = [re.findall(r"_target_: (.*)\.", path.read_text()) for path in (CONF / "device").glob("*.yaml")]
    devices = {module for modules in targets for module in modules[:1]}
    assert len(devices) >= 4
    for name, path in ALL.items():
        if not name.startswith("skin.device."):
            assert not imports(path) & devices, name


def test_the_library_needs_nothing_of_the_experiments():
    theirs = {path.stem for path in (ROOT / "experiments").iterdir()} - {"__pycache__"}
    for name, path in ALL.items():
        assert not {target.split(".")[0] for target in imports(path)} & theirs, name
