"""The threshold of the alarm "dangerous": the one place where it is chosen.

:func:`choose_alarm_threshold` is called once by each command. torch is imported only where touches decide.

Safe touches are more easily mistaken on some skins and devices than on others, so the false-alarm rate of a
threshold that was chosen over many of them varies from skin to skin. That for single windows is stored with a
model. That of the live view, which judges many windows of a touch, depends on the rate of the device, too.
"""

import json
import logging
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, field, fields, replace
from functools import partial
from math import log
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from scipy.special import bdtrik

from skin.core.files import CONF, whole
from skin.core.progress import Steps
from skin.core.rng import Stream, generator
from skin.core.safe_loading import TEXT, parse_json, read_file
from skin.device.calibration import read_calibration
from skin.errors import InputError
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.guarantee import (
    Guarantee,
    counted,
    threshold_above,
    threshold_for_misses,
    touches_drawn,
)
from skin.evaluation.operating_point import (
    LABEL,
    DangerScore,
    OperatingPoint,
    Predictor,
    dangerous_column,
    parse_operating_point,
)
from skin.evaluation.settings import ENOUGH, Evaluation, check_evaluation
from skin.mechanics import array_cache
from skin.touch.labels import TOUCH

if TYPE_CHECKING:
    from torch import Tensor

    from skin.device.base import AbstractDevice
    from skin.device.simulated import Simulated
    from skin.device.touches import Touches

DANGEROUS_TOUCHES = 400
"""Dangerous touches on which a threshold of the live view is checked: 75 % are then 71 to 79 % (95 %)."""
FITTED_TOUCHES = 300
"""Safe touches, and as many dangerous ones, to which a score is fitted; fits to 1200 found no more."""
PROVISIONAL = 200, 100
"""Safe and dangerous touches of a provisional threshold: 4 s of one core; 100 of each fit its score."""
_HIGHEST = 0.5  # score of a touch from which a threshold for few missed ones need not know it
_LOWER = 0.95  # probability that a provisional threshold is no higher than that of the wanted rate
THRESHOLDS = "thresholds.json"
"""File beside the weights of a pretrained model: thresholds for touches, by the hash of what decides them."""
_USUAL = "mild"
_EVERY = {"without_lag": 0.0, "framed": 0.0}  # every device is as described, whatever the training mixed in
_DEVICE = "device"  # in place of a profile: the imperfections of the device that is evaluated
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class AlarmSource:
    """What decides where a model raises the alarm.

    Attributes:
        name: of the model, for messages, as in ``run 3e066519``.
        settings: ``evaluation.false_alarm_rate``, ``safe_gestures`` and ``profile``; None: exported.
        learner: of the model, trained; None: an exported network, which brings its thresholds.
        trained: settings of the device of its training.
        used: settings of the device that it is used on.
        skin: settings of the skin that it is used on.
        build: settings of a device -> the device of the training with these, on the skin that it is used on.
        original: -> the device of the training, on the skin of the training.
        device: whose fresh gestures, or validation split, decide; None: that of :func:`threshold_device`.
        stored: text of the point that the training chose for single windows; None: it has none.
        profile: for which it was chosen.
        exported: point of an exported network, for single windows; None: no label ``dangerous``.
        points: of an exported network: rate of a device, Hz -> point for touches.
        weights: file of a pretrained model, beside which :data:`THRESHOLDS` ships; None: it is none.
    """

    name: str
    settings: Evaluation | None = None
    learner: Predictor | None = None
    trained: Mapping[str, Any] = field(default_factory=dict)
    used: Mapping[str, Any] = field(default_factory=dict)
    skin: Mapping[str, Any] = field(default_factory=dict)
    build: "Callable[[Mapping[str, Any]], AbstractDevice] | None" = None
    original: "Callable[[], AbstractDevice] | None" = None
    device: "AbstractDevice | None" = None
    stored: str | None = None
    profile: str | None = None
    exported: OperatingPoint | None = None
    points: Mapping[str, OperatingPoint] = field(default_factory=dict)
    weights: Path | None = None


