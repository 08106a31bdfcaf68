"""The board, the terminal and the page, without a model behind them."""

import json
import os
import re
import urllib.error
import urllib.request
from contextlib import contextmanager
from dataclasses import replace
from io import StringIO
from threading import Event, Thread
from time import monotonic, sleep

import numpy as np
import pytest
from rich.console import Console

from skin import FingertipPrior, InputError
from skin.device.resampling import Frame
from skin.live import loop, web
from skin.live.contacts import unknown_contacts
from skin.live.loop import Display
from skin.live.verdict import Note, Verdict, verdict_message
from skin.live.view import screen, show_in_terminal
from skin.wire.channels import UnitConversion
from tests.wire.memory import until

PLACES = np.array([[0.02, 0.02, 0], [0.14, 0.03, 0], [0.03, 0.1, 0], [0.13, 0.11, 0], [0.08, 0.06, 0]])
SIZE = 0.16, 0.12
AT = """
const map = document.getElementById("map"), pen = map.getContext("2d");
return [...pen.getImageData({} * map.width + 7, {} * map.height, 1, 1).data];
"""
PLAIN = UnitConversion(np.ones(5), np.zeros(5), np.zeros(5, bool))
PRESSED = Verdict(0, 0, {"big": 0.2, "dangerous": 0.9}, True, {"big": False, "dangerous": True}, True, False)
SAFE = replace(PRESSED, dangerous=False)
IDLE = replace(SAFE, touched=False)
LAST_INVALID = np.array([True, True, True, True, False])


def display(*values, **more):
    """Return what is displayed after a frame of these values, N, if there are any."""
    subject = Display("rules naive 0", "/dev/skin", PLACES, SIZE, 4.0)
    if values:
        subject.add(frame(values, **more))
    return subject


@pytest.fixture
def subject():
    return display()


def frame(values, valid=None, **more):
    """Return a frame in newtons."""
    valid = np.ones(5, bool) if valid is None else valid
    return PLAIN.convert(Frame(None, 0.0, 0.0, np.asarray(values, float), valid, **more))


def shown(subject):
    """Return the text in the terminal."""
    console = Console(width=120, record=True, force_terminal=True, file=StringIO())
    console.print(screen(subject, monotonic()))
    return console.export_text()


def fetch(address, data=None, **headers):
    """Return the status and the text that an address gives."""
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    try:
        with urllib.request.urlopen(urllib.request.Request(address, data, headers), timeout=30) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, ""


def test_no_peak_between_two_looks_is_missed():
    subject = display(0, 0, 0, 0, 0)
    seen = subject.state(monotonic()).number
    for height in (1, 7, 2):
        subject.add(frame(height * np.eye(5)[3]))
    state = subject.state(monotonic(), seen)
    assert state.values.tolist() == [0, 0, 0, 7, 0]
    assert subject.state(monotonic(), state.number).values[3] == 2


def test_where_output_is_no_terminal_a_line_tells_each_change(subject, tmp_path):
    with (tmp_path / "said").open("w") as file, show_in_terminal(subject, Console(file=file, width=60)):
        for verdict in (None, None, PRESSED, PRESSED):
            subject.set_verdict(verdict, monotonic(), "" if verdict else "taking the baseline: do not touch")
            sleep(0.2)
    said = [json.loads(line) for line in (tmp_path / "said").read_text().splitlines()]
    assert [line["event"] for line in said] == ["started", "change", "resumed", "alarm", "ended"]
    reasons = ["waiting for the first frame", "taking the baseline: do not touch"]
    assert [line["reason"] for line in said[:2]] == reasons
    assert (said[3]["alarm"], said[3]["labels"]) == (True, {"big": False, "dangerous": True})


