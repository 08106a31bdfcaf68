"""The comparison of placements as a person runs it."""

import csv
import sys

import pytest

from experiments import peers

SMALL = (
    "design=comparison",
    "simulator=naive",
    "design.touches=100",
    "body.size=[0.08,0.08]",
    "body.cells=[8,8]",
)


@pytest.fixture
def compared(run, tmp_path, monkeypatch):
    """Return a function that runs the command with a Python of the peers."""

    def compare(python, *words):
        monkeypatch.setenv(peers.PYTHON, str(python))
        folder = ["--config-dir", str(peers.CONF)]
        return run(tmp_path, "design", *folder, *SMALL, *words, "out=found", store=False)

    return compare


def lines(folder):
    with (folder / "found" / "placement.csv").open() as file:
        return list(csv.DictReader(file))


def test_without_its_environment_pysensors_is_left_out(compared, tmp_path):
    done = compared(tmp_path / "none", "design.cases=[[0.12,0.08,6],[0.08,0.08,7]]")
    assert done.returncode == 0, done.stderr
    assert f"left out PySensors, because there is no {tmp_path / 'none'}: make peers builds it" in done.stderr
    found = lines(tmp_path)
    # No grid of seven has tiles near squares.
    methods = ["placed", "grid", "best_of_random", "placed", "best_of_random"]
    assert [one["method"] for one in found] == methods
    assert [one["sheet"] for one in found] == 3 * ["120 x 80 mm"] + 2 * ["80 x 80 mm"]
    for one in found:
        information, bound = float(one["information_nats"]), float(one["bound_nats"])
        assert 0 < information < bound
        assert float(one["share_of_bound"]) == pytest.approx(information / bound, rel=1e-3)
    placed, grid, drawn = (float(one["information_nats"]) for one in found[:3])
    assert placed > max(grid, drawn)
    # The sites of 10 mm cells, and the middles of six tiles of 40 mm.
    assert [float(one["nearest_m"]) for one in found[:2]] == [pytest.approx(0.02, abs=0.009), 0.04]
    assert min(float(one["nearest_m"]) for one in found if one["method"] != "grid") >= 0.012


def test_an_older_environment_without_pysensors_is_refused(compared, tmp_path):
    done = compared(sys.executable, "design.cases=[[0.08,0.08,4]]")
    assert done.returncode == 2
    assert "has no PySensors" in done.stderr
    assert "make peers installs it" in done.stderr
    assert not (tmp_path / "found").exists()


@pytest.mark.skipif(not peers.python().is_file(), reason="no .venv-peers: make peers builds it")
def test_pysensors_places_from_the_same_readings(compared, tmp_path):
    done = compared(peers.python(), "design.cases=[[0.08,0.08,4]]")
    assert done.returncode == 0, done.stderr
    information = {one["method"]: float(one["information_nats"]) for one in lines(tmp_path)}
    for method in ("pysensors_qr", "pysensors_gqr"):
        assert 0.9 * information["placed"] < information[method] <= information["placed"] + 0.01


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["design.cases=[[0.08,0.08,500]]"], "needs 500 sites, and there are 64"),
        (["design.cases=[[0.08,0.08]]"], "design.cases"),
        (["design.cases=[]"], "design.cases"),
        (["device.noise=0"], "design.noise=0"),
    ],
)
def test_bad_input_is_a_sentence(compared, tmp_path, words, reason):
    done = compared(tmp_path / "none", *words)
    assert done.returncode == 2
    assert reason in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "found").exists()