def choose_alarm_threshold(
    source: AlarmSource,
    live: LiveConditions | None = None,
    above: float | None = None,
    anew: bool = False,
    one_skin: bool = False,
    say: Callable[[str], None] = _log.warning,
    quick: bool = False,
) -> OperatingPoint | None:
    """Return where a model raises the alarm; None if it has no label ``dangerous``.

    The first rule that applies decides:

    1. ``above`` holds, whatever the model.
    2. An exported network brings thresholds: that of the nearest rate for touches, else that for windows.
    3. Simulated touches on the skin in use decide for a live view (:func:`threshold_device`).
    4. The stored threshold holds on the skins and for the profile that it was chosen for, and for models that
       were trained on recordings. For another target it is chosen again.
    5. Gestures on the skin in use decide, one window of each.

    Args:
        source: the model and what it is used on.
        live: per touch, as a live view watches it; None: per window.
        above: threshold of the command line (``live.patience.above``).
        anew: the model is new, so nothing stored holds.
        one_skin: the skin in use counts even if its device draws others.
        say: called with each message for the user.
        quick: for touches, a provisional threshold will do where none is kept.

    Raises:
        InputError: the settings cannot be used, an exported network raises no alarm, a stored operating
            point cannot be read, or a profile is set and the device draws many skins; see also
            :func:`threshold_device`.
    """
    if above is not None:
        exported = any(point.guarantee for point in source.points.values())
        promised = exported or (source.settings and source.settings.miss_rate)
        say(f"alarm above {above:g}" + ", for which no guarantee holds" * bool(promised))
        return OperatingPoint(above)
    if source.learner is None:
        return _exported_point(source, live, say)
    settings = check_evaluation(source.settings)
    if live is not None and (anew or "simulator" in source.trained):
        return _on_touches(source, settings, live, say, quick)
    if not anew:
        all_skins = "skins" in source.used and not one_skin
        if all_skins and settings.profile is not None:
            raise InputError("evaluation.profile chooses the threshold for one skin: add device=simulated")
        as_stored = "skins" not in source.trained and settings.profile == source.profile
        if live is not None or all_skins or as_stored:
            return _stored_point(source, settings)
    return _on_gestures(source.learner, source.device or threshold_device(source), settings)


def _exported_point(
    source: AlarmSource, live: LiveConditions | None, say: Callable[[str], None]
) -> OperatingPoint | None:
    """Return the point of an exported network for the rate of a device that is nearest."""
    point = source.exported
    if point is None or live is None:
        return point
    if source.points:
        nearest = min(source.points, key=lambda text: abs(log(float(text) / live.rate)))
        say(f"the device sends {live.rate:.3g} frames a second: threshold for {nearest} Hz, per touch")
        point = source.points[nearest]
        if point.guarantee is not None:
            promise = point.guarantee.under(live)
            say(promise.sentence())
            point = replace(point, guarantee=promise)
    else:
        say("the threshold was chosen for single windows: a touch has many, and raises more false alarms")
    if point.silent:
        raise InputError(f"{source.name} has no threshold that raises an alarm: give live.patience.above=0.5")
    say(f"alarm above {point.threshold:.4f}")
    return point


def _stored_point(source: AlarmSource, settings: Evaluation) -> OperatingPoint | None:
    """Return the point that is stored with a model.

    If it has none for the target rate, it is chosen now if the device of its training draws fresh gestures;
    else the threshold is 0.5. Both cases are reported on standard error.
    """
    target = settings.false_alarm_rate
    point = None if source.stored is None else parse_operating_point(source.stored)
    if source.stored is not None and (point is None or point.target == target):
        return point
    lacks = f"{source.name} stores no alarm threshold for {100 * target:g} % false alarms"
    if "simulator" in source.trained:
        assert source.learner is not None
        assert source.original is not None
        point = _on_gestures(source.learner, source.original(), settings)
        message = None if point is None else f"{lacks}, it is chosen now: {point.sentence()}"
    else:
        point = point or OperatingPoint(0.5, target)
        message = (
            f"{lacks} and its device draws no fresh gestures: {point.sentence()}; train it again to store one"
        )
    if message:
        _log.warning(message)
    return point


# The device whose touches decide.


