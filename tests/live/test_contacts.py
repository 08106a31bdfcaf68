"""Contacts in the live view: what is said of them, and the process that estimates them."""

import json
import os
import pickle
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from time import monotonic, sleep
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from skin import Grid, InputError, Noise, Posterior, Sheet, Solid
from skin.device.resampling import Frame
from skin.inference.candidates import disc_readings
from skin.inference.mechanics import Mechanics
from skin.live.contacts import (
    LiveContacts,
    MeanReadings,
    average_readings,
    contact_text_lines,
    estimate_contacts,
    unknown_contacts,
)
from skin.live.engine import Verdict
from skin.runs.build import build_device
from skin.wire.channels import UnitConversion

PATIENCE = 100
SENSORS = 9
BODY = Sheet((0.06, 0.06), (12, 12), [{"material": "EcoFlex 00-30", "thickness": 0.02}])
NOISE = Noise(0.05, gain=0.05)
CONVERSION = UnitConversion(np.ones(SENSORS), np.zeros(SENSORS), np.zeros(SENSORS, dtype=bool))
TOUCHED = Verdict(0.0, 0.0, {"dangerous": 0.1}, True, {}, False, False)
SECONDS = count(1000)
TRUTH = np.array([[0.022, 0.035, 0.008]])
PLACES = Grid(3, 3, (0.01, 0.01), depth=0.005).sensors(BODY)
MECHANICS = Mechanics(Solid, BODY, PLACES, NOISE)


@pytest.fixture(scope="module")
def simulator():
    return Solid(BODY, PLACES)


@pytest.fixture(scope="module")
def posterior():
    return MECHANICS.posterior()


@pytest.fixture(scope="module")
def felt(simulator):
    """Return the readings of a fingertip of 5 N."""
    return 5 * disc_readings(simulator, BODY, TRUTH, 0.0015)[0]


def test_contacts_take_all_channels_of_three_axes(felt):
    """What changed, or is masked, is counted by sensors of the alarm: a channel along the surface is none."""
    sent, answers, contacts = [], [{"changed": [1, 5]}], LiveContacts()
    contacts._pipe = SimpleNamespace(poll=lambda: True, recv=answers.pop, send=sent.append)
    contacts._whole, contacts._asked_at = bool, 0.0
    three = UnitConversion(np.ones(3 * SENSORS), np.zeros(3 * SENSORS), np.zeros(3 * SENSORS, dtype=bool))
    contacts.three = SimpleNamespace(conversion=three)
    values = np.stack([felt + 1, felt - 2, felt], axis=1).ravel()
    every = three.convert(Frame(None, 1.0, 0.0, values, values < np.inf))
    stream = [each._replace(three=every) for each in frames(felt)]
    contacts.look(stream, CONVERSION, [replace(TOUCHED, masked=(0,))], np.full(SENSORS, 0.5))
    assert (contacts.changed, np.flatnonzero(~sent[0].valid).tolist()) == ((1,), [2])
    above = sent[0].values.reshape(-1, 3) - felt[:, None]
    np.testing.assert_allclose(above, [[1, -2, -0.5]] * SENSORS, atol=1e-6)
    np.testing.assert_allclose(contacts.tangential, np.stack([felt + 1, felt - 2], axis=1), atol=1e-6)
    contacts.look([each._replace(three=None) for each in stream], CONVERSION, [TOUCHED], np.zeros(SENSORS))
    assert len(sent) == 1  # no readings before the tare of all channels


AGAIN = pytest.mark.slow("starts a process that imports anew, once more")


@contextmanager
def started(mechanics=MECHANICS):
    """Return contacts whose process is started."""
    contacts = LiveContacts()
    contacts.start(mechanics, bool)
    try:
        yield contacts
    finally:
        contacts.close()


@pytest.fixture(scope="module")
def running():
    """Return contacts whose process is ready; it takes seconds to begin."""
    with started() as contacts:
        assert contacts.state(monotonic())["reason"] == "being prepared"
        yield contacts


