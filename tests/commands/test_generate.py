"""`skin generate` as a person runs it."""

from skin.device.files import read_recording

NAIVE = ("generate", "simulator=naive")
ONE_SIZE = ("touch.shapes=[disc,bar]", "touch.stretch=1", "touch.big_area=[0.45,0.7]")


def test_writes_a_recording(run, tmp_path):
    done = run(tmp_path, *NAIVE, "n=32", "out=x.parquet", store=False, apart=True)
    assert "x.parquet: 32 gestures" in done.stdout
    recording = read_recording(tmp_path / "x.parquet")
    assert len(recording) == 32
    assert recording.metadata["config"]["data"]["gestures"] == 32
    assert len(recording.metadata["config_hash"]) >= 16


def test_a_folder_becomes_a_data_set_to_train_on(run, tmp_path):
    done = run(tmp_path, *NAIVE, "n=48", "out=touches", store=False)
    assert "touches: 48 gestures in 1 shards, " in done.stdout
    train = ["device=recording", "device.path=touches", "representation=readings", "model=mlp"]
    done = run(tmp_path, "train", *train, "trainer.max_epochs=1")
    assert "holdout" in done.stdout
    shard = tmp_path / "touches" / "shards" / "00000.parquet"
    shard.write_bytes(shard.read_bytes()[:-100])
    for done in (
        run(tmp_path, "train", *train, "trainer.max_epochs=3", code=2),
        run(tmp_path, *NAIVE, "n=48", "out=touches", store=False, code=2),
    ):
        assert "00000.parquet is damaged" in done.stderr
        assert "delete it, and repeat the skin generate" in done.stderr


def test_warns_where_a_shape_is_the_label(run, tmp_path):
    """Bars have no room as big touches unless they are stretched."""
    done = run(tmp_path, *NAIVE, "n=160", "out=x.csv", *ONE_SIZE, store=False)
    assert "warning: the shape alone predicts big (" in done.stderr