def threshold_device(source: AlarmSource) -> "Simulated":
    """Return the device whose fresh gestures determine the threshold of the alarm.

    It is the device of the training on the skin in use. If ``evaluation.profile`` is set, every gesture is
    measured by another device of this profile, sampled as by the simulated device in use; ``device``: with
    its imperfections.

    Raises:
        InputError: the training has no simulated touches, or there is no such profile.
    """
    profile, device = check_evaluation(source.settings).profile, dict(source.trained)
    if "simulator" not in device or source.build is None:
        raise InputError(
            f"evaluation.profile={profile} chooses the alarm's threshold on simulated touches, and this run "
            "was trained on others: leave it out"
        )
    if profile is not None:
        sampled = {name: source.used[name] for name in ("rate", "aligned") if name in source.used}
        own = _imperfections(source.used) if profile == _DEVICE else sampled | profile_settings(profile)
        # Drawn skins draw a device for each gesture already.
        every = {} if "skins" in device else {"randomise": True, "calibration": None}
        device |= _EVERY | own
        device = {name: value for name, value in device.items() if name != "randomise"} | every
    reference = source.build(device).reference
    assert reference is not None
    return reference


def _imperfections(used: Mapping[str, Any]) -> dict[str, Any]:
    """Return the imperfections of the simulated device that a model is used on.

    Raises:
        InputError: the device is not simulated.
    """
    from skin.device.imperfection import ImperfectionSettings

    names = {entry.name for entry in fields(ImperfectionSettings)}
    if not names - {"cross_talk"} <= set(used):  # which earlier runs lack
        raise InputError(
            f"evaluation.profile={_DEVICE} takes the imperfections of a simulated device: add "
            "device=simulated, or name a profile"
        )
    return {name: used[name] for name in names & set(used)}


def profile_settings(name: str) -> dict[str, Any]:
    """Return the settings of the device in a profile (``conf/profile/``).

    Raises:
        InputError: there is no such profile.
    """
    if not GlobalHydra.instance().is_initialized():  # from Python
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return profile_settings(name)
    names = GlobalHydra.instance().config_loader().get_group_options("profile")
    if name not in names:
        raise InputError(f"there is no profile {name}: choose one of {', '.join(names)}, or {_DEVICE}")
    return OmegaConf.to_container(compose(f"profile/{name}").device, resolve=True)  # type: ignore[return-value]


def _remaining(path: str, inwards: bool, bounded: bool) -> dict[str, Any]:
    """Return the imperfections that a calibrated device is left with: its gains are known to 2 %.

    Where some are unknown, all are taken to spread as the known ones do. Readings are linear after the
    conversion: the limit is that of the force, and the noise is that at the reading at which the curves meet.
    A weight shows no lag, which lowers the peaks of taps. Where misses are ``bounded``, it is taken to be as
    in ``profile=calibrated``; where false alarms are, 0, with which there are most.
    """
    calibration = read_calibration(path, inwards)
    values, curves = calibration.values(), calibration.curves
    if curves is not None:
        values |= {"clip": curves.straighten(values["clip"]), "noise": values["noise"] / curves.slopes}
    left = {
        name: middle
        for name in ("noise", "hysteresis", "time_constant", "clip")
        if math.isfinite(middle := float(np.median(values[name])))  # a clip is not: there is no limit
    }
    # NaN: unknown
    gains = np.log(
        np.array(calibration.sensors.get("gain", [1.0] * len(calibration)), float)[~values["dead"]]
    )
    spread = float(np.nanstd(gains)) if 0 < np.isnan(gains).sum() < len(gains) else 0.02
    lag = {} if "time_constant" in calibration.sensors or not bounded else {"time_constant": 0.1}
    return _EVERY | left | lag | {"gain_spread": max(spread, 0.02), "dead": 0, "tare": True}


# The choice on gestures, one window of each.


def _on_gestures(learner: Predictor, device: "AbstractDevice", settings: Evaluation) -> OperatingPoint | None:
    """Return the point for single windows of the gestures of a device; None without ``dangerous``."""
    if LABEL not in device.task.names:
        return None
    touches, target = threshold_gestures(device, settings), settings.false_alarm_rate
    labels, probabilities = touches.known_labels, learner.probabilities(touches)
    probability, dangerous = dangerous_column(probabilities, labels, device.task)
    if dangerous.all():
        return OperatingPoint(0.5, target)
    seed = None if device.simulation is None else device.simulation.data_seed
    point = OperatingPoint(_lowest_threshold(probability[~dangerous], target), target, 0, 0, seed)
    return replace(point, **asdict(point.reached(probabilities, labels, device.task)))


