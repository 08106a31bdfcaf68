"""Labels: gates, those of one's own, and limits of pressure and force."""

import numpy as np
import pytest
import torch

from skin.body.layout import Grid
from skin.body.sheet import Sheet
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.mechanics.simulator.naive import Naive
from skin.runs.configuration import fingerprint, recompose
from skin.touch.fingertips import read_touch
from skin.touch.gestures import GestureSettings, TouchSampler
from skin.touch.labels import TOUCH, TOUCH_OR_NOT, Label, Limits


def test_a_shut_gate_silences_the_other_labels():
    given = torch.tensor([[1.0, 0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    assert TOUCH_OR_NOT.counts(given).tolist() == [[True] * 5, [False] * 4 + [True]]
    assert TOUCH_OR_NOT.gated == TOUCH.names
    assert TOUCH.counts(given[:, :4]).all()


def mean_speed(movie, body):
    """Return the length of each path by the diagonal of the skin and the duration."""
    return movie.parameters["speed"] / float(torch.tensor(body.size).norm())


OWN = {"fast": {"opposite": "slow", "measure": mean_speed, "above": 0.04}}
BODY = Sheet((0.16, 0.16), (16, 16), [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize("kind", [{}, {"radius": [0.004, 0.01]}], ids=["gestures", "fingertips"])
@pytest.mark.parametrize(
    "data", [{}, {"stream": True}, {"direction": True}], ids=["whole", "stream", "direction"]
)
def test_a_label_of_ones_own_follows_from_its_measure(kind, data):
    settings = {"layout": Grid(3, 3), "simulator": Naive, "gestures": 80, "test_gestures": 10}
    settings |= data
    plain, device = (Simulated(body=BODY, touch=kind | more, **settings) for more in ({}, {"labels": OWN}))
    names = list(plain.task.names)
    assert device.task.names == (*names[:4], "fast", *names[4:])
    assert (device.task.gate, device.task.direction) == (plain.task.gate, plain.task.direction)
    recording, other = (one.recording("train", complete=False) for one in (device, plain))
    assert torch.equal(recording.touches.readings, other.touches.readings)  # it changes no draw
    labels = recording.touches.labels
    assert torch.equal(labels[:, [n for n in range(len(names) + 1) if n != 4]], other.touches.labels)
    fast = recording.parameters["speed"] / (0.16 * 2**0.5) > 0.04
    assert torch.equal(labels[:, 4] > 0.5, fast if "stream" not in data else fast & (labels[:, 5] > 0.5))
    assert 0 < labels[:, 4].mean() < 0.6


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"rub": {"opposite": "still"}}, "touch.labels.rub needs measure and above"),
        ({"rub": OWN["fast"] | {"over": 1}}, "touch.labels.rub has no setting over"),
        ({"rub": OWN["fast"] | {"above": "much"}}, "touch.labels.rub.above=much must be"),
        ({"big": OWN["fast"]}, "touch.labels.big is a label already: give yours another name"),
    ],
)
def test_a_wrong_label_is_one_sentence(labels, message):
    with pytest.raises(InputError, match=message):
        read_touch({"labels": labels})
    assert read_touch({"labels": OWN}).labels == {"fast": Label(**OWN["fast"])}


FORCE = {"limit": 65, "unit": "N", "source": "a table"}
PRESSURE = {"limit": 1.4, "unit": "MPa", "source": "a table"}
SMALL = ["device.test_gestures=32", "evaluation.safe_gestures=32"]
SMALL += ["evaluation.devices=0", "evaluation.layouts=0"]


def drawn(count: int = 64, **limits):
    """Return the source of a sheet with these limits, and a movie of it."""
    footprints = BODY.footprints(Grid(5, 5).sensors(BODY))
    source = TouchSampler(BODY, footprints, Prescribed(), GestureSettings.of({"limits": limits}))
    return source, source.sample(count, np.random.default_rng(3))


def test_a_table_of_the_threshold_is_the_default(configured):
    plain = configured()
    assert plain.touch["limits"] == {}
    old = configured()
    del old.touch["limits"], old.device["touch"]["limits"]
    assert fingerprint(old) == fingerprint(plain) != fingerprint(configured("limits=cuff"))
    (_, movie), (_, under) = drawn(), drawn(pressure=PRESSURE | {"limit": 90.5, "unit": "kPa"})
    assert "excess" not in movie.parameters
    assert movie.labels.equal(under.labels)
    pressure = movie.parameters["pressure"].numpy()
    assert under.parameters["pressure"].numpy() == pytest.approx(pressure, rel=1e-5)
    assert under.parameters["excess"].numpy() == pytest.approx(pressure / 90.5e3, rel=1e-5)


def test_a_force_alone_makes_a_light_wide_press_dangerous():
    _, movie = drawn(force=FORCE)
    pressure, force = (movie.parameters[name] for name in ("pressure", "force"))
    big, _, _, dangerous = (movie.labels > 0.5).T
    assert movie.labels.mean(dim=0).tolist() == [0.5] * 4  # all 16 combinations
    assert pressure[big & dangerous].max() < 90.5e3
    assert force[dangerous].min() > 65 * 0.99
    assert force[~dangerous].max() <= 65 * 1.01
    assert ((movie.parameters["excess"] > 1) == dangerous).all()


def test_what_no_person_can_press_is_left_out_and_named():
    human = {"limit": 1000, "unit": "N", "source": "a table"}
    with pytest.warns(UserWarning, match="a big dangerous press or tap takes more than limits.human_force"):
        _, movie = drawn(pressure=PRESSURE, human_force=human)
    big, _, _, dangerous = (movie.labels > 0.5).T
    assert dangerous.float().mean() == 0.5
    assert not (big & dangerous).any()
    assert (big & ~dangerous).any()
    assert movie.parameters["force"].max() <= 1000


def test_presses_at_the_limit_follow_it():
    limited, plain = (
        Simulated(body=BODY, layout=Grid(5, 5), simulator=Naive, touch=touch, gestures=10)
        for touch in ({"limits": {"force": FORCE}}, {})
    )
    area = 0.03 * 0.16**2  # of a press
    assert "force=65.0" in limited.recording(None).metadata["limits"]
    assert "limits" not in plain.recording(None).metadata
    ratio = limited.press_readings() / plain.press_readings()
    assert ratio.diagonal().numpy() == pytest.approx(65 / area / 90.5e3, rel=1e-4)


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"force": {"limit": 65, "unit": "N"}}, r"limits.force needs source"),
        ({"force": FORCE | {"source": ""}}, r"limits.force.source"),
        ({"force": FORCE | {"unit": "kg"}}, r"limits.force.unit=kg must be 'N'"),
        ({"pressure": PRESSURE | {"unit": "N"}}, r"limits.pressure.unit=N must be 'Pa', 'kPa'"),
        ({"pressure": PRESSURE | {"limit": 0}}, r"limits.pressure.limit=0 must be greater than 0"),
        ({"force": FORCE, "press_force": FORCE}, r"limits has no setting press_force"),
        ({"tap_force": FORCE}, r"limits must give pressure, force or both"),
        ({"force": FORCE, "human_force": FORCE}, r"human_force=65 N must be above the limits of force"),
    ],
)
def test_a_table_without_unit_or_source_is_refused(table, reason):
    with pytest.raises(InputError, match=reason):
        Limits.of(table)


