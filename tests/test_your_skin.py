"""The walk through a skin of one's own, as the page tells it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "your-skin.md").read_text()
FILES = dict(re.findall(r"^`~/([^`]+)`:\n\n```\w+\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE))
COMMANDS = re.findall(r"^```bash\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A home with the page's files, and a stand-in for the checkout that runs write into."""
    home = tmp_path_factory.mktemp("home")
    for name, text in FILES.items():
        path = home / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (home / "bin").mkdir()
    (home / "bin" / "python").symlink_to(sys.executable)
    (home / "checkout").mkdir()
    (home / "checkout" / "experiments").symlink_to(ROOT / "experiments")
    return home


def run(command: str, home: Path) -> str:
    """Run a command of the page as a user's shell would, and return what it prints."""
    environment = {
        **os.environ,
        "HOME": str(home),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    result = subprocess.run(
        ["bash", "-ec", command],
        cwd=home / "checkout",
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_the_page_has_the_files_and_commands_of_the_walk():
    assert sorted(FILES) == ["my-skin/body/mine.yaml", "my-skin/sensors.csv"]
    assert len(COMMANDS) == 3