def threshold_gestures(device: "AbstractDevice", settings: Evaluation) -> "Touches":
    """Return the gestures on which the threshold is chosen.

    A simulated device draws fresh gestures until enough of them are safe; other devices give their validation
    split.
    """
    simulation = device.simulation
    if simulation is None or LABEL not in device.task.names:
        return device.touches("validation")
    # Half of the sampled gestures are safe; some windows of streams show no touch.
    for doubled in range(1, 7):  # up to 32 times as many, where few are safe
        touches = simulation.fresh_touches(2**doubled * settings.safe_gestures)
        _, dangerous = dangerous_column(touches.known_labels, touches.known_labels, device.task)
        if int((~dangerous).sum()) >= settings.safe_gestures:
            break
    return touches


def _lowest_threshold(safe: "Tensor", target: float, allowed: int | None = None) -> float:
    """Return the lowest threshold that keeps the false-alarm rate, a float32 number.

    At most k = floor(target (n + 1)) - 1 of n safe gestures raise the alarm. A new safe gesture then raises
    it with a probability of at most (k + 1) / (n + 1) <= target (split conformal prediction; Vovk, Gammerman
    and Shafer 2005). If n < 1 / target - 1, the threshold is above all scores, and the target is not met.

    Args:
        safe: (n,), n > 0, probabilities of ``dangerous`` of safe gestures.
        target: largest rate.
        allowed: k; None: as above.
    """
    if allowed is None:
        # 1e-9 keeps a product such as 0.29 * 100 from rounding below its whole number.
        allowed = max(math.floor(target * (len(safe) + 1) + 1e-9) - 1, 0)
    return threshold_above(safe.detach().cpu().double().numpy(), allowed)


# The choice on touches, as the live view judges them.


def _on_touches(
    source: AlarmSource, settings: Evaluation, live: LiveConditions, say: Callable[[str], None], quick: bool
) -> OperatingPoint:
    """Return the point for safe touches as the live view judges them.

    It ships with the model or is kept on disk, unless the device is given.
    """
    target, missed = settings.false_alarm_rate, settings.miss_rate
    count = min(settings.safe_gestures, ENOUGH)
    if source.device is not None:
        device = source.device.simulated("touches are simulated")
        point = _on_touches_of(device, source.learner, _snapped(live, device), settings, count)
        return _guaranteed(point, missed, settings.profile, live)
    device, snapped, content = _describe(source, settings, live)
    key, profile = array_cache.hashed(content, _sources()), content["profile"]
    file = array_cache.folder(None) / f"threshold_{key[:16]}.npz"
    at = f"at {snapped.rate:.3g} Hz" + ("" if profile is None else f" and devices of the profile {profile}")
    shipped = _shipped(source, say).get(array_cache.hashed(content, ()))
    # No threshold from few touches keeps a guarantee.
    quick = quick and missed is None and count > sum(PROVISIONAL)
    if quick and shipped is None and not file.is_file():
        say(f"choosing a provisional threshold of the alarm {at}")
        return _on_touches_of(device, source.learner, snapped, settings, count, quick=True)

    def choose() -> dict[str, np.ndarray]:
        others = "" if missed is None else f" and {touches_drawn(missed)} dangerous"
        say(f"choosing the alarm's threshold on {count} safe{others} touches {at}")
        return _numbers(_on_touches_of(device, source.learner, snapped, settings, count))

    kept = shipped or array_cache.kept(file, key, {"point": (4,), "score": (3,)}, choose)
    threshold, raised, dangerous, found = map(float, kept["point"])
    counts = int(raised), device.data_seed, int(dangerous), int(found)
    score = DangerScore(*map(float, kept["score"]))
    point = OperatingPoint(threshold, target, count, *counts, snapped.rate, score)
    return _guaranteed(point, missed, profile, live)


