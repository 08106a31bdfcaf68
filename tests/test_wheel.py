"""The wheel has all that ``skin`` needs, and runs where the repository is not on the path."""

import os
import subprocess
import sys
import sysconfig
import zipfile

import pytest

from skin.__main__ import verbs
from skin.core.files import ROOT

SMALL = ["data.gestures=48", "device.test_gestures=48", "evaluation.safe_gestures=64"]
SMALL += ["evaluation.devices=0", "evaluation.layouts=0"]


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    built, folder = tmp_path_factory.mktemp("built"), tmp_path_factory.mktemp("unpacked")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(built)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=60)
    (wheel,) = built.iterdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


@pytest.fixture
def installed(unpacked, tmp_path):
    """Return a function that runs Python in an empty folder, with the wheel and its libraries on the path."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment["PYTHONPATH"] = os.pathsep.join([str(unpacked), sysconfig.get_path("purelib")])

    def run(*arguments):
        # -S, because a .pth file of an editable installation would lead to the repository.
        command = [sys.executable, "-S", *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_the_wheel_has_the_package_and_its_files(unpacked):
    package, metadata = sorted(unpacked.iterdir())
    assert (package.name, metadata.suffix) == ("skin", ".dist-info")
    assert "skin = skin.__main__:main" in (metadata / "entry_points.txt").read_text()
    for folder in ("skin", "conf", "models", "data/shapes", "data/layouts"):
        inside = folder if folder != "skin" else ""
        paths = [path for path in (ROOT / folder).rglob("*") if path.is_file() and path.suffix != ".pyc"]
        assert paths
        for path in paths:
            name = path.relative_to(ROOT / folder)
            assert (package / inside / name).read_bytes() == path.read_bytes(), path
    assert (package / "py.typed").exists()
    assert (package / "live" / "page.html").exists()


def test_the_repository_is_not_on_the_path(installed, unpacked):
    code = "import sys, skin, skin.core.files as f; print(skin.__file__, f.CONF, *sys.path, sep='\\n')"
    file, conf, *path = installed("-c", code).splitlines()
    assert file == str(unpacked / "skin" / "__init__.py")
    assert conf == str(unpacked / "skin" / "conf")
    assert str(ROOT) not in path


def test_verbs_show_their_help(installed):
    lines = installed("-m", "skin", "--help").splitlines()
    shown = {line.split()[0] for line in lines if line.startswith("  ")}
    for verb, module in verbs().items():
        assert (verb in shown) == module.startswith("skin."), verb
    assert "port: pty" in installed("-m", "skin", "emulate", "--help")


@pytest.mark.slow("trains from an installed wheel")
def test_a_training_leaves_its_results_in_the_current_folder(installed, unpacked, tmp_path):
    before = {path for path in unpacked.rglob("*") if path.suffix not in (".pyc", "")}
    said = installed("-m", "skin", "train", "experiment=rules", "simulator=naive", *SMALL)
    assert "overall/accuracy" in said
    assert {"mlflow.db", "mlartifacts"} <= {path.name for path in tmp_path.iterdir()}
    assert {path for path in unpacked.rglob("*") if path.suffix not in (".pyc", "")} == before
