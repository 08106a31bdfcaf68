"""Bad input of any verb ends with code 2 and one sentence, and nothing is written."""

import pytest

PORT = "device.port=/dev/ttyACM77"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("animate", "add out=touch.gif"),
        ("animate out=x.gif touch=fingertips labels=[big]", "fingertips cannot be drawn to be big"),
        ("animate out=x.mp4", "out=x.mp4 must be a .gif file or a .png file: add out=touch.gif"),
        ("calibrate", "which session?"),
        ("calibrate session=none.csv", "cannot read the session none.csv: "),
        ("check weight=0 layout=grid simulator=naive", "is no known load: give a mass in kg, up to 50"),
        ("convert", "skin convert needs from= or reader=, and out=, as in from=map.yaml out=x.parquet"),
        ("convert from=map.yaml out=x.txt", "out=x.txt must be a .parquet file or a .csv file or a .mcap"),
        ("convert from=none.yaml out=x.csv", "cannot read the mapping none.yaml"),
        ("convert from=efles out=x.csv", "from=efles is no format: give map.yaml, or one of folder, sdu"),
        ("convert from=sdu out=x.csv", "from=sdu needs path=FOLDER"),
        ("design out=x simulator=naive layout=grid layout.axes=three", "set simulator=solid, or layout.tilt"),
        ("export name=small", "only a folder takes name and licence: add format=folder, or leave them out"),
        ("export format=c out=x.onnx", "out=x.onnx must be a .h file: add out=skin.h"),
        ("generate n=-1", "n=-1 is below 0: give a number above 0"),
        ("generate n=32 out=x.csv touch.shapes=[potato]", "no shape potato"),
        ("generate n=16 out=x.parquet touch=fingertips touch.force=50", "touch.force=50 N is more than"),
        (f"listen {PORT}", "no port /dev/ttyACM77"),
        ("live demo=true run=none", "no finished training run none"),
        ("live demo=true device=serial", "leave out device=serial, or demo=true"),
        ("live +live.patience.alarms=0.1", "live.patience has no setting alarms: did you mean alarm"),
        *((f"{verb} seconds=-1", "seconds=-1 is below") for verb in ("live", "record", "listen", "emulate")),
        ("record", "out=None must be a folder: add out=session"),
        ("setup", "device.port is missing: add device.port=/dev/ttyACM0"),
    ],
)
def test_bad_input_ends_with_a_sentence(run, tmp_path, words, message):
    verb, *settings = words.split()
    done = run(tmp_path, verb, *settings, store=verb in ("live", "export", "train"), code=2)
    assert message in done.stderr
    assert (done.stdout, done.stderr.count("\n")) == ("", 1)
    assert not {path.suffix for path in tmp_path.iterdir()} - {".db"}