def _numbers(point: OperatingPoint) -> dict[str, np.ndarray]:
    """Return what is kept of a point for touches."""
    assert point.score is not None
    counts = point.threshold, point.raised, point.dangerous, point.found
    return {"point": np.array(counts), "score": np.array(astuple(point.score))}


def _describe(
    source: AlarmSource, settings: Evaluation, live: LiveConditions
) -> "tuple[Simulated, LiveConditions, dict[str, Any]]":
    """Return the device that measures the touches, the conditions, and all that decides the threshold.

    Without a profile, a model that was trained on drawn skins takes ``mild``, and a device with a calibration
    what that leaves.
    """
    path = source.used.get("calibration") if source.used.get("port") else None
    if settings.profile is None and path is None and "skins" in source.trained:
        # Such trainings have devices so different that a threshold for all of them hides dangerous touches.
        settings = replace(settings, profile=_USUAL)
    device = threshold_device(replace(source, settings=settings))
    if path and settings.profile is None:
        device = device.replace(
            **_remaining(path, bool(source.used.get("inwards")), settings.miss_rate is not None),
            randomise=True,
            calibration=None,
        )
    live = _snapped(live, device)
    return (
        device,
        live,
        {
            "model": source.name,
            "device": source.trained,
            "skin": source.skin,
            "positions": device.sensors.positions.round(9).tolist(),
            # The conditions have the rate, and whether it is aligned.
            "imperfections": {
                name: str(value)
                for name, value in vars(device.imperfection).items()
                if name not in ("rate", "aligned") and (value or name != "cross_talk")
            },
            "live": asdict(live) | {"contact": round(live.contact, 3)},
            "profile": settings.profile,
            "target": settings.false_alarm_rate,
            "missed": settings.miss_rate,
            "count": min(settings.safe_gestures, ENOUGH),
        },
    )


def _guaranteed(
    point: OperatingPoint, missed: float | None, profile: str | None, live: LiveConditions
) -> OperatingPoint:
    """Return a point with the guarantee that it was chosen for, if any, as it is under a live view."""
    if missed is None or point.rate is None:
        return point
    counts = point.dangerous, point.dangerous - point.found
    conditions = f"{profile or 'this device'}, {point.rate:.3g} Hz"
    promise = Guarantee(missed, *counts, conditions, device_rate=point.rate, patience=live.patience)
    return replace(point, guarantee=promise.under(live))


