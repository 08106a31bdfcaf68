"""`skin design` as a person runs it."""

import csv
import json

import pytest

SMALL = (
    "design", "body.size=[0.24,0.08]", "body.cells=[24,8]", "layout=grid", "layout.rows=3",
    "layout.columns=3", "design.touches=64",
)  # fmt: skip


@pytest.mark.slow("solves for the posteriors of nine sensors")
def test_the_expected_posterior_of_nine_sensors(run, tmp_path):
    done = run(tmp_path, *SMALL, "simulator=solid", "simulator.divisions=2", "out=x", store=False)
    assert "Expected posterior of a fingertip" in done.stdout
    assert "\u2026" not in done.stdout  # no column is cut off
    assert "bound" not in done.stdout.lower()
    found = json.loads((tmp_path / "x" / "design.json").read_text())
    assert found["sensors"] == 9
    assert found["settings"]["noise_N"] == 0.05
    weak, middle, strong = found["expected"]
    assert [one["force_N"] for one in (weak, middle, strong)] == [1, 5, 20]
    prior = (0.24**2 / 24 + 0.08**2 / 24) ** 0.5  # the root of the mean of both variances
    for name in ("place_m", "place_median_m", "local_precision_m"):
        assert 0 < strong[name] < weak[name] < prior * (1 + 1e-9)
    for findings in (weak, middle, strong):
        assert findings["place_median_m"] < findings["place_90_m"]
        assert findings["place_raised_m"] <= findings["place_m"]
    assert 0 <= strong["blind_share"] < middle["blind_share"] < weak["blind_share"] <= 1
    assert strong["receptive_radius_m"] > weak["receptive_radius_m"]
    assert (tmp_path / "x" / "design.png").stat().st_size > 10_000


def test_a_skin_without_mechanics_has_a_posterior_too(run, tmp_path):
    run(tmp_path, *SMALL, "simulator=naive", "design.touches=32", "out=x", store=False)
    weak, _, strong = json.loads((tmp_path / "x" / "design.json").read_text())["expected"]
    # A touch beside every sensor's cell raises none, however hard it is.
    assert 0.5 < strong["blind_share"] <= weak["blind_share"] < 1


@pytest.mark.slow("solves a sweep of thicknesses and grids")
def test_a_sweep_has_a_line_for_each_thickness_and_grid(run, tmp_path):
    sizes = "design.thicknesses=[0.015,0.03]", "design.grids=[[2,4],[2,6]]", "design.margin=0.02"
    given = "design=sweep", *sizes, "simulator=solid", "simulator.divisions=2"
    run(tmp_path, *SMALL, *given, "out=x", store=False)
    with (tmp_path / "x" / "design_sweep.csv").open(newline="") as file:
        lines = [{name: float(value) for name, value in line.items()} for line in csv.DictReader(file)]
    skins = [(line["thickness_m"], line["columns"]) for line in lines]
    assert skins == [(0.015, 4), (0.015, 6), (0.03, 4), (0.03, 6)]
    assert lines[0]["pitch_m"] == pytest.approx(0.05)
    assert lines[1]["place_m"] < lines[0]["place_m"]
    assert (tmp_path / "x" / "design_sweep.png").is_file()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["design.margin=0.04"], "margin=0.04 m leaves no place on 0.24 x 0.08 m: give less than 0.04"),
        (["design.radii=[0.01,0.002]"], "must be a range [minimum, maximum]"),
        (["device.noise=[0.05,0.2]"], "design.noise="),
        (["design=sweep", "simulator=naive"], "needs a simulator with mechanics: set simulator=solid"),
        (["design=sweep", "design.height=0.02", "simulator=solid"], "design.height=0.02 m is not inside"),
        (["body=arm", "simulator=fem"], "simulator=solid"),
        (["design=placement"], "there is no design=placement: did you mean place?"),
    ],
)
def test_refuses(run, tmp_path, given, words):
    first = [one for one in SMALL if "body=arm" not in given or not one.startswith("body.")]
    done = run(tmp_path, *first, *given, "out=x", store=False, code=2)
    assert words in done.stderr
    assert not (tmp_path / "x").exists()
