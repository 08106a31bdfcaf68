"""The walk through a skin of one's own, as the page tells it."""

import os
import re
import shlex
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "your-skin.md").read_text()
FILES = dict(re.findall(r"^`~/([^`]+)`:\n\n```\w+\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE))
COMMANDS = re.findall(r"^```bash\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
COARSE = "body.cells=[15,10]", "simulator.divisions=1"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A home with the page's files, and a stand-in for the checkout where runs leave their output."""
    home = tmp_path_factory.mktemp("home")
    for name, text in FILES.items():
        path = home / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (home / "checkout").mkdir()
    (home / "checkout" / "experiments").symlink_to(ROOT / "experiments")
    return home


@pytest.fixture
def follow(home, run, monkeypatch):
    """Return a function that runs a command of the page, in a process that shares its imports with others."""
    monkeypatch.setenv("HOME", str(home))

    def run_it(command: str, *more: str) -> subprocess.CompletedProcess:
        words = [os.path.expanduser(word) for word in shlex.split(command.replace("\\\n", " "))]
        return run(home, f"{words[1]}.py", *words[2:], *more, store=words[1] != "animate")

    return run_it


def started(command: str, home: Path) -> str:
    """Run a command of the page as a user's shell would, and return what it prints."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    own = {
        "cwd": home / "checkout",
        "env": os.environ | {"HOME": str(home), "PATH": path, "PYTHONPATH": str(ROOT)},
    }
    result = subprocess.run(["bash", "-ec", command], capture_output=True, text=True, timeout=300, **own)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_the_check_of_the_page_draws_the_skin_and_refuses_a_wrong_layout(follow, home):
    assert sorted(FILES) == ["my-skin/body/mine.yaml", "my-skin/sensors.csv"]
    assert ["--cfg job" in command for command in COMMANDS] == [False, False, False, False, True, False]
    done = follow(COMMANDS[0], *COARSE)
    assert "touch.png: " in done.stdout, done.stderr
    path = home / "my-skin" / "sensors.csv"
    path.write_text(path.read_text().replace("0.131,", "0.231,"))
    try:
        assert "the first is sensor 8 at x = 0.231 m" in follow(COMMANDS[0], *COARSE).stderr
    finally:
        path.write_text(FILES["my-skin/sensors.csv"])


def test_the_configuration_of_the_page_is_the_users(home):
    shown = OmegaConf.create(started(f"{COMMANDS[0].strip()} --cfg job", home))
    body = instantiate(shown.body)
    assert (body.size, body.cells, len(body.layers)) == ((0.15, 0.10), (30, 20), 3)
    assert [layer.material.young for layer in body.layers] == [560e3, 40e3, 69e3]
    simulators = {shown.simulator._target_, shown.device.simulator._target_}
    assert simulators == {"skin.mechanics.simulator.solid.Solid"}
    assert shown.layout._target_ == "skin.body.layout.File"
    depths = instantiate(OmegaConf.merge(shown.layout, {"path": str(home / "my-skin/sensors.csv")}))
    # Inside a layer, where only the solid has sensors.
    assert set(depths.sensors(body).positions[:, 2]) == {0.006}
    assert (shown.layout.path, shown.layout.footprint) == ("~/my-skin/sensors.csv", [0.008, 0.008])


def test_the_overrides_of_the_page_describe_the_same_sheet(home):
    shown = OmegaConf.create(started(COMMANDS[4], home))
    body = instantiate(shown.body)
    sensors = instantiate(shown.layout).sensors(body)
    assert (body.size, body.thickness) == ((0.15, 0.10), pytest.approx(0.016))
    assert (body.layers[1].material.young, len(sensors)) == (69e3, 8)


@pytest.mark.parametrize("line", COMMANDS[5].splitlines())
def test_the_commands_of_the_page_put_sensors_on_an_arm(home, line):
    shown = OmegaConf.create(started(f"{line.partition('  #')[0]} --cfg job", home))
    body = instantiate(shown.body)
    assert not body.flat
    assert shown.simulator._target_ == "skin.mechanics.simulator.solid.Solid"
    leaning = instantiate(shown.layout).sensors(body).tilted
    assert leaning.all() == leaning.any() == ("tilted" in line)


@pytest.mark.slow("trains as the page does")
def test_the_training_of_the_page_runs(home, follow):
    def said(command: str, *more: str) -> str:
        done = follow(command, *more)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    # A coarser mesh and less evaluation than the page's, for time.
    few = ["evaluation.devices=1", "evaluation.layouts=1", "evaluation.safe_gestures=64"]
    said(COMMANDS[1], *COARSE, *few)
    # What learned from so little passes neither the self-test nor the choice of a threshold.
    quick = ["live.touch=0.3", "live.web_port=0", "live.selftest=false", "live.patience.above=0.5"]
    said(COMMANDS[2].replace("seconds=30", "seconds=1"), *quick)
    margins = said(COMMANDS[3].replace("gestures=2000", "gestures=1000"), f"out={home}/found")
    assert ": alarm above " in margins
    with sqlite3.connect(home / "m.db") as database:
        states = database.execute("select name, status from runs order by start_time").fetchall()
    database.close()
    assert [state for _, state in states] == ["FINISHED"]
    name = states[0][0]
    assert name.startswith("custom solid body=mine ")