def frames(values, end=1.0, conversion=CONVERSION, **changes):
    """Return the readings of 0.1 s that end now."""
    times = end - 0.1 + (np.arange(10) + 1) * 0.01
    frame = Frame(None, 0.0, monotonic(), np.asarray(values, dtype=float), np.ones(SENSORS, dtype=bool))
    return [conversion.convert(frame._replace(t=t, **changes)) for t in times]


def moment(values, **changes):
    """Return readings of now."""
    valid, none = np.ones(len(values), dtype=bool), np.zeros(len(values), dtype=bool)
    readings = MeanReadings(np.asarray(values, dtype=float), valid, none, 0.05, 10, 0.0, 1.0, monotonic())
    return readings._replace(**changes)


def state_of(contacts, wanted, values):
    """Offer the same readings until the state is another one, or its reason has words, and return it."""
    deadline = monotonic() + PATIENCE
    while (state := contacts.state(monotonic()))["state"] != wanted and wanted not in state["reason"]:
        assert monotonic() < deadline, state
        # Seconds apart: each mean is that of ten frames.
        contacts.look(frames(values, end=next(SECONDS)), CONVERSION, [TOUCHED], np.zeros(SENSORS))
        sleep(0.02)
    return state


def test_the_message_says_where_and_how_hard(posterior, felt):
    message = estimate_contacts(posterior, NOISE, moment(felt))
    assert json.loads(json.dumps(message)) == message
    assert (message["state"], message["number"], message["device_time"]) == ("contacts", 1, 1.0)
    assert message["probability"] == message["probabilities"][1] > 0.9
    (contact,) = message["contacts"]
    assert np.hypot(contact["x"] - TRUTH[0, 0], contact["y"] - TRUTH[0, 1]) < 0.003
    assert contact["force"] == pytest.approx(5, abs=3 * contact["force_deviation"])
    assert contact["radius_deviation"] > 0
    low, high = contact["peak_interval"]
    assert low < contact["peak"] < high
    region = contact["region"]
    assert region["share"] == pytest.approx(sum(region["probabilities"]), abs=1e-3)
    assert region["share"] == pytest.approx(0.9, abs=0.08)
    assert min(region["cell"]) > 0.001
    positions = np.array(region["origin"]) + np.array(region["cells"]) * region["cell"]
    assert (np.abs(positions - TRUTH[0, :2]) <= np.array(region["cell"])).all(axis=1).any()
    head, line = contact_text_lines(message)
    *_, doubt = contact_text_lines(message | {"thickness": (0.0241, 0.03)})
    assert doubt == "readings fit 24.1 mm better than the described 30 mm"
    assert head.startswith("1 contact (")
    assert re.search(r" N, .* kPa$", line)


@pytest.mark.parametrize(
    ("values", "state", "number"),
    [
        (np.zeros(SENSORS), "no contact", 0),
        (np.full(SENSORS, 3.0), "not a fingertip", None),
        ([0, 0, 0, 0, -3.0, 0, 0, 0, 0], "not a fingertip", None),
    ],
)
def test_what_no_fingertip_gives_is_none_and_not_no_contact(posterior, values, state, number):
    message = estimate_contacts(posterior, NOISE, moment(values))
    assert (message["state"], message["number"]) == (state, number)
    assert (message["probability"] is None) == (number is None)
    assert number is None or message["contacts"] == []
    assert contact_text_lines(message)[0].startswith(f"{state} (")