@pytest.mark.parametrize(
    ("trained", "word"),
    [
        ([], "limits=cuff"),
        (["limits=cuff"], "touch.limits=null"),
        ([], "+device.touch.limits={pressure:{limit:1,unit:MPa,source:a}}"),
        ([], "touch.thresholds.pressure=50e3"),
    ],
)
def test_a_run_takes_no_other_limits(configured, trained, word):
    """Its alarm would be late, or say of other limits what it learned of its own."""
    with pytest.raises(InputError, match=r"was fixed when the run was trained"):
        recompose(configured(*trained), [word])


@pytest.fixture
def own(tmp_path):
    """The path of a table of one's own, and words that train under it in seconds."""
    table = tmp_path / "conf" / "limits" / "mine.yaml"
    table.parent.mkdir(parents=True)
    table.write_text("force: {limit: 65, unit: N, source: a table}\n")
    words = "--config-dir", "conf", "limits=mine", "experiment=rules", "simulator=naive", "data.gestures=96"
    return table, words


@pytest.mark.slow("trains a run, evaluates it, and imports what both need")
def test_a_table_of_ones_own_trains_and_evaluates(run, tmp_path, own):
    done = run(tmp_path, "train", *own[1], *SMALL)
    assert done.returncode == 0, done.stderr
    done = run(tmp_path, "evaluate", "run=latest", *SMALL)
    assert done.returncode == 0, done.stderr
    assert "overall/accuracy" in done.stdout
    done = run(tmp_path, "evaluate", "run=latest", "limits=cuff", *SMALL)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
