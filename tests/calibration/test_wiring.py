"""Sessions whose places or channels are not those of the layout: named, and right once confirmed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from skin.body.base import Sheet
from skin.body.layout import File, Grid
from skin.calibration.bench import TURNS, BenchSession, BenchSettings, Gauge
from skin.calibration.fit import fit_calibration
from skin.calibration.known_loads import choose_presses, emulate_session, stair_gauge
from skin.calibration.wiring import check_usable, wired_bench
from skin.device.calibration import Calibration
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.solid import Solid
from tests.calibration.test_fit import LAYERS

GEL = [{"material": "EcoFlex 00-30", "thickness": 0.015}]
EIGHT = "x_m,y_m\n.020,.018\n.075,.022\n.130,.016\n.045,.052\n.101,.049\n.022,.083\n.078,.080\n.131,.086\n"
BACK = {"rotate_90": "rotate_270", "rotate_270": "rotate_90"}
SKINS = ("fem", "long", "irregular")


@pytest.fixture(scope="module")
def skins(tmp_path_factory):
    path = tmp_path_factory.mktemp("layout") / "eight.csv"
    path.write_text(EIGHT)
    settings = {
        "fem": (Sheet([0.16, 0.16], [16, 16], LAYERS), Grid(3, 3), PlatesAndBeams),
        "long": (Sheet([0.24, 0.08], [24, 8], GEL), Grid(3, 3), Solid),
        "irregular": (Sheet([0.15, 0.10], [15, 10], GEL), File(str(path)), Solid),
    }

    @cache
    def make(name: str) -> tuple[Simulated, BenchSession]:
        body, layout, simulator = settings[name]
        skin = Simulated(body=body, layout=layout, simulator=simulator, gain_spread=0.2)
        return skin, session_of(skin)

    return make


def session_of(skin: Simulated, places: np.ndarray | None = None, bits: int | None = None) -> BenchSession:
    randomness = np.random.default_rng(0)
    places = choose_presses(skin, randomness) if places is None else places
    return emulate_session(skin, stair_gauge(places, idle=5.0), randomness, bits)


def in_frame(gauge: Gauge, turn: str, size: tuple[float, float]) -> Gauge:
    """Return a gauge whose places are in a frame that ``turn`` brings back to the sheet's."""
    swapped = turn in ("transpose", "transpose_other", "rotate_90", "rotate_270")
    return gauge.turned(BACK.get(turn, turn), tuple(size)[::-1] if swapped else size)


def changed(session: BenchSession, order=None, inverse=(), dead=()) -> BenchSession:
    """Return a session whose column k is that of sensor ``order[k]``; then some are inverse or dead."""
    raw = session.raw[:, list(range(session.raw.shape[1])) if order is None else order].copy()
    raw[:, list(inverse)] *= -1
    rng = np.random.default_rng(1)
    raw[:, list(dead)] = 0.1 + 0.05 * rng.standard_normal((len(raw), len(dead)))
    return replace(session, raw=raw)


def exchanged(count: int, *pair: int) -> list[int]:
    order = list(range(count))
    order[pair[0]], order[pair[1]] = order[pair[1]], order[pair[0]]
    return order


def refused(skin, session, **confirmed) -> str:
    with pytest.raises(InputError) as caught:
        wired_bench(skin, session, BenchSettings(**confirmed))
    return str(caught.value)


def fitted(skin, session, **confirmed) -> Calibration:
    return fit_calibration(wired_bench(skin, session, BenchSettings(**confirmed)))


def check_confirmed(skin, session, dead=(), **confirmed) -> Calibration:
    """Check the gains and the dead channels of a session; return its calibration."""
    calibration = fitted(skin, session, **confirmed)
    assert calibration.broken["dead"] == list(dead)
    alive = np.setdiff1d(np.arange(len(calibration)), dead)
    np.testing.assert_allclose(calibration.values()["gain"][alive], skin.constants.gain[alive], rtol=0.02)
    return calibration


