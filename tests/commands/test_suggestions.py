"""A mistyped override is answered with what to type."""

import shlex
from importlib.util import find_spec

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from skin.commands._command import quote_value
from skin.commands.train import main


@pytest.fixture
def refused(capsys, monkeypatch):
    """Return a function that returns the sentence with which words are refused."""
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
        ("touch.rat=3", "there is no setting or group touch.rat: did you mean touch.rate?"),
        ("model.widht=3", "group model.widht: did you mean model.width, which model=pyg has?"),
        ("model.widths=[3]", "group model.widths, but model=gcn has it"),
        ("simulator=solit", "there is no simulator=solit: did you mean solid? There are fem, naive, solid"),
        ("simulator=xyz", "there is no simulator=xyz: there are fem, naive, solid\n"),
        (
            "out=bench (1).csv",
            """out=bench (1).csv cannot be read: quote the value, as in 'out="bench (1).csv"'""",
        ),
        ("device.path=a=b.csv", """a=b.csv cannot be read: quote the value, as in 'device.path="a=b.csv"'"""),
        ("qqqq=3", "Could not override 'qqqq'"),  # of Hydra: nothing is near
        ("data.name=a,b", """data.name=a,b cannot be read: quote the value, as in 'data.name="a,b"'"""),
    ],
)
def test_the_answer_names_what_was_meant(word, answer, refused):
    error = refused(word)
    assert answer in error
    assert len(error.splitlines()) == 1


@pytest.mark.skipif(find_spec("hydra_plugins.hydra_optuna_sweeper") is not None, reason="it is installed")
def test_an_option_of_a_plugin_is_told_how_to_install(refused):
    assert 'pip install "tactile-skin[optuna]" adds it' in refused("-m", "hydra/sweeper=optuna")


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


@pytest.mark.parametrize(
    "value", ["bench (1).csv", "it's.csv", 'a "b".csv', "a,b.csv", "x=y.csv", "(a", "ü {1}.csv"]
)
def test_the_quoted_form_has_the_same_value(value):
    (word,) = shlex.split(quote_value(f"device.path={value}"))
    override = OverridesParser.create().parse_override(word)
    assert (override.key_or_group, override.value()) == ("device.path", value)


def test_what_quotes_do_not_mend_has_no_suggestion():
    assert quote_value("out") is None
    assert quote_value("a b=c") is None