def test_the_terminal_shows_the_alarm_and_the_probability(subject):
    subject.set_verdict(replace(SAFE, contact=0.1), monotonic())
    subject.add(frame([0, 0, 6.25, 0, 0]))
    subject.set_verdict(replace(PRESSED, contact=75.0), monotonic())
    subject.line = "99.9 Hz"
    text = shown(subject)
    assert "DANGEROUS" in text
    assert re.search(r"small .* 80 %", text)
    assert "strongest reading 6.2 N, sensor 2" in text
    assert "contacts unknown: this view estimates none" in text
    assert "99.9 Hz" in text
    assert re.search(r"contact since \d\d:\d\d:\d\d \(75 s\).*take a new tare", text, re.DOTALL)


def test_a_valid_guarantee_is_no_reason_and_hides_none(subject):
    subject.add_note(Note("guarantee_valid", detail="at most 0.1 % missed"))
    for verdict in (replace(PRESSED, touched=False), PRESSED):
        subject.set_verdict(verdict, now := monotonic())
        state = subject.state(now)
        message = verdict_message(subject.assess(now), state.notes, state.contacts, now)
        assert (message["reason"], message["notes"][0]["code"]) == ("", "guarantee_valid")
        assert "missed" not in shown(subject)
    subject.add_note(Note("clock", detail="late"))
    assert subject.state(monotonic()).reason == "late"


def test_the_page_gets_pictures_and_needs_nothing_from_elsewhere():
    subject = display(0, 0, 2.0, 0, 0, valid=LAST_INVALID)
    with web.serve_page(subject, 0) as address:
        code, page = fetch(address)
        assert code == 200
        assert not re.search(r"(src|href)\s*=|https?://|@import|url\(", page)
        assert json.loads(fetch(f"{address}/skin.json")[1])["positions"] == PLACES.tolist()
        subject.set_verdict(PRESSED, monotonic())
        with urllib.request.urlopen(f"{address}/pictures", timeout=30) as answer:
            line = answer.readline().decode()
    picture = json.loads(line.removeprefix("data: "))
    assert (picture["schema"], picture["dangerous"], picture["stale"]) == (1, True, False)
    assert picture["words"] == [["small", 0.8], ["dangerous", 0.9]]
    assert picture["values"][2] == 2.0
    assert picture["valid"] == [True, True, True, True, False]


@pytest.mark.parametrize("value", [1e300, -1e300, 1e10])
def test_the_page_gets_valid_json_whatever_the_device_sends(value):
    subject = display(0, value, 2.0, 0, 0)
    subject.set_verdict(Verdict(0, 0, {"big": float("inf")}, True, {"big": True}, False, False), monotonic())
    with web.serve_page(subject, 0) as address, urllib.request.urlopen(f"{address}/pictures") as answer:
        line = answer.readline().decode().removeprefix("data: ")
    picture = json.loads(line, parse_constant=pytest.fail)
    assert (picture["values"], picture["valid"][1]) == ([0, 0, 2, 0, 0], False)


def test_a_saturated_sensor_shows_its_limit_and_an_unknown_one_nothing():
    saturated = np.array([False, False, True, False, False])
    subject = display(1.0, 1.0, 4.0, 1.0, 9.0, valid=LAST_INVALID, saturated=saturated)
    state = subject.state(monotonic())
    assert state.values.tolist() == [1, 1, 4, 1, 0]
    assert state.saturated.tolist() == saturated.tolist()
    sent = web.message(state, monotonic())
    assert (sent["saturated"][2], sent["valid"][4], sent["values"][2]) == (True, False, 4.0)


def test_an_alarm_outlives_silence_in_every_view(subject):
    subject.set_verdict(PRESSED, monotonic())
    subject.set_verdict(None, monotonic(), "the device has stopped sending", alarm=True)
    state = subject.state(monotonic())
    assert state.assessment[::2] == (None, True)
    assert web.message(state, monotonic())["alarm"] is True
    text = shown(subject)
    assert "DANGEROUS" in text
    assert "stopped sending" in text


