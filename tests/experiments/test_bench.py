"""The benchmark measures what it says, in a form that others can read."""

import pytest

from experiments.benchmarks import main, run_alone


@pytest.mark.slow("measures the generation of data")
def test_generation_and_operators_are_timed_with_an_empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))
    assert run_alone("operator.fem", 1)["build_seconds"] > 0.02
    assert not list(tmp_path.iterdir())
    assert run_alone("generation.fem", 1)["gestures_per_second"] > 100


@pytest.mark.parametrize(
    ("words", "reason"),
    [("--repeats 1", "choose from 3"), ("--repeat x", "invalid int"), ("--only page", "'generation.fem'")],
)
def test_a_bad_setting_is_refused(words, reason, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    assert reason in capsys.readouterr().err
