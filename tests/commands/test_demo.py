"""`skin live demo=true` as a person starts and ends it."""

import json
import re
import signal
import socket
from contextlib import suppress
from time import monotonic, sleep
from urllib.request import urlopen

import psutil
import pytest

PATIENCE = 240  # s, on a machine that is busy with other things


def page_of(demo):
    deadline = monotonic() + PATIENCE
    while monotonic() < deadline and demo.poll() is None:
        if found := re.search(r"^page: (http://127\.0\.0\.1:\d+)$", demo.err, re.M):
            return found[1]
        sleep(0.1)
    raise AssertionError(f"no page: {demo.err}")


def pictures(page):
    deadline = monotonic() + PATIENCE
    with urlopen(f"{page}/pictures", timeout=PATIENCE) as events:
        for line in events:
            assert monotonic() < deadline
            if line.startswith(b"data: "):
                yield json.loads(line.removeprefix(b"data: "))


def refuses(address):
    """Return whether nothing listens at ``scheme://host:number``."""
    host, number = address.rsplit("/", 1)[1].split(":")
    with suppress(ConnectionRefusedError), socket.create_connection((host, int(number)), timeout=5):
        return False
    return True


@pytest.mark.slow("starts the demo, with two processes")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_page_shows_an_emulated_skin_until_a_signal_ends_both(begin, tmp_path, number, code):
    store = f"tracking.uri=sqlite:///{tmp_path}/m.db"
    # The choice of the threshold, which is tested elsewhere, takes a minute.
    fast = "live.patience.above=0.97", "live.touch=0.3"
    with begin(tmp_path, "live", "demo=true", "live.web_port=0", *fast, store) as demo:
        page = page_of(demo)
        with urlopen(page, timeout=PATIENCE) as answer:
            assert b"<!doctype html>" in answer.read()
        touched = next(picture for picture in pictures(page) if picture["contacts"]["state"] == "contacts")
        with urlopen(f"{page}/skin.json", timeout=PATIENCE) as answer:
            known = json.load(answer)
        assert (known["title"], len(known["positions"])) == ("any_skin", 36)
        assert known["port"].startswith("socket://127.0.0.1:")
        assert len(touched["contacts"]["contacts"]) == touched["contacts"]["number"]
        assert " kPa" in touched["contact_text"][1]
        touched = next(picture for picture in pictures(page) if picture.get("touched"))
        assert len(touched["words"]) == 4
        children = psutil.Process(demo.pid).children()
        demo.send_signal(number)
        assert demo.wait(PATIENCE) == code, demo.err
    psutil.wait_procs(children, PATIENCE)
    assert not any(child.is_running() for child in children)
    assert refuses(page)
    assert refuses(known["port"])
    assert "Traceback" not in demo.err


@pytest.mark.slow("chooses a threshold anew")
@pytest.mark.parametrize("killed", [False, True])
def test_verdicts_begin_with_a_provisional_threshold(begin, tmp_path, monkeypatch, killed):
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))
    words = "layout=grid", "layout.rows=3", "layout.columns=3", "evaluation.safe_gestures=400"
    with begin(tmp_path, "live", "demo=true", "live.web_port=0", *words) as demo:
        shown = pictures(page_of(demo))
        assert "model" not in demo.err.partition("page: ")[0]
        assert next(shown)["stale"]
        assert any("threshold of the alarm is being chosen" in json.dumps(picture) for picture in shown)
        notes = ({note["code"]: note["text"] for note in one["notes"]} for one in shown if not one["stale"])
        assert "provisional" in next(notes)
        view = psutil.Process(demo.pid)
        choosing = next(child for _ in notes for child in view.children() if child.nice() == 10)
        children = view.children()
        if killed:
            choosing.kill()
            assert any("stays so: the process" in told.get("provisional", "") for told in notes)
        else:
            assert any("provisional" not in told for told in notes)
        demo.send_signal(signal.SIGINT)
        assert demo.wait(PATIENCE) == 0, demo.err
        psutil.wait_procs(children, PATIENCE)
        assert not any(child.is_running() for child in children)


@pytest.mark.slow("starts the demo, with two processes, and solves its skin")
def test_the_shipped_threshold_is_of_the_emulated_device(run, tmp_path, monkeypatch):
    """A change of the demo's skin, or of what describes one, needs ``skin export format=thresholds`` anew."""
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))  # nothing else is kept there
    done = run(tmp_path, "live", "demo=true", "live.web_port=0", "live.contacts=false", "seconds=2")
    assert "100.0 Hz" in done.stdout + done.stderr
    assert "choosing" not in done.stderr


@pytest.mark.slow("starts the demo, with two processes")
def test_what_is_killed_leaves_no_process_and_no_port(begin, tmp_path):
    words = "demo=true", "live.web_port=0", "live.patience.above=0.97", "web=true"
    with begin(tmp_path, "live", *words) as demo:
        page = page_of(demo)
        next(picture for picture in pictures(page) if not picture["stale"])
        children = psutil.Process(demo.pid).children()
        demo.send_signal(signal.SIGKILL)
        psutil.wait_procs(children, PATIENCE)
        assert children
        assert not any(child.is_running() for child in children)
    assert refuses(page)