def _shipped(source: AlarmSource, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the thresholds that ship with a model; none, with a notice, if they belong to other weights."""
    if source.weights is None or not (file := source.weights.with_name(THRESHOLDS)).is_file():
        return {}
    with suppress(OSError, ValueError, TypeError, LookupError):
        content = parse_json(read_file(file, TEXT))
        if content["hash"] == array_cache.hashed(content["skins"], [source.weights]):
            return dict(content["skins"])
    say(f"{file} is damaged or of other weights, and not used: skin export format=thresholds makes it anew")
    return {}


def ship_thresholds(
    source: AlarmSource, conditions: Iterable[LiveConditions], say: Callable[[str], None]
) -> None:
    """Choose thresholds for touches anew, and add them to those that ship with a pretrained model.

    Args:
        source: the model on a skin.
        conditions: of the live views.
        say: called with each message for the user.

    Raises:
        InputError: the model is not pretrained, or the file cannot be written.
    """
    if source.weights is None:
        raise InputError(f"{source.name} is no pretrained model: thresholds ship with those of models/ only")
    skins, settings = _shipped(source, say), check_evaluation(source.settings)
    for live in conditions:
        device, snapped, content = _describe(source, settings, live)
        point = _on_touches_of(device, source.learner, snapped, settings, content["count"])
        say(point.sentence())
        skins[array_cache.hashed(content, ())] = {
            "sensors": len(device.sensors),
            "rate": snapped.rate,
            **{name: values.tolist() for name, values in _numbers(point).items()},
        }
    shipped = {"hash": array_cache.hashed(skins, [source.weights]), "skins": skins}
    with whole(source.weights.with_name(THRESHOLDS)) as partial:
        partial.write_text(json.dumps(shipped, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _snapped(live: LiveConditions, device: "Simulated") -> LiveConditions:
    """Return the conditions at the nearest of some multiples of the model's rate.

    A measured rate is never the same twice, and the threshold would be chosen anew at each start. From 5
    times on, one is within 10 %: beyond, a guarantee lapses.
    """
    ratios = (*range(1, 13), 14, 16, 18, 20, 22, 25, 30, 35, 40, 45, 50, 60, 70, 80, 90, 100)
    ratio = min(ratios, key=lambda ratio: abs(log(ratio * device.model_rate / live.rate)))
    return replace(live, rate=ratio * device.model_rate)


def _sources() -> list[Path]:
    """Return the files that the thresholds kept on disk depend on."""
    from skin.device import imperfection, sampling
    from skin.evaluation import decisions, guarantee, operating_point, touch_scores

    modules = (imperfection, sampling, decisions, guarantee, operating_point, touch_scores)
    return [Path(__file__), *(Path(str(module.__file__)) for module in modules)]


def _on_touches_of(
    device: "Simulated",
    learner: Predictor | None,
    live: LiveConditions,
    settings: Evaluation,
    count: int,
    quick: bool = False,
) -> OperatingPoint:
    """Return the threshold that few of ``count`` safe touches pass, checked on dangerous ones.

    With ``settings.miss_rate`` it is the highest that finds most dangerous ones that count, and checked on
    safe ones. ``device`` measures each touch; with ``randomise``, by another device.

    With ``quick`` it is a lower limit of that threshold, from few touches: with a probability of ``_LOWER``
    no more than k of n safe touches pass the threshold of the wanted rate, k of the binomial distribution;
    so the one that k pass is no higher, and hides no more dangerous touches. Scores of a part of the
    decisions, and of touches that the score was fitted to, err downwards, too.
    """
    from skin.evaluation.touch_scores import decide_touches

    assert learner is not None
    target, missed, seed = settings.false_alarm_rate, settings.miss_rate, device.data_seed
    tests = DANGEROUS_TOUCHES if missed is None else touches_drawn(missed)
    count, tests, fitted = (*PROVISIONAL, 100) if quick else (count, tests, min(count, FITTED_TOUCHES))
    apart, allowed = (0, math.ceil(bdtrik(_LOWER, count, target))) if quick else (fitted, None)
    enough = apart + max(count, tests) + 16  # of the 16 combinations some have one touch fewer
    labels = device.sampler.balanced(2 * enough, generator(Stream.ALARM, seed, 1))
    danger = labels[:, TOUCH.names.index(LABEL)]
    safe, others = labels[~danger], labels[danger]
    chosen = np.concatenate([safe[:count], others[:tests], safe[count:][:apart], others[tests:][:apart]])
    dangerous = np.arange(2 * fitted) >= fitted
    with Steps({"choosing the threshold of the alarm": 4.0 if quick else 20.0}) as steps:
        # More threads than free cores take many times as long.
        decide = partial(decide_touches, learner, device, live)
        report = lambda done: steps.report(done / len(chosen))  # noqa: E731
        if missed is None:
            decisions = decide(chosen, seed, report, (None, -1.0) if quick else None)
            score = decisions.fit(np.arange(len(chosen))[-2 * fitted :], dangerous)
        else:
            score = decide(chosen[-2 * fitted :], seed).fit(np.arange(2 * fitted), dangerous)
            decisions = decide(chosen[: -2 * fitted], seed + 1, report, (score, _HIGHEST))
    tested = slice(count, count + tests)
    scores = decisions.scores(score)
    safe_scores, others_scores = scores[:count], scores[tested]
    if missed is None:
        threshold = _lowest_threshold(safe_scores, target, allowed)
    else:
        which = counted(decisions.peak[tested].numpy(), decisions.sensed[tested].numpy())
        others_scores = others_scores[which]
        threshold = min(_HIGHEST, threshold_for_misses(others_scores.numpy(), missed))
    point = OperatingPoint(threshold, target, count, 0, seed, len(others_scores), 0, live.rate, score)
    raised, found = (int(point.alarm(part).sum()) for part in (safe_scores, others_scores))
    return replace(point, raised=raised, found=found, provisional=quick)
