"""Layouts: the contract of all, each by itself, and what a file may hold."""

from dataclasses import replace

import numpy as np
import pytest
from hydra.utils import instantiate
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from skin.body.base import Sensors
from skin.body.layout import AbstractLayout, File, Grid, Hexagonal, Random, Scattered
from skin.body.sheet import Sheet
from skin.core.files import CONF
from skin.errors import InputError
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive
from tests.damage import DAMAGED_FILES, damaged, opened

OPTIONS = sorted((CONF / "layout").glob("*.yaml"))


@pytest.fixture(scope="module", params=sorted((CONF / "body").glob("*.yaml")), ids=lambda path: path.stem)
def body(request):
    return instantiate(OmegaConf.load(request.param))


@pytest.mark.parametrize("option", OPTIONS, ids=lambda path: path.stem)
def test_every_layout_places_sensors_in_the_body_from_the_upper_left_rightwards_and_down(option, body):
    layout = instantiate(OmegaConf.load(option))
    assert isinstance(layout, AbstractLayout)
    sensors = layout.sensors(body)
    assert isinstance(sensors, Sensors)
    assert sensors.positions.shape == (len(sensors), 3) == (25, 3)
    assert sensors.footprint == (0.01, 0.01)
    assert ((sensors.positions >= 0) & (sensors.positions <= [*body.size, body.thickness])).all()
    np.testing.assert_allclose(sensors.positions[:, 2], 0.005)
    np.testing.assert_array_equal(sensors.positions, layout.sensors(body).positions)
    x, y = (sensors.positions[:, axis].reshape(5, 5) for axis in (0, 1))
    if option.stem == "random":  # which has no rows
        assert (np.diff(y.ravel()) >= 0).all()
        return
    assert (np.diff(x, axis=1) > 0).all()
    assert (y[1:].min(axis=1) > y[:-1].max(axis=1)).all()


@pytest.mark.parametrize("simulator", [Naive, PlatesAndBeams])
def test_what_feels_no_shear_refuses_tilted_sensors(simulator):
    body = instantiate(OmegaConf.load(CONF / "body" / "sheet.yaml"))
    sensors = Grid(2, 2).sensors(body)
    normals = sensors.normals.copy()
    normals[2] = [0.6, 0.0, 0.8]
    with pytest.raises(InputError, match=r"sensor 3 is tilted or .*simulator=(naive|fem) .*simulator=solid"):
        simulator(body, replace(sensors, normals=normals))
    with pytest.raises(InputError, match=r"sensor 1 .*measures along the surface, .*layout.axes=normal"):
        simulator(body, Grid(2, 2, axes="three").sensors(body))


def test_sensors_stand_in_the_middle_of_equal_tiles():
    positions = Grid(rows=2, columns=4).sensors(OBLONG).positions
    np.testing.assert_allclose(positions[:, 0], [0.02, 0.06, 0.10, 0.14] * 2)
    np.testing.assert_allclose(positions[:, 1], [0.02] * 4 + [0.06] * 4)


def test_neighbours_are_tilted_along_different_axes():
    normals = Grid(rows=3, columns=6, tilt=0.4).sensors(OBLONG).normals.reshape(3, 6, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
    np.testing.assert_allclose(normals[..., 2], np.cos(0.4))
    np.testing.assert_allclose(normals[0, 0], [np.sin(0.4), 0, np.cos(0.4)], atol=1e-15)
    for row in range(2):
        for column in range(5):
            four = normals[row : row + 2, column : column + 2].reshape(4, 3)
            assert len({tuple(np.round(one, 6)) for one in four}) == 4
            np.testing.assert_allclose(four.sum(axis=0)[:2], 0, atol=1e-15)


def test_three_axes_are_three_sensors_at_each_site():
    sensors, sites = Grid(2, 3, tilt=0.3, axes="three").sensors(OBLONG), Grid(2, 3, tilt=0.3).sensors(OBLONG)
    np.testing.assert_array_equal(sensors.positions, sites.positions.repeat(3, axis=0))
    frames = sensors.measured.reshape(-1, 3, 3)
    np.testing.assert_array_equal(frames[:, 2], sites.normals)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (6, 1, 1)), atol=1e-12)


LAYERS = [{"material": "EcoFlex 00-30", "thickness": thickness} for thickness in (0.010, 0.005)]
BODY = Sheet([0.16, 0.16], [32, 32], LAYERS)


def test_the_shipped_file_is_the_layout_of_seed_0():
    shipped = File("data/layouts/jittered_5x5.csv").sensors(BODY)
    np.testing.assert_array_equal(shipped.positions, Scattered(5, 5, 0.25, seed=0).sensors(BODY).positions)


