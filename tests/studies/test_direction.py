"""The comparison of skins for the direction of sliding."""

import pytest

from skin.errors import InputError
from studies.direction import Line, comparison, publish
from studies.settings import DirectionSettings

GIVEN = {"rows": ["gru"], "seeds": [0, 1, 2], "shear": 0.5, "tilted": "x.csv"}


def line(skin: str, *degrees: float) -> Line:
    seeds = {str(seed): value for seed, value in enumerate(degrees)}
    shares = dict.fromkeys(seeds, 0.5)
    return Line(
        "gru", skin, {"direction/degrees": seeds, "direction/accuracy": shares, "overall/accuracy": shares}
    )


def test_fewer_degrees_are_better_beyond_two_standard_errors():
    lines = [line("a", 50, 51, 52), line("b", 40, 42, 41), line("c", 50, 60, 49), line("d", 60, 61, 62.5)]
    told = comparison(lines)
    assert [one["verdict"] for one in told] == ["", "better", "undecided", "worse"]
    assert told[1]["difference"] == "-10.0 ± 0.6"
    assert told[0]["degrees"] == "51.0 ± 1.0"
    assert told[0]["within 45"] == "50.0 ± 0.0"


def test_a_single_seed_decides_nothing():
    assert [one["verdict"] for one in comparison([line("a", 50), line("b", 20)])] == ["", "undecided"]


def test_it_is_written_whole(tmp_path, capsys):
    told = comparison([line("a", 50, 51, 52), line("b", 40, 42, 41)])
    publish(tmp_path, told)
    assert "| gru | b | 41.0 ± 1.0 |" in (tmp_path / "direction.md").read_text()
    assert len((tmp_path / "direction.csv").read_text().splitlines()) == 3
    assert "better" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "wrong"), [("rows", []), ("seeds", 3), ("shear", 0.0)])
def test_what_compares_nothing_is_refused(name, wrong):
    with pytest.raises(InputError, match=rf"direction.{name} must"):
        DirectionSettings(**GIVEN | {name: wrong})


def test_skins_differ_by_friction_and_then_by_layout():
    skins = DirectionSettings(**GIVEN).skins
    assert skins["upright"] == []
    assert skins["upright_shear"] == ["touch.shear=0.5"]
    assert skins["tilted_shear"] == ["touch.shear=0.5", "layout=file", "layout.path=x.csv"]
