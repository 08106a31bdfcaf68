"""The device on which the alarm's threshold is chosen, for a skin and for the imperfections of a device."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir

from skin.core.files import CONF
from skin.device.calibration import Calibration, write_calibration
from skin.errors import InputError
from skin.evaluation import alarm
from skin.evaluation.alarm import choose_alarm_threshold, profile_settings
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.operating_point import DangerScore, OperatingPoint
from skin.runs.build import alarm_source
from skin.runs.configuration import validate_config
from skin.runs.run import TAG, FinishedRun

SMALL = ["simulator=naive", "data.gestures=40", "evaluation.safe_gestures=16"]
SKINS = ("device=skins", "device.count=1")
STORED = OperatingPoint(0.875, 0.02, 5000, 99, 0)


@pytest.fixture
def hydra():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield lambda *words: validate_config(compose("train", [*SMALL, *words]))


def threshold_device(stored, config):
    return alarm.threshold_device(alarm_source(run_of(stored, STORED), None, config))


def test_a_profile_replaces_the_imperfections_of_the_training(hydra, tmp_path):
    stored = hydra("seed=3", "device.quantum=0.1")
    device = threshold_device(stored, hydra("evaluation.profile=calibrated", "layout=grid", "layout.rows=3"))
    assert device.randomise
    assert (device.gain_spread, device.noise, device.dead, device.tare) == (0.02, 0.1, [0, 2], True)
    # What a profile does not name is that of the training; the skin is the new one.
    assert (device.quantum, device.data_seed, len(device.sensors)) == (0.1, 3, 15)
    stored = hydra(f"device.calibration={tmp_path}/gone.yaml")
    assert threshold_device(stored, hydra("evaluation.profile=mild")).calibration is None
    for profile in ("rough", "drawn"):
        device = threshold_device(hydra(*SKINS), hydra(f"evaluation.profile={profile}"))
        assert (device.randomise, device.noise) == (True, profile_settings(profile)["noise"])


def test_the_evaluated_device_counts_with_its_rate_and_alignment(hydra):
    changes = ["profile=rough", "device.rate=100", "device.aligned=false", "evaluation.profile=device"]
    for stored in (hydra(*SKINS), hydra("device.seed=3")):
        device = threshold_device(stored, hydra(*changes))
        assert (device.randomise, device.rate, device.aligned, device.gain_spread) == (True, 100, False, 0.2)


def test_a_profile_counts_at_the_rate_and_alignment_of_the_evaluated_device(hydra):
    """False alarms of lagging devices depend on them; a run of drawn devices has many."""
    mixed = ("device.rate=[10,1000]", "device.aligned=false", "device.framed=0.2", "device.without_lag=0.5")
    stored = hydra(*SKINS, *mixed)
    frames = threshold_device(stored, hydra("evaluation.profile=calibrated"))
    assert (frames.rate, frames.aligned, frames.framed, frames.gain_spread) == (10.0, True, 0.0, 0.02)
    assert frames.without_lag == 0.0
    sampled = hydra("device.rate=100", "device.aligned=false", "evaluation.profile=calibrated")
    assert (threshold_device(stored, sampled).rate, threshold_device(stored, sampled).aligned) == (100, False)
    other = hydra("device=recording", "device.path=x", "evaluation.profile=calibrated")
    unknown = threshold_device(stored, other)
    assert (unknown.rate, unknown.framed, unknown.without_lag) == ([10, 1000], 0.0, 0.0)


def run_of(config, point, weights=None):
    """Return as much of a run as its operating point is read from."""
    data = SimpleNamespace(tags={TAG: point.text()})
    run = FinishedRun(None, SimpleNamespace(data=data, info=SimpleNamespace(run_id="abc", weights=weights)))
    run.__dict__["stored"] = config
    return run


class Quiet:
    """Finds every touch a little dangerous."""

    def probabilities(self, touches):
        return torch.full((len(touches), 4), 0.25)


def alarm_point(stored, config, *live, **how):
    """Return where a run of this configuration raises the alarm on the device of another."""
    return choose_alarm_threshold(alarm_source(run_of(stored, STORED), Quiet(), config), *live, **how)


def test_the_stored_threshold_holds_but_for_another_profile_and_for_one_of_many_skins(hydra):
    one, skins, rough = hydra(), hydra(*SKINS), hydra("evaluation.profile=rough")
    for config in (one, skins, rough):
        assert alarm_point(config, config) == STORED
    for run, config, one_skin in ((one, rough, False), (skins, one, False), (skins, skins, True)):
        point = alarm_point(run, config, one_skin=one_skin)
        assert 0.25 < point.threshold < 0.2501


def test_a_profile_is_refused_where_the_device_draws_many_skins(hydra):
    many = hydra(*SKINS, "evaluation.profile=device")
    with pytest.raises(InputError, match="the threshold for one skin: add device=simulated"):
        alarm_point(many, many)


@pytest.fixture
def device_of(tmp_path, monkeypatch):
    devices = []

    def choose(device, learner, live, target, count):
        devices.append(device)
        return replace(STORED, score=DangerScore(1.0, 0.0, 0.0))

    def device_of(stored, config):
        alarm_point(stored, config, LiveConditions(100.0, 0.1, 2.0, 0.1, 3), say=print)
        return devices[-1]

    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))
    monkeypatch.setattr(alarm, "_on_touches_of", choose)
    return device_of


def calibrated(hydra, path, **sensors):
    values = {"gain": 1.0, "noise": 0.03} | sensors
    every = {name: value if isinstance(value, list) else [value] * 25 for name, value in values.items()}
    calibration = Calibration(every, exponent_at=4.0)
    path = write_calibration(calibration, path)
    return hydra("device=serial", "device.port=x", f"device.calibration={path}")


def test_the_noise_of_sensors_that_follow_the_root_of_force_is_that_of_force(hydra, device_of, tmp_path):
    device = device_of(hydra(), calibrated(hydra, tmp_path / "fsr.yaml", exponent=0.5))
    assert device.imperfection.noise == pytest.approx(0.06, rel=0.01)  # N, at 4 N


def test_a_calibrated_device_has_the_lag_of_its_calibration(hydra, device_of, tmp_path):
    """Its unknown gains may be any. The run had devices without lag, and with frames."""
    mixed, gains = hydra(*SKINS, "device.framed=0.2", "device.without_lag=0.5"), [None, *[0.8, 1.3] * 12]
    device = device_of(mixed, calibrated(hydra, tmp_path / "slow.yaml", time_constant=0.05, gain=gains))
    assert device.gain_spread == pytest.approx(0.24, abs=0.01)
    assert (device.time_constant, device.without_lag, device.framed) == (0.05, 0.0, 0.0)


def test_touches_of_a_run_of_drawn_skins_are_measured_by_mild_devices(hydra, device_of):
    """One threshold for all devices of its training would hide dangerous touches on a usual one."""
    skins = hydra(*SKINS)
    assert device_of(skins, skins).noise == profile_settings("mild")["noise"]
    rough = hydra(*SKINS, "evaluation.profile=rough")
    assert device_of(skins, rough).noise == profile_settings("rough")["noise"]
    assert device_of(hydra("profile=rough"), hydra()).noise == profile_settings("rough")["noise"]


def test_a_provisional_threshold_is_lower_until_the_final_one_is_kept_or_ships(hydra, tmp_path, monkeypatch):
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path / "cache"))
    live, config = LiveConditions(20.0, 0.1, 2.0, 0.1, 3), hydra("evaluation.safe_gestures=320")
    for count in ("DANGEROUS_TOUCHES", "FITTED_TOUCHES"):
        monkeypatch.setattr(alarm, count, 100)
    run = run_of(config, STORED, tmp_path / "weights.pt")
    source = alarm_source(run, Quiet(), config)
    first = choose_alarm_threshold(source, live, say=print, quick=True)
    assert (first.provisional, first.safe, first.dangerous) == (True, 200, 100)
    (tmp_path / "weights.pt").write_bytes(b"these")
    alarm.ship_thresholds(source, [live], print)
    final = choose_alarm_threshold(source, live, say=pytest.fail, quick=True)
    assert (final.provisional, final.safe, final.rate) == (False, 320, 20.0)
    assert first.threshold < final.threshold
    # Shipped thresholds are those of the weights.
    (tmp_path / "weights.pt").write_bytes(b"others")
    said = []
    assert choose_alarm_threshold(source, live, say=said.append, quick=True) == first
    assert "thresholds.json is damaged or of other weights, and not used" in said[0]
    assert choose_alarm_threshold(source, live, say=print) == final
    kept = replace(source, weights=None)
    assert choose_alarm_threshold(kept, live, say=pytest.fail, quick=True) == final
    alarm.ship_thresholds(source, [], print)  # leaves those of other weights out
    assert json.loads((tmp_path / alarm.THRESHOLDS).read_text())["skins"] == {}


def test_a_threshold_that_hides_dangerous_touches_is_refused():
    hiding = OperatingPoint(0.9996, 0.02, 2000, 39, 0, 400, 250, 100.0)
    with pytest.raises(InputError, match=r"finds 62\.5 % of 400 dangerous ones: it hides dangerous touches"):
        hiding.announced(print)


@pytest.mark.parametrize(
    ("trained", "used", "reason"),
    [
        ("device=recording", "evaluation.profile=rough", "trained on others"),
        ("seed=0", "evaluation.profile=soft", "no profile soft: choose one of calibrated, drawn, harsh"),
        ("seed=0", "evaluation.profile=device", "device=simulated"),
    ],
)
def test_runs_on_other_touches_and_unknown_profiles_are_refused(hydra, trained, used, reason):
    recording = ["device=recording", "device.path=x.csv"] if used.endswith("device") else []
    stored = hydra(trained, *(["device.path=x.csv"] if "recording" in trained else []))
    with pytest.raises(InputError, match=reason):
        threshold_device(stored, hydra(used, *recording))