def test_the_page_asks_for_a_tare_and_other_sites_and_ports_in_use_are_refused(subject):
    with web.serve_page(subject, 0) as address:
        assert fetch(f"{address}/skin.json", Host="evil.example")[0] == 400
        with pytest.raises(InputError, match=r"live\.web_port="):
            web.serve_page(display(), int(address.rsplit(":", 1)[1])).__enter__()
        for headers, code in (({}, 403), ({"Origin": "http://evil.example"}, 403), ({"X-Skin": "tare"}, 204)):
            assert subject.take_tare(monotonic()) == ""
            assert fetch(f"{address}/tare", b"", **headers)[0] == code
        assert subject.take_tare(monotonic()) == "tare"
        assert fetch(f"{address}/tare")[0] == 405


def test_the_operator_types_t_for_a_tare(monkeypatch, tmp_path):
    master, slave = os.openpty()
    subject = display()
    with os.fdopen(slave) as typed, (tmp_path / "said").open("w") as file:
        monkeypatch.setattr("sys.stdin", typed)
        with show_in_terminal(subject, Console(file=file)):
            os.write(master, b"x\n")
            sleep(0.3)
            assert subject.take_tare(monotonic()) == ""
            os.write(master, b"t\n")
            assert requested(subject) == "tare"
            subject.set_verdict(PRESSED, monotonic())
            os.write(master, b"t\n")
            until(lambda: "tare refused" in subject.state(monotonic()).line)
            assert subject.take_tare(monotonic()) == ""
            os.write(master, b"force\n")
            assert requested(subject) == "tare_forced"
            os.write(master, b"\x04")
            sleep(0.1)
    os.close(master)


def shows(browser, script, wanted):
    until(lambda: browser.run(f"return {script}"), wanted=wanted)


def requested(subject):
    return until(lambda: subject.take_tare(monotonic()))


def test_a_tare_is_refused_under_a_touch_until_it_is_confirmed():
    subject, events = display(), []
    subject.observers.append(lambda assessment, now, event: event and events.append(event))
    assert subject.request_tare(monotonic(), force=True) != ""  # there is nothing to confirm
    for verdict in (PRESSED, replace(SAFE, contact=0.5), replace(IDLE, notes=(Note("void", (4,)),))):
        subject.set_verdict(verdict, monotonic())
        assert "something touches the skin" in subject.request_tare(monotonic())
        assert subject.take_tare(monotonic()) == ""
        assert subject.request_tare(monotonic(), force=True) == ""
        assert subject.take_tare(monotonic()) == ("tare" if verdict.notes else "tare_forced")
    subject.set_verdict(None, monotonic(), "the device has stopped sending", alarm=True)
    assert subject.request_tare(monotonic()) != ""
    subject.set_verdict(IDLE, monotonic())
    assert subject.request_tare(monotonic()) == ""
    refused = "tare_refused"
    assert events == [refused, *(refused, "tare_forced") * 2, refused, "tare", refused, "tare"]
    subject.set_verdict(PRESSED, monotonic())
    subject.request_tare(monotonic())
    subject.request_tare(monotonic(), force=True)
    assert (subject.take_tare(monotonic() + 2), events[-1]) == ("", refused)  # no frame came meanwhile


def test_a_refused_tare_is_said_while_it_may_be_forced():
    subject, refused = display(), loop.REFUSALS["touched"]
    subject.line = "99.9 Hz"
    subject.set_verdict(PRESSED, 100.0)
    assert subject.request_tare(100.0) == refused
    assert subject.request_tare(100.0, force=True) == ""
    assert subject.state(100.0).line == "99.9 Hz"  # it was forced
    assert subject.request_tare(100.0, force=True) == refused  # a refusal is for one
    assert subject.state(159.0).line == f"{refused}, 99.9 Hz"
    assert subject.state(161.0).line == "99.9 Hz"
    subject.set_verdict(IDLE, 161.0)
    assert "nothing to force" in subject.request_tare(161.0, force=True)
    assert subject.state(161.0).line == "there is nothing to force, 99.9 Hz"


