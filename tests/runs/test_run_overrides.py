"""A run's configuration changes only in what the command line names."""

import numpy as np
import pytest
from hydra import initialize_config_dir
from hydra.utils import instantiate

from skin.body.base import Arm, Layer, Sheet
from skin.body.layout import File, Grid, Random
from skin.body.material import Material, Relaxation
from skin.core.files import CONF
from skin.errors import InputError
from skin.runs.build import build_device, build_skin, with_axes_of, with_skin
from skin.runs.configuration import Config, recompose, settings_of

SEQUENCE = ("experiment=sequence_graph", "simulator=naive", "device.offset=0.3", "seed=4")
OWN = """\
# @package _global_
defaults:
  - override /simulator: solid
body:
  _target_: skin.body.base.Sheet
  _convert_: all
  size: [0.30, 0.10]
  cells: [30, 20]
  layers: [{material: EcoFlex 00-30, thickness: 0.004}]
layout: {path: mine.csv, footprint: [0.008, 0.008]}
touch: {spare: 0.005}
"""


@pytest.fixture
def bring_back(configured):
    """Return a function from overrides of a training and of a command to the settings of the run then."""

    def bring_back(trained, *overrides):
        run = configured(*trained)
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return settings_of(recompose(run, overrides))

    return bring_back


def test_only_what_is_named_changes(bring_back, configured):
    run = settings_of(configured(*SEQUENCE))
    assert bring_back(SEQUENCE, "run=latest") == run
    back = bring_back(SEQUENCE, "device.seed=7")
    assert (back["device"].pop("seed"), run["device"].pop("seed")) == (7, 0)
    assert back == run


@pytest.mark.parametrize(
    ("trained", "override", "part", "expected"),
    [
        ((), "simulator=naive", "simulator", "skin.mechanics.simulator.naive.Naive"),
        (("data.gestures=60", "device.gestures=50"), "data.gestures=99", "gestures", 50),
        (("data.gestures=60",), "data.gestures=99", "gestures", 99),
        (("device.offset=0.3",), "profile=mild", "offset", 0.3),
        (("device.noise=0.3",), "profile=mild", "noise", 0.05),
    ],
)
def test_the_device_has_what_was_named_for_it_or_its_own(bring_back, trained, override, part, expected):
    found = bring_back(trained, override)["device"][part]
    assert (found["_target_"] if part == "simulator" else found) == expected


def test_another_device_replaces_the_whole_group(bring_back):
    back = bring_back((), "device=recording", "device.path=x.parquet")["device"]
    assert (back["path"], back["_target_"]) == ("x.parquet", "skin.device.recording.Recorded")
    assert "offset" not in back


@pytest.mark.parametrize("override", ["seed=1", "experiment=rules", "model.dropout=0", "learner.hidden=[8]"])
def test_what_the_weights_depend_on_is_refused_by_name(bring_back, override):
    with pytest.raises(InputError, match=override.split("=")[0].replace(".", r"\.")):
        bring_back((), override)


@pytest.fixture
def with_option(bring_back, tmp_path):
    """Return a function that chooses ``body=mine``, a file of a user's skin, as ``--config-dir`` names it."""
    (tmp_path / "body").mkdir()

    def with_option(trained, *overrides, text=OWN, body="mine"):
        (tmp_path / "body" / "mine.yaml").write_text(text)
        return bring_back(trained, f"hydra.searchpath=[{tmp_path}]", f"body={body}", *overrides)

    return with_option


@pytest.mark.parametrize("layout", ["file", "grid"])
def test_all_that_a_chosen_option_sets_is_taken(with_option, layout):
    back = with_option((f"layout={layout}", "device.offset=0.3"))
    assert back["body"]["size"] == [0.30, 0.10]
    assert back["layout"]["_target_"] == "skin.body.layout.File"
    assert (back["layout"]["path"], back["layout"]["footprint"]) == ("mine.csv", [0.008, 0.008])
    targets = [part["simulator"]["_target_"] for part in (back, back["device"])]
    assert targets == ["skin.mechanics.simulator.solid.Solid"] * 2
    assert back["touch"]["spare"] == back["device"]["touch"]["spare"] == 0.005
    # The command line takes precedence.
    other = with_option((), "layout.path=other.csv", "simulator=naive")
    assert (other["layout"]["path"], other["simulator"]["_target_"][-5:]) == ("other.csv", "Naive")
    # What the option does not set stays that of the run.
    assert (back["device"]["offset"], back["data"]["name"]) == (0.3, "fem")