def test_no_sensor_moves_farther_than_the_jitter():
    wide = Sheet([0.30, 0.16], [8, 8], LAYERS)
    pitch = np.array([0.30 / 6, 0.16 / 4])
    scattered = np.stack([Scattered(4, 6, 0.25, seed).sensors(wide).positions for seed in range(20)])
    moves = np.abs(scattered - Grid(4, 6).sensors(wide).positions)[..., :2]
    assert (moves <= 0.25 * pitch + 1e-6).all()
    assert (moves.max(axis=(0, 1)) > 0.24 * pitch).all()


OBLONG = Sheet([0.16, 0.08], [32, 16], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize("seed", range(5))
def test_footprints_neither_overlap_nor_leave_the_surface(seed):
    positions = Random(25, seed, (0.01, 0.008)).sensors(OBLONG).positions[:, :2]
    extent = np.array([0.01, 0.008])
    assert positions.shape == (25, 2)
    assert (positions >= extent / 2 - 1e-6).all()
    assert (positions <= np.array(OBLONG.size) - extent / 2 + 1e-6).all()
    apart = np.abs(positions[:, None] - positions[None]) >= extent
    assert (apart.any(axis=2) | np.eye(25, dtype=bool)).all()


def test_an_inner_sensor_has_six_neighbours_at_equal_distances():
    pitch = 0.02
    body = Sheet([6 * pitch, 5 * pitch * np.sqrt(3) / 2], [12, 10], LAYERS)
    positions = Hexagonal(5, 6).sensors(body).positions[:, :2]
    middle = positions[2 * 6 + 3]
    distances = np.sort(np.linalg.norm(positions - middle, axis=1))[1:8]
    np.testing.assert_allclose(distances[:6], pitch, rtol=1e-9)
    assert distances[6] > 1.5 * pitch


FACING = "x_m,y_m,normal_x,normal_y,normal_z\n"
ALONG = "x_m,y_m,direction_x,direction_y,direction_z\n"
MINE = b"""x_m, y_m, depth_m, normal_x, normal_y, normal_z
0.02, 0.03, 0.004, 0, 0, 1
0.08, 0.031, 0.004, 0.5, 0, 1
0.15, 0.12, 0.005, 0, -1, 2
"""


@pytest.mark.parametrize(
    ("kind", "options", "says"),
    [
        (Grid, {"tilt": -0.1}, "layout.tilt=-0.1 must be greater than or equal to 0"),
        (Grid, {"tilt": np.pi / 2}, "layout.tilt=1.57.* must be less than 1.57"),
        (Grid, {"rows": 0}, "layout.rows=0 must be greater than 0: as in layout.rows=5"),
        (Grid, {"footprint": [0.01, 0]}, "layout.footprint=.* must be greater than 0"),
        (Hexagonal, {"rows": 0}, "layout.rows"),
        (Scattered, {"jitter": -0.1}, "layout.jitter=-0.1 must be .*: as in layout.jitter=0.25"),
        (Scattered, {"jitter": 0.5}, "layout.jitter=0.5 must be .*: as in layout.jitter=0.25"),
        (Random, {"count": 200}, "layout.count"),
        (Random, {"count": 1, "footprint": (0.2, 0.01)}, "layout.count"),
    ],
)
def test_what_no_layout_can_be_is_refused(kind, options, says):
    with pytest.raises(InputError, match=says):
        kind(**options).sensors(OBLONG)


@pytest.fixture
def sensors(tmp_path):
    def read(text: str | bytes):
        path = tmp_path / "layout.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return File(str(path)).sensors(BODY)

    return read


def test_order_numbers_depth_other_columns_and_encodings(sensors):
    """The rows keep their order; columns may come in any, with spaces, a byte order mark, blank lines."""
    read = sensors("\ufeffname, depth_m, y_m, x_m\nb, 0, 0.02, 0.15\n\na, 0.005, 0.01, 0.03\n")
    np.testing.assert_allclose(read.positions, [[0.15, 0.02, 0], [0.03, 0.01, 0.005]])
    read = sensors("sensor,x_m,y_m\n3,0.15,0.02\n1,0.03,0.01\n2,0.1,0.05\n")
    np.testing.assert_array_equal(read.positions[:, 0], [0.03, 0.1, 0.15])
    assert len(sensors("x_m,y_m\n0.1,0.1\n".encode("utf-16"))) == 1


def test_footprints_that_overlap_are_named(sensors):
    with pytest.warns(UserWarning, match=r"sensors 2 and 3 overlap: .* layout.footprint=\[0.01, 0.01\] m"):
        sensors("x_m,y_m\n0.05,0.1\n0.1,0.1\n0.109,0.105\n")
    sensors("x_m,y_m\n0.1,0.1\n0.11,0.1\n")  # side by side


def test_normals_are_made_unit_vectors(sensors):
    """3-4-5 triangles; one that faces outwards stays so."""
    read = sensors(FACING + "0.1,0.1,0.3,0,0.4\n0.05,0.1,0,0,-7\n0.1,0.05,0,-4,3\n")
    np.testing.assert_allclose(read.normals, [[0.6, 0, 0.8], [0, 0, -1], [0, -0.8, 0.6]], atol=1e-15)
    assert read.tilted.tolist() == [True, False, True]


def test_a_relative_path_is_looked_for_here_first(tmp_path, monkeypatch):
    here = tmp_path / "data" / "layouts"
    here.mkdir(parents=True)
    (here / "jittered_5x5.csv").write_text("x_m,y_m\n0.1,0.1\n")
    assert len(File("data/layouts/jittered_5x5.csv").sensors(BODY)) == 25
    monkeypatch.chdir(tmp_path)
    assert len(File("data/layouts/jittered_5x5.csv").sensors(BODY)) == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no column x_m and y_m, found nothing"),
        ('x_m,"y\nm"\n0.1,0.1\n', "no column y_m, found x_m, y m"),
        ("x_m;y_m\n0,04;0,013\n", "semicolons between its columns: save it with commas, and 0.04 for 0,04"),
        ("x_m,y_m\n", "no sensor below the header"),
        ("x_m,y_m\n0.1,0.1\n0.1,abc\n", "line 3: y_m must be a number in m, got 'abc'"),
        ("x_m,y_m\n0.1,nan\n", "line 2: y_m must be a number in m, got 'nan'"),
        ("x_m,y_m,depth_m\n0.1,0.1,\n", "line 2: depth_m must be a number in m, got ''"),
        ("x_m,y_m\n0.1,0.1\n80,40\n", "1 of 2 sensors lie outside.*sensor 2 at x = 80 m.*in metres"),
        ("x_m,y_m,depth_m\n0.1,0.1,0.02\n", "outside the body.*depth = 0.02 m"),
        ("x_m,y_m\n.1,.1\n.05,.1\n.1,.1\n", "sensors 1 and 3 are at one position, x = 0.1 m, y = 0.1 m"),
        ("x_m,y_m,depth_m\n0.1,0.1,0\n0.1,0.1,0.005\n", "sensors 1 and 2 are at one position"),
        ("x_m,y_m,normal_x,normal_z\n.1,.1,0,1\n", "no column normal_y, found x_m, y_m, normal_x, normal_z"),
        (FACING + "0.1,0.1,0,0,1\n0.1,0.05,0,0,0\n", "line 3: a normal of length 0 has no direction"),
        ("x_m,y_m,x_m\n0.1,0.1,0.2\n", "the column x_m is there twice"),
        (ALONG + ".1,.1,1,0,0\n" * 2 + ".1,.1,0,0,2\n", "direction of sensor 3 has length 2, but must be"),
        (ALONG + "0.1,0.1,1,0,0\n0.1,0.1,0,0,1\n", "of three axes has three rows.*; got 2 rows"),
        (ALONG + "0.1,0.1,1,0,0\n" * 2 + "0.1,0.1,0,0,1\n", "at right angles, .*got 3 rows with"),
        (b"x_m,y_m\n\xff\xfe,0.1\n", "cannot read the layout"),
        ("x_m,y_m\n40,13\n120,80\n", "2 of 2 sensors lie outside .*: in mm\\? positions are in metres"),
        ("x_m,y_m\n0.04,0.013\n0.3,0.08\n", "m thick: positions are in metres"),
        ("sensor,x_m,y_m\n1,0.1,0.1\n1,0.05,0.1\n", "the column sensor must number the sensors, each once"),
        ("sensor,x_m,y_m\n1,0.1,0.1\n3,0.05,0.1\n", "each once and without a gap"),
        ("sensor,x_m,y_m\nleft,0.1,0.1\n", "line 2: sensor must be a number, got 'left'"),
    ],
)
def test_what_is_no_layout_is_refused_by_name(sensors, text, says):
    with pytest.raises(InputError, match=says):
        sensors(text)


