"""The command, with an emulated skin before it and a browser behind it; what is said of a run at a port."""

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import ExitStack

import pytest
from mcap.reader import make_reader

from skin.core.files import ROOT
from skin.runs.build import build_device, equation10_warning
from tests.wire.memory import until

SMALL = [
    "experiment=rules",
    "simulator=naive",
    "data.gestures=1000",
    "device.test_gestures=96",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
]
WATCH = """
window.log = [];
const note = () => log.push([document.body.dataset.state, document.getElementById("head").textContent,
                             getComputedStyle(document.body).backgroundColor]);
new MutationObserver(note).observe(document.getElementById("head"), {childList: true, subtree: true});
note();
"""


@pytest.fixture(scope="module")
def store(run, tmp_path_factory):
    """The overrides that lead to a store with one run of rules."""
    folder = tmp_path_factory.mktemp("live")
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]
    done = run(folder, "train.py", *SMALL)
    assert done.returncode == 0, done.stderr
    return own


@pytest.mark.slow("starts a live view and a browser")
def test_a_dangerous_press_turns_the_page_red_and_a_replugged_skin_heals_it(begin, store, browser, tmp_path):
    link = f"link={tmp_path / 'skin'}"
    pace = ["emulate.rate=50", "emulate.gap=1.5", "emulate.unplug=[20,60,100,150,200]"]
    with ExitStack() as both:
        emulator = both.enter_context(begin(tmp_path, "emulate", "simulator=naive", link, *pace))
        told = until(lambda: re.search(r"device=serial (.*)\n", emulator.out), emulator)
        reader = ["device=serial", *told[1].split(), "device.backoff=[0.2,0.5]"]
        live = both.enter_context(begin(tmp_path, "live.py", *reader, "web=true", "live.web_port=0", *store))
        page = until(lambda: re.search(r"page: (http\S+)", live.err), live)[1]
        browser.open(page)
        browser.run(WATCH)
        log = lambda: browser.run("return log")  # noqa: E731
        red = until(lambda: [entry for entry in log() if entry[0] == "danger"], live)
        assert "DANGEROUS" in red[0][1]
        assert red[-1][2] == "rgb(163, 13, 29)"
        away = until(lambda: [n for n, entry in enumerate(log()) if "unplugged" in entry[1]], live)
        # An alarm stays while the skin is away.
        assert log()[away[0]][0] in ("unknown", "danger")
        after = lambda: [entry[0] for entry in log()[away[0] :] if "unplugged" not in entry[1]]  # noqa: E731
        healed = lambda: {*after()} & {"idle", "touch", "danger"}  # noqa: E731
        until(healed, live)
        assert browser.run("return pictures") > 20
        line = lambda: browser.run("return document.getElementById('line').textContent")  # noqa: E731
        until(lambda: "reconnected" in line(), live)  # it is updated twice a second
        live.send_signal(signal.SIGINT)
        assert live.wait(60) == 0, live.err
    assert '"alarm": true' in live.out
    assert "unplugged" in live.out
    assert "Traceback" not in live.err
    assert re.search(r"gesture \d+: .*(?<!not )dangerous", emulator.out), emulator.out


@pytest.mark.slow("starts a live view of the simulator")
def test_the_simulator_is_watched_without_hardware(run, store, tmp_path):
    path = tmp_path / "live.mcap"
    live = run(tmp_path, "live.py", "seconds=5", f"live.record={path}", *store, store=False)
    assert live.returncode == 0, live.stderr
    assert re.search(r"\d+ verdicts, 10\.0 Hz", live.stderr)
    assert json.loads(live.stdout.splitlines()[0])["event"] == "started"
    with path.open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert topics == {"/skin/readings", "/skin/verdict", "/skin/contacts"}


COLLECTING = """
import gc, runpy, sys, time
from skin.live.loop import LiveLoop

def take(loop, frames, now, take=LiveLoop.take):
    take(loop, frames, now)
    began = time.perf_counter()
    gc.collect()
    pauses.append(time.perf_counter() - began)

pauses, LiveLoop.take = [], take
try:
    runpy.run_module("skin", run_name="__main__")
finally:
    print(len(pauses), sorted(pauses)[len(pauses) // 2], file=sys.stderr)
"""


@pytest.mark.slow("imports all libraries anew and waits")
def test_a_search_for_garbage_does_not_delay_a_verdict(tmp_path):
    """Among all that torch loads it takes 0.3 s, every few seconds."""
    settings = ["run=any_skin", "seconds=3", "live.patience.above=0.5", "live.contacts=false"]
    done = subprocess.run(
        [sys.executable, "-c", COLLECTING, "live", *settings, f"tracking.uri=sqlite:///{tmp_path}/m.db"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    count, pause = done.stderr.split()[-2:]
    assert int(count) > 10
    assert float(pause) < 0.05


PORT = ("device=serial", "device.port=/dev/ttyACM0", "device.scale=0.04")


@pytest.mark.parametrize(
    ("trained", "warned"),
    [
        (["simulator=fem"], True),
        (["simulator=fem", "simulator.reading=interface"], False),
        (["simulator=solid"], False),
    ],
)
def test_a_run_on_equation_10_is_announced_at_a_port_only(configured, trained, warned):
    stored = configured(*trained)
    said = equation10_warning(stored, build_device(configured(*PORT)))
    assert (said is not None) == warned
    assert said is None or "simulator=solid" in said
    assert equation10_warning(stored, build_device(configured("simulator=naive"))) is None
