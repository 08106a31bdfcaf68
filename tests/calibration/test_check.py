"""A second known load: does it confirm the scale, and is that found again at the next start?"""

from dataclasses import replace

import numpy as np
import pytest

from skin.body.base import Layer
from skin.body.material import Material
from skin.calibration.check import Check, describe_setup, find_check, store_check, verify_source
from skin.calibration.known_loads import measure_ratios
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.wire.channels import UnitConversion
from skin.wire.protocol import Header
from skin.wire.reader import Port
from skin.wire.skin import SerialSource, Source

SENSORS, RATE, HOLD, GAP = 9, 25.0, 11.0, 2.5
EXPECTED = 3.0 * np.eye(SENSORS) + 0.05
POSITIONS = np.stack(np.meshgrid([0.04, 0.12, 0.2], [0.01, 0.04, 0.07]), -1).reshape(-1, 2)
SIZE = (0.24, 0.08)
LAYERS = [Layer(Material("silicone", 1e5, 0.4), 0.005)]


def frames(loads, follows=0.0, hold=HOLD):
    """Return frames, N, of loads on sensors, with a baseline that follows in so many s."""
    noise, baseline = np.random.default_rng(0), np.zeros(SENSORS)
    values = [np.zeros((round(4 * RATE), SENSORS))]
    for sensor in loads:
        values += [np.tile(EXPECTED[sensor], (round(hold * RATE), 1)), np.zeros((round(GAP * RATE), SENSORS))]
    for number, row in enumerate(np.concatenate([*values, np.zeros((9999, SENSORS))])):
        force = row + noise.normal(0, 0.02, SENSORS)
        baseline += (force - baseline) / follows / RATE if follows else 0.0
        t = number / RATE
        yield Frame(number, t, t, force - baseline, np.ones(SENSORS, dtype=bool))


def measured(scale=1.0, loads=(4, 0, 8), **stream):
    said, stream = [], frames(loads, **stream)
    conversion = UnitConversion(np.full(SENSORS, scale), np.zeros(SENSORS), np.zeros(SENSORS, bool))
    first = [next(stream) for _ in range(round(2 * RATE))]
    return measure_ratios(stream, first, conversion, EXPECTED, 10.0, said.append), said


def test_three_loads_are_measured_and_guide_the_user():
    ratios, said = measured()
    assert list(ratios) == ["4", "0", "8"]
    assert list(ratios.values()) == pytest.approx([1.0] * 3, abs=0.03)
    assert said[0] == "sensor 4: 3.05 N, predicted 3.05 N; 1 of 3, lift it"
    assert len(said) == 3


@pytest.mark.parametrize("scale", [1e-9, 0.1, 0.5, 2.0, 1 / 4.448, -1.0])
def test_a_wrong_scale_is_refused_with_its_ratio(data, scale):
    ratios, _ = measured(scale)
    with pytest.raises(InputError, match=r"the load times .*nothing was stored.*4\.45 lbf") as refused:
        store_check(Check({"device": "arm-L"}, "2026-03-01", ratios, []))
    assert not list(data.rglob("*.json"))
    shown = float(str(refused.value).split("times ")[1].split(" ")[0])
    assert shown == pytest.approx(scale, rel=0.03)


@pytest.mark.parametrize("follows", [3.0, 20.0, 36.0, 60.0])
def test_a_device_that_follows_its_own_baseline_is_refused(follows):
    with pytest.raises(InputError, match="seems to follow its own baseline"):
        measured(follows=follows)


def test_a_load_that_is_lifted_too_early_does_not_count():
    with pytest.raises(InputError, match="no further load lay for 10 s within 60 s"):
        measured(loads=[4], hold=4.0)


class Opened:
    """An open skin that sent this header."""

    def __init__(self, name):
        self.header = Header(9, 9, 100.0, "adc", 10, name) if name else None


@pytest.fixture
def data(monkeypatch, tmp_path):
    monkeypatch.setenv("SKIN_DATA", str(tmp_path))
    return tmp_path


def verify(name="arm-L", scale=0.02, positions=POSITIONS, layers=LAYERS, **settings):
    port = SerialSource(Port(port="/dev/x", scale=scale, **settings), SENSORS, 10.0, layers)
    source = Source("x", Opened(name), None, port=port)
    conversion = port.convert(None, source.skin.header)
    return verify_source(source, conversion, positions, SIZE), (port, source.skin.header, conversion)


def stored(name="arm-L"):
    setup = describe_setup(*verify(name)[1], POSITIONS, SIZE)
    check = Check(setup, "2026-03-01T10:00:00+00:00", {"4": 1.1}, [512.25] * SENSORS)
    return check, store_check(check)


def test_a_scale_is_verified_by_its_check_alone(data):
    assert (verify()[0].state, verify()[0].check) == ("unverified", None)
    assert "no second reference" in verify()[0].text
    check, path = stored()
    assert path.parent == data / "checks"
    assert find_check(check.setup) == check
    assert (verify()[0].state, verify()[0].check) == ("checked", check)
    assert verify()[0].text == "scale checked on 2026-03-01"
    assert verify(layers=())[0].state == "checked"  # an exported model does not know its body


@pytest.mark.parametrize(("scale", "factor"), [(0.014, "0.7"), (-0.02, "-1"), (0.06, "3")])
def test_a_scale_that_contradicts_its_check_is_refused(data, scale, factor):
    stored()
    with pytest.raises(InputError, match=rf"{factor} times that of the check of 2026-03-01"):
        verify(scale=scale)
    assert "was made with another scale;" in verify(scale=0.022)[0].text


@pytest.mark.parametrize("part", ["channels", "materials", "curves", "layout"])
def test_another_calibration_or_body_than_that_of_the_check_is_named(data, part):
    check, _ = stored()
    store_check(replace(check, setup={**check.setup, part: [1.0]}))
    assert (verify()[0].state, verify()[0].check) == ("unverified", None)
    assert f"the check of 2026-03-01 was made with another {part};" in verify()[0].text


@pytest.mark.parametrize(
    ("part", "damaged"),
    [("0.02,", '"0.02",'), ('"ratios"', '"rates"'), ("2026-03-01", "\udc80"), ('"2026', "2026"), ("{", "[")],
)
def test_a_damaged_check_confirms_nothing(data, part, damaged):
    _, path = stored()
    path.write_text(path.read_text().replace(part, damaged), errors="surrogateescape")
    assert (verify()[0].state, verify()[0].check) == ("unverified", None)


def test_emulated_devices_and_recordings_are_exempt(data):
    assert verify("emulated-2")[0].state == "exempt"
    source = replace(Source("x", Opened(None), None))
    assert verify_source(source, verify()[1][2], POSITIONS, SIZE).state == "exempt"


def test_a_declared_sensitivity_verifies_the_scale_or_refuses_it(data):
    assert verify(sensitivity=0.024)[0].state == "declared"
    with pytest.raises(InputError, match=r"by 0\.002 N per unit, device\.sensitivity=0\.02 says otherwise"):
        SerialSource(Port(port="/dev/x", scale=0.002, sensitivity=0.02), SENSORS, 10.0)