def test_where_a_hard_touch_is_is_shown_though_no_fingertip_fits_it(posterior, felt):
    """On many sensors, gains that differ by more than was assumed show only there, where they are large."""
    estimate = replace(posterior.estimate(5 * felt), fingertip=False, fit=0.00213, large=0.3)
    message = estimate.to_json(0.0)
    assert (message["state"], message["number"], message["fit"]) == ("not a fingertip", None, 0.00213)
    (best,) = message["contacts"]
    assert np.hypot(best["x"] - TRUTH[0, 0], best["y"] - TRUTH[0, 1]) < 0.005
    assert best["force"] == pytest.approx(25, rel=0.2)
    head, line, note = contact_text_lines(message)
    assert "beyond the range of the prior" in note
    assert head == "not a fingertip (fit 0.0021, a larger contact 30 %)"
    assert line.startswith("best: (")
    assert " N, " in line


def test_broken_sensors_do_not_look_like_no_contact(posterior, felt):
    none = np.zeros(SENSORS, dtype=bool)
    message = estimate_contacts(posterior, NOISE, moment(felt, valid=none))
    assert message == unknown_contacts("no sensor has a valid reading")
    few = none.copy()
    few[4] = True
    assert "1 valid sensor" in estimate_contacts(posterior, NOISE, moment(felt, valid=few))["reason"]
    # The strongest sensor is at its limit: the force is more than it could say.
    limited, strongest = np.minimum(felt, 0.3 * felt.max()), felt == felt.max()
    clipped = estimate_contacts(posterior, NOISE, moment(limited, saturated=strongest))
    assert clipped["state"] == "contacts"
    assert clipped["contacts"][0]["force"] > 3
    assert contact_text_lines(clipped)[-1].startswith("beyond the range of sensors")


def test_a_limit_along_the_surface_bounds_no_force():
    skin = Solid(BODY, Grid(3, 3, (0.01, 0.01), depth=0.005, axes="three").sensors(BODY))
    values = 20 * disc_readings(skin, BODY, TRUTH, 0.0015)[0]
    limited = np.abs(values) >= 0.3 * np.abs(values).max()
    limited[12] = True  # along x of the middle: at its lower limit
    values[12] = -5.0
    seen = estimate_contacts(Posterior(skin, NOISE, BODY), NOISE, moment(values, saturated=limited))
    assert seen["probabilities"][0] < 0.1


def test_messages_of_every_state_have_the_same_fields(posterior, felt):
    none, estimate = unknown_contacts("why"), posterior.estimate(felt)
    assert (none["state"], none["number"], none["contacts"]) == ("unknown", None, [])
    assert contact_text_lines(none) == ["contacts unknown: why"]
    empty = replace(estimate, number=0, fingertip=False, fit=1.0)
    for changed in (estimate, replace(estimate, fingertip=False), empty):
        assert set(changed.to_json(0.0)) == set(none)


def test_readings_are_means_above_the_rest_of_the_sensors_that_work():
    values = np.arange(SENSORS, dtype=float)
    noise, rest, baseline = np.full(SENSORS, 0.2), np.full(SENSORS, -0.3), np.full(SENSORS, 0.1)
    conversion = replace(CONVERSION, scale=np.full(SENSORS, 0.5), noise=noise, rest=rest)
    sent = frames(values, conversion=conversion, saturated=np.arange(SENSORS) == 8)
    other = sent[3].frame._replace(values=values + 10, valid=np.arange(SENSORS) != 7)
    sent[3] = conversion.convert(other)
    readings = average_readings(sent, conversion, (2,), baseline, True)
    assert readings.values[[0, 8]] == pytest.approx([0.5 + 0.2, 4 + 0.5 + 0.2])
    assert np.flatnonzero(~readings.valid).tolist() == [2, 7]
    assert np.flatnonzero(readings.saturated).tolist() == [8]
    assert (readings.frames, readings.step) == (10, 0.5)
    assert readings.noise == pytest.approx(0.2)
    assert average_readings(sent, CONVERSION, (), baseline, False).noise is None


