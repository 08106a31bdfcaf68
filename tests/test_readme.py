"""The commands of README.md and docs/ leave no file that git would want to add."""

import re
import subprocess
from pathlib import Path

import pytest

from skin.core.files import ROOT

PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
WRITTEN = re.compile(r"^(?:skin \w+|python (?:experiments/)?\w+\.py) .*?\b(?:out|link|session)=(\S+)", re.M)


def files():
    """Return the files that commands write, as their pages name them, with what lies beside them."""
    for page in PAGES:
        for block in re.findall(r"```\w*\n(.*?)```", page.read_text(), re.S):
            for name in WRITTEN.findall(block):
                if not name.startswith(("~", "/", "$")):
                    path = Path(name)
                    beside = [path.with_name(f"{path.name}.json"), path.with_suffix(".parquet")]
                    yield from (
                        (page.name, one) for one in [path, *(beside if path.suffix == ".csv" else [])]
                    )


def test_written_files_are_ignored():
    if not (ROOT / ".git").exists():
        pytest.skip("not a clone")
    known = set(files())
    assert len(known) >= 6
    for page, path in known:
        command = ["git", "-C", str(ROOT), "check-ignore", "--quiet", "--no-index", str(path)]
        assert subprocess.run(command, check=False).returncode == 0, f"{page}: {path}"


def test_no_file_of_the_repository_is_ignored():
    if not (ROOT / ".git").exists():
        pytest.skip("not a clone")
    command = ["git", "-C", str(ROOT), "ls-files", "--cached", "--ignored", "--exclude-standard"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == ""
