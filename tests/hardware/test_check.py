"""A second known load: does it confirm the scale, and is that found again at the next start?"""

from dataclasses import replace

import numpy as np
import pytest

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.hardware.check import (
    Check,
    Verification,
    describe_setup,
    find_check,
    measure_ratios,
    require_agreement,
    store_check,
    verify_source,
)
from skin.hardware.wire.channels import UnitConversion
from skin.hardware.wire.protocol import Header
from skin.hardware.wire.reader import PortSettings
from skin.hardware.wire.skin import SerialSource, Source

SENSORS, RATE, HOLD, GAP = 9, 50.0, 11.0, 2.5
EXPECTED = 3.0 * np.eye(SENSORS) + 0.05
POSITIONS, SIZE = (
    np.stack(np.meshgrid([0.04, 0.12, 0.2], [0.01, 0.04, 0.07]), -1).reshape(-1, 2),
    (0.24, 0.08),
)


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


def test_three_loads_confirm_a_scale_and_guide_the_user():
    ratios, said = measured()
    assert list(ratios) == ["4", "0", "8"]
    require_agreement(ratios)
    assert said[:3] == [
        "hold it for 10 s",
        "ok, lift it",
        "sensor 4: 3.05 N, predicted 3.05 N; 1 of 3 sensors, next one",
    ]


@pytest.mark.parametrize("scale", [1e-9, 0.1, 0.5, 2.0, 1 / 4.448, -1.0])
def test_a_wrong_scale_is_refused_with_its_ratio(scale):
    ratios, _ = measured(scale)
    with pytest.raises(InputError, match=r"the load times .*nothing was stored.*4\.45 lbf") as refused:
        require_agreement(ratios)
    shown = float(str(refused.value).split("times ")[1].split(" ")[0])
    assert shown == pytest.approx(scale, rel=0.03)


@pytest.mark.parametrize(
    ("follows", "shown"), [(3.0, "fell from"), (20.0, "fell from"), (36.0, "lower behind")]
)
def test_a_device_that_follows_its_own_baseline_is_refused(follows, shown):
    with pytest.raises(InputError, match=f"sensor 4 .*{shown}.*follow its own baseline"):
        measured(follows=follows)


def test_a_load_that_is_lifted_too_early_is_put_down_again():
    with pytest.raises(InputError, match="no load within 120 s"):
        measured(loads=[4], hold=4.0)


class Opened:
    """An open skin that sent this header."""

    def __init__(self, name):
        self.header = Header(9, 9, 100.0, "adc", 10, name) if name else None


@pytest.fixture
def data(monkeypatch, tmp_path):
    monkeypatch.setenv("SKIN_DATA", str(tmp_path))
    return tmp_path


def verify(name="arm-L", scale=0.02, positions=POSITIONS, **settings):
    port = SerialSource(PortSettings(port="/dev/x", scale=scale, **settings), SENSORS, 10.0)
    source = Source("x", Opened(name), None, port=port)
    conversion = port.convert(None, source.skin.header)
    return verify_source(source, conversion, positions, SIZE), (port, source.skin.header, conversion)


def stored(name="arm-L"):
    _, parts = verify(name)
    setup = describe_setup(*parts, POSITIONS, SIZE)
    rest = [512.25] * SENSORS
    check = Check(**vars(setup), date="2026-03-01T10:00:00+00:00", ratios={"4": 1.1}, rest=rest)
    return check, store_check(check)


def test_a_scale_is_verified_by_its_check_alone(data):
    assert verify()[0] == Verification("unverified")
    assert "no second reference" in verify()[0].text
    check, path = stored()
    assert path.parent == data / "checks"
    assert find_check(check) == check
    assert verify()[0] == Verification("checked", check)
    assert verify()[0].text == "scale checked on 2026-03-01"


@pytest.mark.parametrize(
    ("changed", "differences"),
    [
        ({"scale": 0.01}, ("scale",)),
        ({"scale": -0.02}, ("scale",)),
        ({"name": "arm-R"}, ("device",)),
        ({"positions": POSITIONS + 0.001}, ("layout",)),
    ],
)
def test_what_differs_from_the_check_is_named(data, changed, differences):
    check, _ = stored()
    verification = verify(**changed)[0]
    assert verification == Verification("unverified", check, differences)
    assert f"2026-03-01 was made with another {differences[0]}" in verification.text


def test_a_damaged_check_confirms_nothing(data):
    _, path = stored()
    path.write_text(path.read_text().replace("0.02", '"0.02"'))
    assert verify()[0] == Verification("unverified")


def test_emulated_devices_and_recordings_are_exempt(data):
    assert verify("emulated-2")[0].state == "exempt"
    source = replace(Source("x", Opened(None), None))
    assert verify_source(source, verify()[1][2], POSITIONS, SIZE) == Verification("exempt")


def test_a_declared_sensitivity_verifies_the_scale_or_refuses_it(data):
    assert verify(sensitivity=0.024)[0] == Verification("declared")
    with pytest.raises(InputError, match=r"by 0\.002 N per unit, device\.sensitivity=0\.02 says otherwise"):
        SerialSource(PortSettings(port="/dev/x", scale=0.002, sensitivity=0.02), SENSORS, 10.0)