def test_the_process_estimates_the_same_bits_and_an_estimate_becomes_old(running, posterior, felt):
    state = state_of(running, "contacts", felt)
    readings = average_readings(frames(felt), CONVERSION, (), np.zeros(SENSORS), False)
    assert state == estimate_contacts(posterior, NOISE, readings._replace(time=state["device_time"]))
    sleep(1.5 * running.stale)
    assert running.state(monotonic())["state"] == "unknown"
    assert state_of(running, "no contact", np.zeros(SENSORS))["number"] == 0


def test_the_process_does_not_hear_ctrl_c_looking_never_waits_and_only_the_newest_counts(running, felt):
    os.kill(running.process.pid, signal.SIGINT)
    sleep(0.2)
    state_of(running, "contacts", felt)
    os.kill(running.process.pid, signal.SIGSTOP)
    longest = 0.0
    for number in range(200):
        began = monotonic()
        end = 1e6 + 0.05 * number
        running.look(frames(felt, end=end), CONVERSION, [TOUCHED], np.zeros(SENSORS))
        longest = max(longest, monotonic() - began)
        sleep(0.005)
    assert longest < 5  # waiting for the stopped process would never end
    assert running.state(monotonic())["state"] == "unknown"
    os.kill(running.process.pid, signal.SIGCONT)
    deadline, times = monotonic() + PATIENCE, set()
    while not any(t > 1e6 + 0.05 * 198.5 for t in times):
        assert monotonic() < deadline, times
        times.add(running._latest[0]["device_time"])
        running.look(frames(felt, end=1e6 + 0.05 * 199), CONVERSION, [TOUCHED], np.zeros(SENSORS))
        sleep(0.002)
    assert len([t for t in times if t > 1e6]) <= 3


@pytest.mark.slow("starts a process that imports anew")
def test_a_thickness_that_no_skin_can_have_is_said(felt):
    layers = [replace(BODY.layers[0], thickness=height) for height in (0.0188, 0.0012)]
    noise = replace(NOISE, thickness=(0.75, 1.3))
    with started(replace(MECHANICS, body=replace(BODY, layers=layers), noise=noise)) as contacts:
        assert state_of(contacts, "layer 2 of the body is 0.0009 m thick", felt)["state"] == "unknown"


@pytest.mark.slow("starts a process that imports anew")
def test_a_process_that_dies_is_said_and_stops_nothing(felt):
    with started() as contacts:
        state_of(contacts, "contacts", felt)
        os.kill(contacts.process.pid, signal.SIGKILL)
        assert state_of(contacts, "has ended", felt)["state"] == "unknown"


@pytest.mark.parametrize(
    ("number", "wait"),
    [
        (signal.SIGKILL, 0.0),
        pytest.param(signal.SIGTERM, 1.0, marks=AGAIN),
        pytest.param(signal.SIGKILL, 4.0, marks=AGAIN),
    ],
)
def test_the_process_ends_with_the_command_however_it_ends(tmp_path, number, wait):
    (tmp_path / "mechanics").write_bytes(pickle.dumps(MECHANICS))
    script = (
        "import pickle, time; from skin.live.contacts import LiveContacts; contacts = LiveContacts();"
        "contacts.start(pickle.load(open('mechanics', 'rb')), bool);"
        "print(contacts.process.pid, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, stdout=subprocess.PIPE) as command:
        child = psutil.Process(int(command.stdout.readline()))
        sleep(wait)
        assert child.is_running()
        command.send_signal(number)
    child.wait(PATIENCE)


def test_where_no_contacts_can_be_estimated_a_sentence_says_why(configured):
    with pytest.raises(InputError, match="model has no simulated skin: use run=any_skin"):
        Mechanics.of(None, False)
    device = build_device(configured("simulator=fem")).reference
    with pytest.raises(InputError, match="equation 10 do not add up: use run=any_skin"):
        Mechanics.of(device, False)
    device = build_device(configured("simulator=naive", "device.gain_spread=[0.1,0.3]")).reference
    assert Mechanics.of(device, False).noise.gain == pytest.approx(0.2)
    assert Mechanics.of(device, True).noise.gain == pytest.approx(0.02)
