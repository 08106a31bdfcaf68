"""experiments/embeddings.py as a person runs it."""

import pytest

SMALL = ["simulator=naive", "data.gestures=160", "device.test_gestures=32", "evaluation.devices=1",
         "evaluation.layouts=1", "evaluation.safe_gestures=64", "evaluation.gestures=32"]  # fmt: skip
FEW = ["embeddings.train=80", "embeddings.test=40", "embeddings.seeds=[0]", "embeddings.epochs=2",
       "embeddings.layouts=2", "embeddings.attributes=[reading]"]  # fmt: skip


@pytest.mark.slow
def test_a_run_is_probed_beside_graph_embeddings(run, tmp_path):
    trained = run(tmp_path, "train.py", "experiment=temporal_graph", "trainer.max_epochs=1", *SMALL)
    assert trained.returncode == 0, trained.stderr
    done = run(tmp_path, "embeddings.py", "simulator=naive", "run=latest", "out=new", *FEW)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "new" / "embeddings.md").read_text()
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "embeddings.md",
        "figure05_embeddings.png",
    ]
    rows = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")]
    assert rows == ["input", "Graph2Vec, reading",
                    "GL2Vec, reading", "IGE, reading", "trained encoder", "readings, one frame",
                    "readings, window"]  # fmt: skip
    assert text.count("**undecided**") == 3  # one seed decides nothing
    assert text in done.stdout


def test_bad_input_ends_with_a_sentence(run, tmp_path):
    done = run(tmp_path, "embeddings.py", "out=new", "embeddings.typo=1")
    assert done.returncode == 2, done.stderr
    assert "typo" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "new").exists()
