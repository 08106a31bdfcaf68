"""Place, force and an alarm on eFlesh and the SDU pad, tested on other sessions or other places."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.model_selection import GroupKFold

from experiments.studies.real_rows import (
    FOLDS,
    Presses,
    RealRow,
    RealSettings,
    choose,
    exact_interval,
    interval,
    predict,
    result_line,
    spread,
    square_errors,
)
from skin.device.conversion import convert_files
from skin.device.formats import read_format
from skin.device.touches import GROUP, Recording
from skin.learning.features import engineered_features

PRESS = 2  # the frame of a row in its five frames, the others are idle (conf/mapping)
SWEEPS = 20  # of the probe in each session with a gauge (SOURCES: 20 pauses)
DRAWS = 10
DANGEROUS = 4.0  # N
RISKS = (0.05, 0.01)


def number_sweeps(session: np.ndarray) -> np.ndarray:
    """Return the number of the sweep of each press, (N,), in sessions of ``SWEEPS`` equal parts."""
    numbers = np.zeros(len(session), int)
    for name in np.unique(session):
        inside = np.flatnonzero(session == name)
        numbers[inside] = name * SWEEPS + np.arange(len(inside)) * SWEEPS // len(inside)
    return numbers


def run_sessions(
    row: RealRow, presses: Presses, settings: RealSettings, train: set[int], test: int
) -> Iterator[dict[str, Any]]:
    """Train on sessions, test on another."""
    training, tested = presses[np.isin(presses.session, list(train))], presses[presses.session == test]
    pair = choose(training, settings.seed, by_place=False)
    squares = square_errors(predict(pair, training, tested, settings.seed), tested)
    low, high = interval(squares, tested.place, settings.seed)
    value = float(np.sqrt(squares.mean()))
    words = ", ".join(reversed(pair))
    yield result_line(
        row, len(training), len(tested), words, metric="rms", value=value, low=low, high=high, over=row.over
    )


def run_draws(row: RealRow, presses: Presses, settings: RealSettings, count: int) -> Iterator[dict[str, Any]]:
    """Train on few presses of the first session, drawn several times, and test on the second."""
    first, tested = presses[presses.session == 0], presses[presses.session == 1]
    values, pairs = list[float](), list[str]()
    for number in range(DRAWS):
        draw = np.random.default_rng([settings.seed, 5, number])
        training = first[np.sort(draw.permutation(len(first))[:count])]
        pair = choose(training, settings.seed, by_place=False)
        squares = square_errors(predict(pair, training, tested, settings.seed), tested)
        values.append(float(np.sqrt(squares.mean())))
        pairs.append(pair[1])
    low, high = spread(values)
    often = "; ".join(f"{name} {pairs.count(name)}" for name in sorted(set(pairs)))
    mean = float(np.mean(values))
    used = min(count, len(first))
    yield result_line(
        row, used, len(tested), often, metric="mean rms", value=mean, low=low, high=high, over="draws"
    )


def place_folds(presses: Presses, seed: int) -> Iterator[tuple[Presses, Presses]]:
    """Yield training and test presses of folds by place."""
    folds = GroupKFold(FOLDS, shuffle=True, random_state=seed)
    for fit, test in folds.split(presses.place, groups=presses.place):
        yield presses[fit], presses[test]


def run_places(
    row: RealRow, presses: Presses, settings: RealSettings, train: set[int] | None = None, test: int = 0
) -> Iterator[dict[str, Any]]:
    """Test on places that no training press has touched, in folds; on another session, if some train."""
    squares, places, pairs, sizes = [], [], list[str](), list[int]()
    for training, tested in place_folds(presses, settings.seed):
        if train is not None:
            training = training[np.isin(training.session, list(train))]
            tested = tested[tested.session == test]
        sizes.append(len(training))
        pair = choose(training, settings.seed, by_place=True)
        squares.append(square_errors(predict(pair, training, tested, settings.seed), tested))
        places.append(tested.place)
        pairs.append(", ".join(reversed(pair)))
    joined = np.concatenate(squares)
    low, high = interval(joined, np.concatenate(places), settings.seed)
    words, value = "; ".join(sorted(set(pairs))), float(np.sqrt(joined.mean()))
    yield result_line(
        row,
        round(float(np.mean(sizes))),
        len(joined),
        words,
        metric="rms",
        value=value,
        low=low,
        high=high,
        over="places",
    )


def risk_threshold(scores: np.ndarray, dangerous: np.ndarray, places: np.ndarray, risk: float) -> float:
    """Return the highest threshold whose expected share of misses at a new place is at most ``risk``.

    Conformal risk control (Angelopoulos et al., ICLR 2024) over the n places with a dangerous press: the
    loss of a place is the share of its dangerous presses below the threshold, and
    (n mean loss + 1) / (n + 1) <= risk.

    Args:
        scores: predicted force, (N,).
        dangerous: bool, (N,).
        places: numbers, (N,).
        risk: between 0 and 1.

    Returns:
        -inf, an alarm at every press, where dangerous places are too few for the risk.
    """
    values = scores[dangerous]
    _, number, counts = np.unique(places[dangerous], return_inverse=True, return_counts=True)
    total = len(counts)
    order = np.argsort(values)
    # Of ascending thresholds: how much is lost when all lower scores raise no alarm.
    losses = np.concatenate([[0.0], np.cumsum(1 / counts[number[order]])])[:-1]
    allowed = np.flatnonzero((losses + 1) / (total + 1) <= risk + 1e-12)
    return float(values[order][allowed[-1]]) if len(allowed) else -np.inf


def run_alarm(row: RealRow, presses: Presses, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Raise an alarm at presses above ``DANGEROUS``: thresholds of a quarter of the training places."""
    parts = []
    for training, tested in place_folds(presses, settings.seed):
        names = np.random.default_rng([settings.seed, 6]).permutation(np.unique(training.place))
        calibrating = np.isin(training.place, names[: len(names) // 4])
        fit, calibration = training[~calibrating], training[calibrating]
        pair = choose(fit, settings.seed, by_place=True)
        scores = predict(pair, fit, calibration, settings.seed)[:, 0]
        dangerous = calibration.targets[:, 0] > DANGEROUS
        limits = [risk_threshold(scores, dangerous, calibration.place, risk) for risk in RISKS]
        chance = predict(pair, fit, tested, settings.seed)[:, 0]
        alarms = np.stack([chance >= limit for limit in limits], axis=1)
        parts.append((alarms, tested.targets[:, 0] > DANGEROUS, tested.place, ", ".join(reversed(pair))))
    alarms, dangerous, places = (np.concatenate(column) for column in list(zip(*parts, strict=True))[:3])
    words = "; ".join(sorted({part[3] for part in parts}))
    for number, risk in enumerate(RISKS):
        for metric, inside in (("misses", dangerous), ("false alarms", ~dangerous)):
            wrong = (alarms[:, number] != dangerous)[inside]
            size = len(presses) * 3 // 5
            goal = replace(row, goal=100 * risk if metric == "misses" else None)
            for over, low, high in _rates(wrong, places[inside], settings.seed):
                values = {"metric": f"{metric}, risk {100 * risk:g} %", "value": 100 * float(wrong.mean())}
                yield result_line(
                    goal, size, len(wrong), words, **values, low=100 * low, high=100 * high, over=over
                )


def _rates(wrong: np.ndarray, places: np.ndarray, seed: int) -> Iterator[tuple[str, float, float]]:
    """Yield the interval of a rate over presses (Clopper and Pearson), and over places."""
    yield "presses", *exact_interval(int(wrong.sum()), len(wrong))
    low, high = interval(wrong.astype(float), places, seed)
    yield "places", low**2, high**2


def read_presses(row: RealRow, path: Path, settings: RealSettings) -> Presses:
    """Return the presses of a row with known targets; a share of them, or of the places of a pad."""
    recording = convert_files(read_format(row.mapping), path)
    targets = row.factor * np.stack([recording.parameters[name].numpy() for name in row.targets], axis=1)
    groups = {name: values.numpy() for name, values in recording.parameters.items() if name.startswith(GROUP)}
    session = groups.get(f"{GROUP}session", np.zeros(len(targets))).astype(int)
    place = groups.get(f"{GROUP}place", _grid(recording)).astype(int)
    if row.over == "sweeps":
        place = number_sweeps(session)
    presses = Presses(make_inputs(row, recording, session), targets.astype(float), session, place)
    draw = np.random.default_rng([settings.seed, 1])
    units = place if f"{GROUP}place" in groups else np.arange(len(place))
    chosen = draw.permutation(np.unique(units))[: max(1, round(settings.share * len(np.unique(units))))]
    return presses[np.isfinite(targets).all(axis=1) & np.isin(units, chosen)]


def _grid(recording: Recording) -> np.ndarray:
    """Return the number of the place on a grid of 1 mm, (N,); 0 where places are unknown."""
    if not {"x", "y"} <= set(recording.parameters):
        return np.zeros(len(recording))
    x, y = (np.rint(1e3 * recording.parameters[name].numpy()).astype(int) for name in ("x", "y"))
    return np.asarray(1000 * x + y)


def make_inputs(row: RealRow, recording: Recording, session: np.ndarray) -> dict[str, np.ndarray]:
    """Return the inputs of the choice.

    Only sweeps of the force have a history. Both sessions press the places in the same order, so that the
    press before would tell the place.
    """
    readings = recording.touches.readings[:, PRESS].double().numpy()
    features = np.stack(
        [column.numpy() for column in engineered_features(recording.touches).values()], axis=1
    )
    inputs = {"readings": readings, "features": np.hstack([readings, features[:, features.std(axis=0) > 0]])}
    if row.mapping == "sdu":
        left, right = (np.log(readings[:, number].clip(min=0.01)) for number in (0, 1))
        inputs["logarithms"] = np.column_stack(
            [readings, left, right, left - right, readings[:, 2] - readings[:, 3]]
        )
    elif row.targets == ("force",):
        before = np.maximum(np.arange(len(readings)) - 1, 0)
        before[session[before] != session] += 1
        inputs["history"] = np.hstack([readings, readings - readings[before]])
    return inputs


PLACE, FORCE, SHEAR = "eflesh/spatial_resolution", "eflesh/normal_force", "eflesh/shear_force"
PAD = "sdu_fsi/2D_6060_learning_data.xlsx"
A_B, UNSEEN = "session of 16 March 2025 -> 17 March 2025", "5 folds by place"
_row = partial(RealRow, read=read_presses)
_place = partial(
    _row, mapping="eflesh_place", path=PLACE, targets=("x", "y"), factor=1e3, unit="mm", split=A_B
)
_force = partial(_row, mapping="eflesh_force", path=FORCE, targets=("force",), unit="N", over="sweeps")
_pad = partial(_row, mapping="sdu", path=PAD, split=UNSEEN)
_first = partial(run_sessions, train={0}, test=1)
ROWS = (
    _place(name="eflesh place", goal=0.55, run=_first),
    _place(name="eflesh place, 100 presses", goal=1.5, run=partial(run_draws, count=100)),
    _place(name="eflesh place, 400 presses", goal=0.8, run=partial(run_draws, count=400)),
    _force(
        name="eflesh force, 1+2",
        split="sessions 1+2 -> 3",
        goal=0.33,
        run=partial(run_sessions, train={0, 1}, test=2),
    ),
    _force(
        name="eflesh force, 1", split="session 1 -> 3", goal=0.5, run=partial(run_sessions, train={0}, test=2)
    ),
    _force(
        name="eflesh shear",
        mapping="eflesh_shear",
        path=SHEAR,
        split="session 1 -> 2",
        goal=0.22,
        run=_first,
    ),
    _pad(name="sdu place", targets=("x", "y"), factor=1e3, unit="mm", goal=5.0, run=run_places),
    _pad(name="sdu force", targets=("force",), unit="N", goal=0.6, run=run_places),
    _pad(name="sdu alarm above 4 N", targets=("force",), unit="%", goal=None, run=run_alarm),
)