@pytest.mark.parametrize("path", ["nowhere.csv", "/", "data/layouts"])
def test_a_missing_file_is_refused_with_where_it_was_looked_for(path):
    with pytest.raises(InputError, match=r"no layout file .*: looked for .*layout.path=FILE.csv"):
        File(path)


@DAMAGED_FILES
@given(data=st.data())
def test_every_file_works_or_is_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.csv"
    path.write_bytes(data.draw(damaged(MINE)))
    read = opened(lambda: File(str(path)).sensors(BODY))
    assert read is None or (np.isfinite(read.positions).all() and np.isfinite(read.normals).all())


def test_more_sensors_than_any_skin_has_are_refused_before_they_take_memory(sensors):
    rows = "".join(f"{0.00001 * number},0.1\n" for number in range(10_001))
    with pytest.raises(InputError, match="it has more than 10000 sensors"):
        sensors(f"x_m,y_m\n{rows}")
    with pytest.raises(InputError, match="it has more than 4194304 bytes"):
        sensors("x_m,y_m\n" + "0.1,0.1\n" * 600_000)
    rows = "".join(f"{0.00001 * number},0.1\n" for number in range(10_000))
    with pytest.warns(UserWarning, match="overlap"):
        assert len(sensors("x_m,y_m\n" + rows)) == 10_000