def test_a_setting_equal_to_the_default_is_taken_too(with_option):
    text = OWN.replace("0.008, 0.008", "0.010, 0.010")
    assert with_option(("layout.footprint=[0.02,0.02]",), text=text)["layout"]["footprint"] == [0.01, 0.01]


def test_an_included_file_is_taken_too(with_option, tmp_path):
    text = "# @package _global_\ndefaults: [mine]\nbody: {size: [0.4, 0.1]}\n"
    (tmp_path / "body" / "long.yaml").write_text(text)
    back = with_option((), body="long")
    assert (back["body"]["size"], back["layout"]["path"]) == ([0.4, 0.1], "mine.csv")


def test_an_option_cannot_change_what_the_weights_depend_on_nor_what_has_no_effect(with_option):
    text = f"{OWN}trainer: {{gradient_clip_val: 1.0}}\n"
    with pytest.raises(InputError, match=r"trainer\.gradient_clip_val was fixed"):
        with_option((), text=text)
    assert with_option(("+trainer.gradient_clip_val=1.0",), text=text)["layout"]["path"] == "mine.csv"
    back = with_option(("evaluation.devices=7",), text=f"{OWN}evaluation: {{devices: 3}}\n")
    assert back["evaluation"]["devices"] == 7


def test_a_run_of_normal_sensors_takes_those_inwards_of_three_axes(configured, tmp_path):
    trained, three = configured("layout=grid"), configured("layout=grid", "layout.axes=three")
    assert with_axes_of(trained, three) == trained
    assert with_axes_of(three, three) is three
    with pytest.raises(InputError, match="trained on sensors of three axes, the layout has one"):
        with_axes_of(three, trained)
    columns = ["x_m,y_m,direction_x,direction_y,direction_z"]
    rows = [f"0.05,{y},{axis}" for y in (0.03, 0.06) for axis in ("1,0,0", "0,1,0", "0,0,1")]
    path = tmp_path / "three.csv"
    path.write_text("\n".join(columns + rows))
    words = ("layout=file", f"layout.path={path}", "device=serial", "device.port=/dev/x")
    used = with_axes_of(trained, configured(*words))
    assert (build_skin(used).sensors.positions[:, 1].tolist(), used.device["inwards"]) == ([0.03, 0.06], True)
    assert build_device(used).wire.three is not None


LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.01},
    Layer(Material("gel", 4e4, 0.49, Relaxation(0.5, 0.3)), 0.004),
]
BODIES = Sheet((0.2, 0.1), (20, 10), LAYERS), Arm((20, 10), LAYERS, radius=0.05, length=0.1, angle=2.0)


@pytest.mark.parametrize("body", BODIES, ids=["sheet", "arm"])
@pytest.mark.parametrize(
    "layout", [Grid(2, 3, (0.008, 0.006), tilt=0.3), Random(5, 1), File("data/layouts/tilted_5x5.csv")]
)
def test_the_settings_build_the_same_skin(body, layout):
    if isinstance(layout, File):
        body = Sheet((0.16, 0.16), (16, 16), LAYERS)
    config = with_skin(Config(seed=1), body, layout)
    assert config.seed == 1
    assert instantiate(config.body) == body
    sensors, expected = instantiate(config.layout).sensors(body), layout.sensors(body)
    np.testing.assert_allclose(sensors.positions, expected.positions)
    np.testing.assert_allclose(sensors.normals, expected.normals)
    assert sensors.footprint == expected.footprint


def test_names_and_files_are_options():
    config = with_skin(Config(), "arm", "sensors.csv")
    assert config.body["_target_"] == "skin.body.arm.Arm"
    assert config.layout == {
        "_target_": "skin.body.layout.File", "_convert_": "all", "path": "sensors.csv",
        "footprint": [0.01, 0.01], "depth": None,
    }  # fmt: skip
    assert with_skin(Config(seed=1), None, None) == Config(seed=1)
