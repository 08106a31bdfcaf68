"""experiments/generate.py as a person runs it."""

import pytest

from skin.storage import read

NAIVE = ("generate.py", "simulator=naive")


def test_writes_a_recording(run, tmp_path):
    done = run(tmp_path, *NAIVE, "n=32", "out=x.csv", store=False, fresh=True)
    assert done.returncode == 0, done.stderr
    assert "x.csv: 32 gestures" in done.stdout
    recording = read(tmp_path / "x.csv")
    assert len(recording) == 32
    assert recording.metadata["config"]["data"]["gestures"] == 32
    assert len(recording.metadata["config_hash"]) >= 16


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["n=32"], "add out=touches.parquet"),
        (["n=32", "out=x.txt"], "got x.txt"),
        (["n=32", "out=x.csv", "touch.shapes=[potato]"], "no shape potato"),
    ],
)
def test_bad_input_ends_with_a_sentence(run, tmp_path, overrides, message):
    done = run(tmp_path, *NAIVE, *overrides, store=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("x.*"))