def test_the_map_of_an_alarm_is_held_and_goes_with_the_touch(subject):
    subject.set_verdict(IDLE, monotonic())
    subject.add(frame([0, 0, 6.0, 0, 0]))
    subject.set_verdict(replace(SAFE, contact=0.1), monotonic())
    state = subject.state(monotonic())
    assert (state.held, state.peak[2]) == (False, 6.0)
    subject.add(frame([0, 0, 0.1, 0, 0]))
    for verdict in (PRESSED, replace(SAFE, contact=None)):
        subject.set_verdict(verdict, monotonic())
        state = subject.state(monotonic(), state.number)
        assert (state.held, state.peak[2], state.values[2]) == (True, 6.0, 0.1)
    # The next touch follows before the prediction is over: its map is its own.
    for _ in range(20):
        subject.add(frame(np.zeros(5)))
    subject.add(frame([0, 1.0, 0, 0, 0]))
    subject.set_verdict(replace(SAFE, contact=0.05), monotonic())
    assert subject.state(monotonic()).peak.tolist() == [0, 1, 0, 0, 0]
    subject.set_verdict(IDLE, monotonic())
    assert subject.state(monotonic()).peak.max() == 0


def test_an_unknown_place_is_not_shown_as_no_touch(subject):
    masked = {"unknown": (2,), "masked": (2,), "notes": (Note("masked", (2,)), Note("pause", seconds=0.7))}
    subject.set_verdict(replace(IDLE, labels={}, **masked), monotonic())
    sent = web.message(subject.state(monotonic()), monotonic())
    assert (sent["state"], sent["unknown"]) == ("unknown", [2])
    text = shown(subject)
    assert "no touch" not in text
    assert "near sensor 2 may stay undetected" in text
    assert "(and 1 more note)" in text
    subject.set_verdict(None, monotonic(), "readings are frozen")
    assert web.message(subject.state(monotonic()), monotonic())["unknown"] == [0, 1, 2, 3, 4]
    assert "unknown: readings are frozen" in shown(subject)


def test_the_page_goes_when_the_watching_ends(subject):
    with web.serve_page(subject, 0) as address:
        answer = urllib.request.urlopen(f"{address}/pictures", timeout=30)
        answer.readline()
        reader = Thread(target=answer.read)
        reader.start()
    reader.join(10)
    assert not reader.is_alive()
    answer.close()
    assert subject.closed.is_set()


@contextmanager
def repeated(subject, verdict):
    """Set a verdict again and again while the block runs, as decisions come: one alone becomes old."""
    over = Event()

    def repeat():
        while not over.wait(0.1):
            subject.set_verdict(verdict, monotonic())

    subject.set_verdict(verdict, monotonic())
    thread = Thread(target=repeat)
    thread.start()
    yield
    over.set()
    thread.join()


def test_the_page_draws_what_it_is_sent(browser):
    subject = display(0, 0, 2.0, 0, 0, valid=LAST_INVALID)
    subject.line = "99.9 Hz"
    with web.serve_page(subject, 0) as address, repeated(subject, PRESSED):
        browser.open(address)
        shows(browser, "pictures >= 5", True)
        text = browser.run("return document.body.innerText")
        colour = browser.run(AT.format(*PLACES[2, :2] / SIZE))
        assert browser.run("return document.body.dataset.state") == "danger"
        shows(browser, "document.documentElement.scrollHeight <= innerHeight", True)
    for said in ("DANGEROUS", "80 %", "90 %", "about the last 3 s", "99.9 Hz", "/dev/skin"):
        assert said in text
    # A disc at half of the scale: between teal and yellow, and not the darkness of no force.
    assert min(colour[:2]) > 60


