"""Layout files: what a person may write, and what is refused by name."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin.body.layout import File
from skin.body.sheet import Sheet
from skin.errors import InputError
from tests.damage import DAMAGED_FILES, damaged, opened

BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.015}])
FACING = "x_m,y_m,normal_x,normal_y,normal_z\n"
ALONG = "x_m,y_m,direction_x,direction_y,direction_z\n"
MINE = b"""x_m, y_m, depth_m, normal_x, normal_y, normal_z
0.02, 0.03, 0.004, 0, 0, 1
0.08, 0.031, 0.004, 0.5, 0, 1
0.15, 0.12, 0.005, 0, -1, 2
"""


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
        ("x,y_m\n0.1,0.1\n", "no column x_m, found x, y_m"),
        ("x_m,y_m\n0.1,0.1\n0.1,abc\n", "line 3: y_m must be a number in m, got 'abc'"),
        ("x_m,y_m\n0.1,nan\n", "line 2: y_m must be a number in m, got 'nan'"),
        ("x_m,y_m\n0.1,inf\n", "line 2: y_m must be a number"),
        ("x_m,y_m\n0.1\n", "line 2: y_m must be a number in m, got None"),
        ("x_m,y_m,depth_m\n0.1,0.1,\n", "line 2: depth_m must be a number in m, got ''"),
        ("x_m,y_m\n0.1,0.1\n80,40\n", "1 of 2 sensors lie outside.*sensor 2 at x = 80 m.*in metres"),
        ("x_m,y_m,depth_m\n0.1,0.1,0.02\n", "outside the body.*depth = 0.02 m"),
        ("x_m,y_m\n.1,.1\n.05,.1\n.1,.1\n", "sensors 1 and 3 are at one position, x = 0.1 m, y = 0.1 m"),
        ("x_m,y_m,depth_m\n0.1,0.1,0\n0.1,0.1,0.005\n", "sensors 1 and 2 are at one position"),
        ("x_m,y_m,normal_x,normal_z\n.1,.1,0,1\n", "no column normal_y, found x_m, y_m, normal_x, normal_z"),
        (FACING + "0.1,0.1,0,0,1\n0.1,0.05,0,0,0\n", "line 3: a normal of length 0 has no direction"),
        (FACING + "0.1,0.1,1e-300,0,0\n", "a normal of length 0"),
        (FACING + "0.1,0.1,0,up,1\n", "line 2: normal_y must be a number, got 'up'"),
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