@pytest.mark.parametrize("turn", TURNS)
def test_turns_come_back(turn):
    size, rng = (0.24, 0.08), np.random.default_rng(0)
    gauge = stair_gauge(rng.uniform(0.0, 0.08, (4, 2)))
    back = in_frame(gauge, turn, size).turned(turn, size)
    np.testing.assert_allclose(back.position, gauge.position, atol=1e-12)
    np.testing.assert_allclose(np.cos(back.presses["angle"]), np.cos(gauge.presses["angle"]), atol=1e-12)
    assert not len(gauge.outside(size))


@pytest.mark.parametrize("name", SKINS)
def test_a_session_that_fits_passes(skins, name):
    check_confirmed(*skins(name))


@pytest.mark.parametrize(
    ("name", "turn", "dead"), list(zip(SKINS * 2, list(TURNS)[1:7], [(), (0,)] * 3, strict=True))
)
def test_turned_places_are_named_and_right_once_confirmed(skins, name, turn, dead):
    skin, session = skins(name)
    session = changed(replace(session, gauge=in_frame(session.gauge, turn, skin.size)), dead=dead)
    said = refused(skin, session)
    assert f"the session fits if the places of the presses are {TURNS[turn][1]}; to confirm" in said
    assert f"add calibrate.places={turn}" in said.split(" Or ")[0]
    check_confirmed(skin, session, dead, places=turn)


def test_places_that_no_turn_brings_onto_the_sheet_are_refused_with_one(skins):
    skin, session = skins("long")
    presses = session.gauge.presses
    gauge = replace(session.gauge, presses=presses.assign(x_m=1000 * presses["x_m"]))
    assert "is outside the sheet" in refused(skin, replace(session, gauge=gauge))


@pytest.mark.parametrize(
    ("name", "dead", "every"),
    [*((name, (), True) for name in SKINS), ("fem", (3,), False), ("irregular", (1,), False)],
)
def test_channels_in_another_order_are_named_and_right_once_confirmed(skins, name, dead, every):
    skin, session = skins(name)
    count = len(skin.sensors)
    order = np.random.default_rng(7).permutation(count).tolist() if every else exchanged(count, 1, 6)
    session, channels = changed(session, order, dead=dead), np.argsort(order).tolist()
    said = refused(skin, session)
    assert f"; to confirm that, add 'calibrate.channels=[{','.join(map(str, channels))}]'" in said
    assert every or "channels 1 and 6 are in another order" in said
    check_confirmed(skin, session, [order.index(channel) for channel in dead], channels=channels)


def test_axes_and_channels_may_both_be_wrong(skins):
    skin, session = skins("irregular")
    order = exchanged(8, 0, 4)
    mirrored = replace(session, gauge=in_frame(session.gauge, "mirror_y", skin.size))
    session = changed(mirrored, order, inverse=[2])
    said = refused(skin, session)
    assert "add calibrate.places=mirror_y 'calibrate.channels=[4,1,2,3,0,5,6,7]'" in said
    calibration = check_confirmed(skin, session, places="mirror_y", channels=order)
    assert calibration.polarity == [1, 1, -1, 1, 1, 1, 1, 1]


def test_a_confirmation_that_is_wrong_is_refused_with_the_right_one(skins):
    skin, session = skins("long")
    assert "calibrate.places=as_given" in refused(skin, session, places="mirror_y")
    order = exchanged(9, 1, 6)
    assert "calibrate.channels=[0,1,2,3,4,5,6,7,8]" in refused(skin, session, channels=order)
    mirrored = replace(session, gauge=in_frame(session.gauge, "mirror_y", skin.size))
    assert "calibrate.places=mirror_y" in refused(skin, mirrored, places="mirror_x")