def test_the_map_draws_the_mean_pressure_of_the_posterior(browser):
    """Far fewer sensors than fingers leave a wide region: the pressure is spread over it."""
    samples = np.random.default_rng(0).normal([0.08, 0.06], [0.003, 0.008], (20_000, 2))
    weights, x, y = np.histogram2d(*samples.T, bins=(20, 40), range=((0.06, 0.1), (0.02, 0.1)), density=False)
    cells, share = np.argwhere(weights), 1.0
    region = {"origin": [x[0] + 0.001, y[0] + 0.001], "cell": [0.002, 0.002], "cells": cells.tolist()}
    region |= {"share": share, "probabilities": (weights[tuple(cells.T)] / weights.sum()).tolist()}
    contact = {"force": 5.0, "radius": 0.008, "radius_deviation": 0.002, "region": region}
    with web.serve_page(display(), 0) as address:
        browser.open(address)
        shows(browser, "Boolean(skin)", True)
        drawn = browser.run(f"return [...expected({json.dumps([contact])}, 80, 60, 0.002)]")
    drawn = np.reshape(drawn, (60, 80))
    assert drawn.sum() * 0.002**2 == pytest.approx(5.0, rel=0.01)
    radii = 0.008 + 0.002 * np.sqrt(3) * np.random.default_rng(1).uniform(-1, 1, len(samples))  # as the prior
    peak = FingertipPrior().peak(radii) * 5.0
    for row, column in ((30, 40), (30, 43), (36, 40), (40, 42)):
        away = np.linalg.norm(samples - [(column + 0.5) * 0.002, (row + 0.5) * 0.002], axis=1)
        mean = np.mean(peak / (1 + np.exp((away - radii) / 0.0015)))
        assert drawn[row, column] == pytest.approx(mean, rel=0.1)


@pytest.mark.parametrize("state", ["contacts", "not a fingertip", "unknown"])
def test_pressure_is_drawn_where_contacts_explain_the_readings(browser, state):
    region = {"share": 1.0, "origin": [0.08, 0.09], "cell": [0.002, 0.002], "cells": [[0, 0]]}
    contact = {"force": 20.0, "force_deviation": 1.0, "radius": 0.01, "radius_deviation": 0.001}
    contact |= dict.fromkeys(("x", "y"), 0.08) | dict.fromkeys(("x_deviation", "y_deviation"), 0.001)
    contact |= {"peak_interval": [4e4, 9e4], "region": region | {"probabilities": [1.0]}}
    subject = display()
    subject.contacts._latest = {
        **unknown_contacts("being prepared"), "state": state, "number": 1, "probability": 1.0, "fit": 0.0,
        "large": 1.0, "device_time": 1.0, "contacts": [contact] * (state != "unknown"),
    }, np.inf  # fmt: skip
    subject.add(frame([0, 0, 2.0, 0, 0]))
    with web.serve_page(subject, 0) as address, repeated(subject, SAFE):
        browser.open(address)
        shows(browser, "pictures >= 3", True)
        colour = browser.run(AT.format(0.078 / SIZE[0], 0.083 / SIZE[1]))
    # Yellow is near the limit of dangerous; the dark of the skin says that nothing is known to press there.
    assert (min(colour[:2]) > 90) == (state == "contacts")


ANNOUNCED = "pictures > 0 && [...document.querySelectorAll('[role=alert]')].map(one => one.textContent)"


def test_the_page_announces_an_alarm_and_its_end_once(browser):
    subject = display(0, 0, 2.0, 0, 0)
    subject.set_verdict(None, monotonic(), "taking the baseline")
    with web.serve_page(subject, 0) as address:
        browser.open(address)
        shows(browser, ANNOUNCED, [""])
        browser.run(
            "window.changes = 0; new MutationObserver(() => changes++)"
            ".observe(document.querySelector('[role=alert]'), {childList: true, characterData: true})"
        )
        subject.set_verdict(PRESSED, monotonic())
        shows(browser, ANNOUNCED, ["Alarm: dangerous touch"])
        subject.set_verdict(None, monotonic(), "the device has stopped sending", alarm=True)
        shows(browser, "document.body.innerText.includes('stopped sending')", True)
        assert browser.run("return changes") == 1
        assert browser.run("return document.getElementById('head').getAttribute('role')") == "status"
        subject.set_verdict(None, monotonic(), "the device has stopped sending")
        shows(browser, ANNOUNCED, [""])


