"""Animations show the touch in its frame; figures show the numbers that they were given."""

import numpy as np
import pytest
import torch
from PIL import Image

from skin.errors import InputError
from skin.plot.animation import VIEWS, read_scene, simulate_scene, thinning, write_animation
from skin.plot.figures import confusions, images, save_figure, traces
from skin.plot.plot3d import Scene
from skin.runs.build import build_device


def made(frames=6, sensors=7, rate=10.0, **more):
    """Return a scene in which sensor 0 is pressed in frame 2."""
    readings = np.zeros((frames, sensors))
    readings[2, 0] = 3.0
    sites = np.random.default_rng(0).uniform(0.01, 0.09, (sensors, 3)) * (1, 0.6, 0)
    positions = np.broadcast_to(sites, (frames, sensors, 3))
    return Scene(readings, positions, (0.1, 0.06), rate, "a touch", **more)


def frames_of(path):
    """Return every frame of a GIF, (T, H, W, 3), and how long one is shown, s."""
    with Image.open(path) as file:
        shown = []
        for number in range(file.n_frames):
            file.seek(number)
            shown.append(np.asarray(file.convert("RGB")))
        return np.stack(shown).astype(int), file.info["duration"] / 1e3


@pytest.mark.parametrize("view", VIEWS)
def test_every_view_shows_the_touch_in_its_frame(view, tmp_path):
    moved = np.zeros((6, 5, 7))
    moved[2, 2, 3] = 0.002
    path = write_animation(made(moved=moved), view, tmp_path / "new" / "x.gif")
    assert [one.name for one in path.parent.iterdir()] == ["x.gif"]
    shown, seconds = frames_of(path)
    assert len(shown) == 6
    assert seconds == pytest.approx(0.1)
    left = shown[:, :, : shown.shape[2] // 2]
    changed = [(np.abs(one - left[0]).max(axis=-1) > 60).sum() for one in left]
    # only the time's line may move in the other frames, and it is on the right
    assert changed[2] > 30
    assert max(changed[number] for number in (1, 3, 4, 5)) < changed[2] / 5


def test_the_pressure_is_shown_where_it_is(tmp_path):
    pressure = np.zeros((6, 6, 10))
    pressure[2, :3, 5:] = 50e3  # the upper right corner of the sheet
    shown, _ = frames_of(write_animation(made(pressure=pressure), "flat", tmp_path / "x.gif"))
    rows, columns = np.nonzero(np.abs(shown[2] - shown[1]).max(axis=-1) > 60)
    picture = columns < shown.shape[2] * 0.45
    assert rows[picture].mean() < 0.4 * shown.shape[1]
    assert columns[picture].mean() > 0.22 * shown.shape[2]


def test_long_and_fast_touches_are_thinned_out(tmp_path):
    scene = made(frames=7, sensors=2, rate=50.0)
    shown, seconds = frames_of(write_animation(scene, "flat", tmp_path / "x.gif"))
    assert len(shown) == 4
    assert seconds == pytest.approx(0.04)
    # the corpus of social touch: up to 1747 frames at 135 Hz
    touches = (30, 10.0), (100, 25.0), (101, 10.0), (1747, 135.0)
    assert [thinning(*known) for known in touches] == [1, 1, 2, 18]


def test_a_simulated_touch_is_what_was_asked_for(configured):
    device = build_device(configured("layout=grid", "layout.rows=3", "layout.columns=4", "device.noise=0"))
    scene = simulate_scene(device, ["press", "dynamic"], "bar", 5, field=True)
    assert scene.readings.shape == (30, 12)
    assert scene.title == "bar: dynamic, press"
    assert scene.pressure.max() < 90.5e3
    pressed = scene.pressure.any(axis=(1, 2))
    assert 4 <= pressed.sum() <= 20
    # the surface moves in these frames, and most where the pressure is
    assert (np.abs(scene.moved).max(axis=(1, 2)) > 1e-6).tolist() == pressed.tolist()
    frame = int(scene.pressure.max(axis=(1, 2)).argmax())
    row, column = np.unravel_index(scene.moved[frame].argmax(), (33, 33))
    near = scene.pressure[frame, max(0, row - 2) : row + 2, max(0, column - 2) : column + 2]
    assert near.max() > 0.3 * scene.pressure[frame].max()
    again = simulate_scene(device, ["press", "dynamic"], "bar", 5, field=False)
    assert (again.readings == scene.readings).all()
    assert again.moved is None
    assert (simulate_scene(device, [], None, 6, field=False).readings != scene.readings).any()


def test_a_touch_of_another_device_is_taken_by_its_number(made_up_device, tmp_path):
    touches, scene = made_up_device.touches("test"), read_scene(made_up_device, 3)
    assert torch.equal(torch.from_numpy(scene.readings), touches.readings[3])
    assert scene.title.startswith("touch 3: ")
    with pytest.raises(InputError, match="view=flat or view=sensors3d"):
        write_animation(scene, "skin3d", tmp_path / "x.gif")
    with pytest.raises(InputError, match="give index=0 to 39"):
        read_scene(made_up_device, 40)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("view", ["sensors3d", "skin3d"])
def test_a_slide_on_the_arm_is_drawn_in_space(view, configured, tmp_path):
    device = build_device(configured("body=arm", "body.cells=[12,12]", "simulator=naive"))
    scene = simulate_scene(device, ["press", "dynamic"], "bar", 5, field=True)
    assert scene.body == device.body
    assert scene.moved is None
    shown, _ = frames_of(write_animation(scene, view, tmp_path / "x.gif"))
    assert len(shown) == 30


def test_an_unknown_label_is_refused(configured):
    with pytest.raises(InputError, match="no label pres: labels may list big, dynamic, press, dangerous"):
        simulate_scene(build_device(configured("simulator=naive")), ["pres"], None, 0, field=False)


def test_a_confusion_matrix_shows_shares_of_each_true_class():
    figure = confusions({"x": np.array([[30, 10], [1, 3]])}, ("safe", "dangerous"))
    texts = [text.get_text().split() for text in figure.axes[0].texts]
    assert texts == [["75.0%", "30"], ["25.0%", "10"], ["25.0%", "1"], ["75.0%", "3"]]
    figure = confusions({"x": np.array([[5, 5], [0, 0]])}, ("no", "yes"))
    assert figure.axes[0].texts[2].get_text() == "0.0%\n0"


def test_a_trace_is_of_the_most_active_sensor():
    readings = torch.zeros(5, 3)
    readings[2, 1] = 4
    axis = traces({"naive": readings}, rate=10).axes[0]
    assert axis.lines[0].get_ydata().max() == 4
    assert axis.lines[0].get_xdata()[-1] == pytest.approx(0.4)


def test_a_picture_is_saved_whole(tmp_path):
    pictures = {name: torch.rand(8, 8) for name in ("image", "fourier")}
    figure = images(pictures, np.array([[0.05, 0.05]]), (0.1, 0.1))
    path = save_figure(figure, tmp_path / "new" / "figure.png")
    assert [one.name for one in path.parent.iterdir()] == ["figure.png"]
    with Image.open(path) as picture:
        assert min(picture.size) > 200
