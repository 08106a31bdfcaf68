"""A mistyped override is answered with what to type."""

import pytest

from skin.commands.train import main


@pytest.fixture
def refused(capsys, monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def refuse(*words):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 2
        return capsys.readouterr().err

    return refuse


@pytest.mark.parametrize(
    ("word", "answer"),
    [
        ("simulater=solid", "there is no setting or group simulater: did you mean simulator?"),
        ("device.nois=3", "there is no setting or group device.nois: did you mean device.noise?"),
        ("model.widths=[3]", "group model.widths, but model=gcn has it"),
        ("simulator=solit", "there is no simulator=solit: did you mean solid? There are fem, naive, solid"),
        ("seed=[", "seed=["),
        ("out=bench (1).csv", "out=bench (1).csv cannot be read as an override, quote its value"),
        ("data.name=a,b", "Ambiguous value for argument 'data.name=a,b'"),
        ("qqqq=3", "there is no setting or group qqqq: --help lists them"),
        ("trainer.qqqq=3", "Could not override 'trainer.qqqq'"),  # of Hydra: with + it reaches the class
    ],
)
def test_the_answer_names_what_was_meant(word, answer, refused):
    error = refused(word)
    assert answer in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize("shown", ["job", "hydra"])
def test_a_password_is_not_in_the_configuration(shown, capsys):
    main(["tracking.uri='postgresql+pg8000://me:ge/heim@h/runs'", "--cfg", shown])
    text = capsys.readouterr().out
    assert "postgresql+pg8000://me:***@h/runs" in text
    assert "heim" not in text


def test_an_option_may_stand_between_overrides(tmp_path, capsys):
    (tmp_path / "body").mkdir()
    (tmp_path / "body/mine.yaml").write_text("size: [0.3, 0.2]\n")
    main(["device.seed=5", "--config-dir", str(tmp_path), "body=mine", "--cfg", "job"])
    shown = capsys.readouterr().out
    assert "- 0.3\n" in shown
    assert "  seed: 5\n" in shown


def test_a_file_that_is_not_yaml_is_refused_with_the_line(tmp_path, refused):
    (tmp_path / "body").mkdir()
    (tmp_path / "body/mine.yaml").write_text("size: [0.3, 0.2\ncells: 3\n")
    error = refused("--config-dir", str(tmp_path), "body=mine")
    assert "line 2" in error
    assert len(error.splitlines()) == 1


def test_an_option_that_does_not_exist_is_named_in_short(refused):
    usage, error = refused("seed=5", "--confg-dir", "x", "body=mine").splitlines()
    assert usage.startswith("usage: skin VERB ")
    assert "--confg-dir" in error