CROSSED = "latest && latest.values.length + ' of ' + skin.positions.length + ' on ' + $('port').textContent"


def test_the_page_goes_on_after_a_restart_with_more_sensors(browser):
    subject, now = display(), "performance.now() - drawn < 1000"
    subject.add(frame([0, 0, 2.0, 0, 0]))
    with web.serve_page(subject, 0) as address:
        browser.open(address)
        shows(browser, CROSSED, "5 of 5 on /dev/skin")
    positions = np.concatenate([PLACES, PLACES + np.array([0.01, 0.01, 0])])
    other = Display("any_skin", "/dev/other", positions, SIZE, 4.0)
    verdict = replace(IDLE, unknown=(7, 9), masked=(7, 9))
    with web.serve_page(other, int(address.rsplit(":", 1)[1])), repeated(other, verdict):
        shows(browser, CROSSED, "10 of 10 on /dev/other")
        before = browser.run("return pictures")
        shows(browser, f"pictures > {before + 5} && {now}", True)
        shows(browser, "$('title').textContent + ': ' + $('time').textContent", "any_skin: Map: now")


def test_the_map_of_a_program_that_has_ended_is_outdated(browser):
    subject = display(0, 0, 2.0, 0, 0)
    subject.line = "99.9 Hz"
    bright = "getComputedStyle($('map')).filter"
    with web.serve_page(subject, 0) as address:
        browser.open(address)
        with repeated(subject, IDLE):
            shows(browser, "$('time').textContent", "Map: now")
            assert browser.run(f"return {bright}") == "none"
        shows(browser, "$('head').textContent", "unknown: no decision for longer than usual")
        subject.set_verdict(None, monotonic(), "the device has stopped sending")
        shows(browser, "$('time').textContent", "Map: last readings")
    shows(browser, "$('time').textContent", "Map: outdated, no answer from the program")
    assert "grayscale" in browser.run(f"return {bright}")
    assert browser.run("return $('line').textContent") == ""
    assert browser.run("return document.body.dataset.state") == "unknown"


def test_a_page_without_an_answer_says_unknown_and_keeps_the_alarm(browser, monkeypatch):
    """The program hangs, though its connection stays open."""
    subject, over = display(), Event()
    subject.add(frame([0, 0, 6.0, 0, 0]))
    with web.serve_page(subject, 0) as address:
        browser.open(address)
        with repeated(subject, PRESSED):
            shows(browser, "$('head').textContent", "⚠ DANGEROUS")
        said = "⚠ DANGEROUS; unknown: no answer from the program for 1.5 s"
        with monkeypatch.context() as patch:
            patch.setattr(subject, "state", lambda *_: over.wait(60))
            shows(browser, "$('head').textContent", said)
        over.set()


def test_the_page_shows_the_gravest_note_and_no_probability_beside_an_alarm_of_late_frames(browser):
    subject = display(0, 0, 6.0, 0, 0)
    notes = (Note("over_range", (2,)), Note("masked", (4,)))
    safe = replace(SAFE, labels={"big": False, "dangerous": False}, notes=notes)
    with web.serve_page(subject, 0) as address:
        browser.open(address)
        with repeated(subject, safe):
            shows(browser, "$('bars').innerText.includes('dangerous?')", True)
            note = browser.run("return $('note').textContent")
            assert "values of sensor 2 were lost under a force" in note
            assert note.endswith("(and 1 more note)")
            subject.set_verdict(PRESSED, monotonic())
            shows(browser, "document.body.dataset.state", "danger")
            assert "safe" not in browser.run("return $('bars').innerText")
