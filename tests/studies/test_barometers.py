"""The simulated strip of barometers, against a strip whose gains and position are known."""

import numpy as np
import pytest

from experiments.studies.contact import LAST, Barometers, build_strip, read_presses, strip_readings
from experiments.studies.measures import Subject
from skin.errors import InputError


def write_barometers(path, x, readings, rise=6):
    """Write presses (P, 4), Pa, at positions (P,), mm, in the form of the robot, over drifting offsets."""
    lines = ["Sensor_0,Sensor_1,Sensor_2,Sensor_3,x,z,time"]
    offset, time = np.array([98000.0, 101000, 99000, 100000]), 0.0
    for position, top in zip(x, readings, strict=True):
        for depth in [0.0] * 6 + list(np.linspace(0, 1, rise + 1)[1:]) + [1.0] * 6 + [0.5]:
            values = ",".join(f"{value:.2f}" for value in offset + depth**2 * top)
            lines.append(f"{values},{1e3 * position:.0f},{480 * 4 * depth:.0f},{time:.2f}")
            time += 0.06
        offset = offset + 50
    path.write_text("\n".join(lines))


def test_presses_are_read_above_what_was_before_them(tmp_path):
    x = np.arange(6.0)
    readings = np.random.default_rng(0).uniform(0, 2e4, (6, 4))
    write_barometers(tmp_path / "a.csv", x, readings)
    positions, measured = read_presses(tmp_path, "a")
    assert positions.tolist() == x.tolist()
    np.testing.assert_allclose(measured, 1e-4 * readings, atol=1e-5)
    (tmp_path / "b.csv").write_text("time,s0\n0,1\n")
    for name in ("b", "none"):
        with pytest.raises(InputError, match=r"cannot read .* as a recording of four barometers"):
            read_presses(tmp_path, name)


@pytest.mark.slow("fits the position of a strip")
def test_a_strip_is_found_from_a_third_of_its_presses_and_places_the_others(tmp_path):
    """The skin is simulated with other gains, and 8 mm beside the robot."""
    body, simulator = build_strip(0.005)
    gains, x = np.array([3e5, 5e5, 4e5, 6e5]), 0.5 * np.arange(60)
    x = x[x / 1e3 + 0.008 < LAST + 0.01]
    for name, shift in (("first", 0.008), ("second", 0.0092)):
        readings = strip_readings(body, simulator, x / 1e3 + shift, 0.003) * gains
        write_barometers(tmp_path / f"{name}.csv", x, readings)
    for recordings in (["first"], ["first", "second"]):
        frame = Barometers(str(tmp_path), recordings)(Subject(None, condition="c"))
        assert set(frame.strip) == {"solid, 5 mm thick, tip of 3 mm"}
        assert frame.value.tolist() < [2.0, 0.4]
        assert (frame.low <= frame.value).all()
        assert (frame.value <= frame.high).all()