@pytest.mark.parametrize("inverse", [[4], [0, 2, 7], list(range(8))])
def test_inverse_channels_are_found_and_need_no_confirmation(skins, inverse):
    skin, session = skins("irregular")
    session = changed(session, inverse=inverse)
    calibration = check_confirmed(skin, session)
    assert [n for n, sign in enumerate(calibration.polarity) if sign < 0] == inverse
    true = np.nan_to_num(calibration.corrected(session.raw))
    np.testing.assert_allclose(true.max(axis=0), 10 / skin.constants.gain, rtol=0.1)
    assert true.min() > -1


def test_counts_that_fall_with_force_become_newtons(skins):
    skin, _ = skins("long")
    session = session_of(skin, bits=10)
    normal, inverse = fitted(skin, session), replace(session, raw=1023 - session.raw)
    falling = fitted(skin, inverse)
    assert falling.polarity == [-1] * 9
    np.testing.assert_allclose(falling.values()["gain"], normal.values()["gain"], rtol=1e-3)
    np.testing.assert_allclose(falling.newtons(inverse.raw), normal.newtons(session.raw), atol=0.02)


MIXES = {
    "crosstalk": lambda raw: 0.05 * (raw[:, 3] + raw[:, 5]),
    "two at once": lambda raw: 0.5 * (raw[:, 1] + raw[:, 7]),
    "bridged": lambda raw: raw[:, 3],
}


@pytest.mark.parametrize("mix", MIXES)
def test_a_channel_that_no_place_explains_is_not_called_dead(skins, mix):
    skin, session = skins("long")
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(session.time))
    raw = session.raw.copy()
    raw[:, 4] = MIXES[mix](raw) + noise
    said = refused(skin, replace(session, raw=raw))
    assert said.startswith("channels respond, but not to the presses near their sensors (4): neither another")
    assert "calibrate.broken=[4]" in said
    assert fitted(skin, replace(session, raw=raw), broken=[4]).broken["dead"] == [4]


@pytest.mark.parametrize("level", [0.05, 0.5])
def test_noise_of_any_kind_is_dead_and_a_weak_channel_is_not(skins, level):
    skin, session = skins("long")
    rng, raw = np.random.default_rng(2), session.raw.copy()
    raw[:, 4] = level * rng.standard_normal(len(raw))
    raw[:, 7] = np.cumsum(0.2 * level * rng.standard_normal(len(raw)))
    raw[:, 2] = 0.03 * raw[:, 2] + 0.05 * rng.standard_normal(len(raw))
    calibration = fitted(skin, replace(session, raw=raw))
    assert calibration.broken["dead"] == [4, 7]
    assert calibration.sensors["gain"][2] < 0.05


def test_few_presses_name_nothing(skins):
    skin, _ = skins("long")
    places = skin.sensors.positions[[0, 8], :2]
    session = session_of(skin, np.concatenate([places, places + 0.001]))
    wired_bench(skin, session, BenchSettings())
    mirrored = replace(session, gauge=in_frame(session.gauge, "mirror_y", skin.size))
    said = refused(skin, mirrored)
    assert said.startswith("channels respond, but not to the presses near their sensors (0 and 8): neither")
    assert "calibrate.places" not in said


def test_sensors_out_of_place_by_some_millimetres_pass(skins):
    skin, _ = skins("long")
    moved = skin.replace(position_error=0.003)
    wired_bench(skin, session_of(moved), BenchSettings())


def test_what_confirms_nothing_is_refused(skins):
    assert "calibrate.channels must hold each of 0 to 8 once" in refused(*skins("long"), channels=[0] * 9)
    assert "calibrate.broken takes sensors from 0 to 8, got 9" in refused(*skins("long"), broken=[9])


def test_more_than_a_quarter_of_unusable_sensors_is_refused():
    sensors = {"gain": [1.0] * 8}
    check_usable(Calibration(sensors, {"dead": [1], "stuck": [2]}))
    with pytest.raises(InputError, match=r"3 of 8 sensors would be unusable \(dead: 1 and 3; stuck: 2\)"):
        check_usable(Calibration(sensors, {"dead": [1, 3], "stuck": [2]}))
