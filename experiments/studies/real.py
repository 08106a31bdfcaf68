"""Learn place, force and an alarm on real recordings, and test on other sessions or other places.

    python -m experiments.studies.real data=FOLDER                   # eflesh/ and sdu_fsi/ in it
    python -m experiments.studies.real data=FOLDER share=0.1         # a tenth of the presses

Writes real.csv to the folder out=, results by default. The estimator of each row is chosen by
cross-validation on the training presses alone: sessions, blocks of time or places are held out.
"""

import csv
import io
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Le
from omegaconf import OmegaConf
from scipy.stats import binomtest
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.ensemble import BaggingRegressor, ExtraTreesRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GroupKFold, KFold
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler
from sklearn.svm import SVR

from skin.core.files import write
from skin.core.settings import checked, configured
from skin.device.conversion import convert_files
from skin.device.formats import read_format
from skin.device.touches import GROUP, Recording
from skin.errors import InputError
from skin.learning.features import engineered_features

PRESS = 2  # the frame of a row in its five frames, the others are idle (conf/mapping)
SWEEPS = 20  # of the probe in each session with a gauge (SOURCES: 20 pauses)
CHOICE = 2500  # presses at most for the choice of an estimator, which costs a fit per candidate and fold
KERNEL = 400  # presses at most for the length scales of a Gaussian process
EXACT = 5000  # presses at most in its covariance
DRAWS, FOLDS, RESAMPLES, LEVEL = 10, 5, 1000, 0.95
DANGEROUS = 4.0  # N
RISKS = (0.05, 0.01)


@checked("real")
@dataclass(frozen=True)
class RealSettings:
    """RealSettings of the command line.

    Attributes:
        data: folder that holds ``eflesh`` and ``sdu_fsi``; absent recordings are named and left out.
        share: of the presses, or of the places of the pad.
        rows: beginnings of rows, separated by commas; empty: all.
        seed: of draws, folds and estimators.
        out: folder of the results.
    """

    data: str
    share: Annotated[float, Gt(0), Le(1)] = 1.0
    rows: str = ""
    seed: int = 0
    out: str = "results"


@dataclass(frozen=True)
class Presses:
    """Presses of a robot, in order of time.

    Attributes:
        inputs: name of the inputs -> values (N, K).
        targets: (N, D), mm or N.
        session: number of the session, (N,).
        place: number of the pressed place, (N,).
    """

    inputs: Mapping[str, np.ndarray]
    targets: np.ndarray
    session: np.ndarray
    place: np.ndarray

    def __len__(self) -> int:
        return len(self.targets)

    def __getitem__(self, index: np.ndarray) -> "Presses":
        inputs = {name: values[index] for name, values in self.inputs.items()}
        return Presses(inputs, self.targets[index], self.session[index], self.place[index])


@dataclass(frozen=True)
class RealRow:
    """A comparison: train on some presses, test on others.

    Attributes:
        name: of the row.
        mapping: of ``conf/mapping``.
        path: of the recording below the folder of the data.
        targets: parameters of the recording.
        factor: from SI units to those of the target.
        unit: of the target.
        split: in words.
        goal: error to reach.
        run: yields the results.
    """

    name: str
    mapping: str
    path: str
    targets: tuple[str, ...]
    factor: float
    unit: str
    split: str
    goal: float | None
    run: Callable[["RealRow", Presses, RealSettings], Iterator[dict[str, Any]]] = field(repr=False)


class SubsetProcess(RegressorMixin, BaseEstimator):
    """Gaussian process with length scales of few presses and a posterior of many.

    Parameters:
        seed: of the choice of the presses.
    """

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed

    def fit(self, x: np.ndarray, y: np.ndarray) -> "SubsetProcess":
        """Fit inputs (N, K) and scaled targets (N, D)."""
        order = np.random.default_rng(self.seed).permutation(len(x))
        kernel = ConstantKernel(1.0) * RBF(np.full(x.shape[1], 3.0), (0.1, 1e3)) + WhiteKernel(
            0.01, (1e-6, 1.0)
        )
        few, many = order[:KERNEL], order[:EXACT]
        scales = GaussianProcessRegressor(kernel, random_state=self.seed).fit(x[few], y[few]).kernel_
        self.process_ = GaussianProcessRegressor(scales, optimizer=None).fit(x[many], y[many])
        return self

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the mean, (N, D)."""
        return np.asarray(self.process_.predict(x))


def estimators(outputs: int, seed: int) -> dict[str, BaseEstimator]:
    """Return the estimators of the choice, for scaled inputs and a number of scaled targets."""
    network = MLPRegressor(hidden_layer_sizes=(64, 64), alpha=0.01, max_iter=300, early_stopping=True)
    svm = SVR(C=10.0, epsilon=0.02)
    return {
        "ridge": make_pipeline(PolynomialFeatures(2, include_bias=False), RidgeCV(np.logspace(-2, 4, 13))),
        "svm": MultiOutputRegressor(svm) if outputs > 1 else svm,
        "gaussian process": SubsetProcess(seed),
        "extra trees": ExtraTreesRegressor(200, min_samples_leaf=2, random_state=seed),
        "networks": BaggingRegressor(network, 5, bootstrap=False, random_state=seed),
    }


def pair_estimators(presses: Presses, seed: int) -> dict[tuple[str, str], BaseEstimator]:
    """Return estimators by (inputs, estimator); engineered features go to SVM and trees."""
    pairs = {}
    for inputs in presses.inputs:
        for name, estimator in estimators(presses.targets.shape[1], seed).items():
            if inputs != "features" or name in ("svm", "extra trees"):
                scaled = make_pipeline(StandardScaler(), clone(estimator))
                pairs[inputs, name] = TransformedTargetRegressor(scaled, transformer=StandardScaler())
    return pairs


def predict(pair: tuple[str, str], training: Presses, test: Presses, seed: int) -> np.ndarray:
    """Return the predicted targets of the test presses, (N, D)."""
    estimator = pair_estimators(training, seed)[pair]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the choice judges what has not converged
        targets = training.targets
        estimator.fit(training.inputs[pair[0]], targets if targets.shape[1] > 1 else targets[:, 0])
    return np.asarray(estimator.predict(test.inputs[pair[0]])).reshape(len(test), -1)


def square_errors(predicted: np.ndarray, presses: Presses) -> np.ndarray:
    """Return the squared distance from the target, (N,)."""
    return np.asarray(np.square(predicted - presses.targets).sum(axis=1))


def choose(training: Presses, seed: int, by_place: bool) -> tuple[str, str]:
    """Return (inputs, estimator) with the least error in cross-validation on the training presses.

    Held out are places, else sessions, else blocks of time.
    """
    groups = training.place if by_place else training.session
    thin = _thin(groups if by_place else np.arange(len(groups)), seed)
    training, groups = training[thin], groups[thin]
    if by_place:
        folds = list(GroupKFold(FOLDS, shuffle=True, random_state=seed).split(groups, groups=groups))
    elif len(set(groups)) > 1:
        folds = list(GroupKFold(len(set(groups))).split(groups, groups=groups))
    else:
        folds = list(KFold(FOLDS).split(groups))
    errors = {}
    for pair in pair_estimators(training, seed):
        parts = (
            square_errors(predict(pair, training[fit], training[held], seed), training[held])
            for fit, held in folds
        )
        errors[pair] = float(np.sqrt(np.concatenate(list(parts)).mean()))
    return min(errors, key=lambda pair: errors[pair])


def _thin(units: np.ndarray, seed: int) -> np.ndarray:
    """Return the sorted index of whole units with ``CHOICE`` presses at most, as far as folds allow."""
    names = np.random.default_rng([seed, 3]).permutation(np.unique(units))
    count = max(FOLDS, int(len(names) * min(1.0, CHOICE / len(units))))
    return np.flatnonzero(np.isin(units, names[:count]))


def interval(squares: np.ndarray, units: np.ndarray, seed: int) -> tuple[float, float]:
    """Return the interval of the rms error, resampling whole units (N,), such as places."""
    _, number = np.unique(units, return_inverse=True)
    sums, counts = np.bincount(number, squares), np.bincount(number)
    draw = np.random.default_rng([seed, 4]).integers(len(sums), size=(RESAMPLES, len(sums)))
    values = np.sqrt(sums[draw].sum(axis=1) / counts[draw].sum(axis=1))
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def number_sweeps(session: np.ndarray) -> np.ndarray:
    """Return the number of the sweep of each press, (N,), in sessions of ``SWEEPS`` equal parts."""
    numbers = np.zeros(len(session), int)
    for name in np.unique(session):
        inside = np.flatnonzero(session == name)
        numbers[inside] = name * SWEEPS + np.arange(len(inside)) * SWEEPS // len(inside)
    return numbers


def result_line(row: RealRow, training: int | str, test: int, pair: str, **values: Any) -> dict[str, Any]:
    """Return a line of the results; keyword arguments are the metric, its value and its interval."""
    start = {"row": row.name, "split": row.split, "training": training, "test": test, "estimator": pair}
    goal = "" if row.goal is None else row.goal
    reached = "" if row.goal is None else ("yes" if values["value"] <= row.goal else "no")
    return start | {"unit": row.unit} | values | {"goal": goal, "reached": reached}


def run_sessions(
    row: RealRow, presses: Presses, settings: RealSettings, train: set[int], test: int
) -> Iterator[dict[str, Any]]:
    """Train on sessions, test on another."""
    training, tested = presses[np.isin(presses.session, list(train))], presses[presses.session == test]
    pair = choose(training, settings.seed, by_place=False)
    squares = square_errors(predict(pair, training, tested, settings.seed), tested)
    units, name = (
        (tested.place, "places") if len(row.targets) == 2 else (number_sweeps(tested.session), "sweeps")
    )
    low, high = interval(squares, units, settings.seed)
    value = float(np.sqrt(squares.mean()))
    words = ", ".join(reversed(pair))
    yield result_line(
        row, len(training), len(tested), words, metric="rms", value=value, low=low, high=high, over=name
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
    low, high = (float(value) for value in np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]))
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


def run_places(row: RealRow, presses: Presses, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Test on places that no training press has touched, in folds."""
    squares, places, pairs = [], [], list[str]()
    for training, tested in place_folds(presses, settings.seed):
        pair = choose(training, settings.seed, by_place=True)
        squares.append(square_errors(predict(pair, training, tested, settings.seed), tested))
        places.append(tested.place)
        pairs.append(", ".join(reversed(pair)))
    joined = np.concatenate(squares)
    low, high = interval(joined, np.concatenate(places), settings.seed)
    words, value = "; ".join(sorted(set(pairs))), float(np.sqrt(joined.mean()))
    size = len(presses) - len(presses) // FOLDS
    yield result_line(
        row, size, len(joined), words, metric="rms", value=value, low=low, high=high, over="places"
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
    exact = binomtest(int(wrong.sum()), len(wrong)).proportion_ci(LEVEL)
    yield "presses", float(exact.low), float(exact.high)
    low, high = interval(wrong.astype(float), places, seed)
    yield "places", low**2, high**2


PLACE, FORCE, SHEAR = "eflesh/spatial_resolution", "eflesh/normal_force", "eflesh/shear_force"
PAD = "sdu_fsi/2D_6060_learning_data.xlsx"
A_B, UNSEEN = "session of 16 March 2025 -> 17 March 2025", "5 folds by place"
_place = partial(RealRow, mapping="eflesh_place", path=PLACE, targets=("x", "y"), factor=1e3, unit="mm")
_force = partial(RealRow, mapping="eflesh_force", path=FORCE, targets=("force",), factor=1.0, unit="N")
_pad = partial(RealRow, mapping="sdu", path=PAD, split=UNSEEN)
ROWS = (
    _place("eflesh place", split=A_B, goal=0.55, run=partial(run_sessions, train={0}, test=1)),
    _place("eflesh place, 100 presses", split=A_B, goal=1.5, run=partial(run_draws, count=100)),
    _place("eflesh place, 400 presses", split=A_B, goal=0.8, run=partial(run_draws, count=400)),
    _force(
        "eflesh force, 1+2",
        split="sessions 1+2 -> 3",
        goal=0.33,
        run=partial(run_sessions, train={0, 1}, test=2),
    ),
    _force("eflesh force, 1", split="session 1 -> 3", goal=0.5, run=partial(run_sessions, train={0}, test=2)),
    RealRow(
        "eflesh shear",
        "eflesh_shear",
        SHEAR,
        ("force",),
        1.0,
        "N",
        "session 1 -> 2",
        0.22,
        partial(run_sessions, train={0}, test=1),
    ),
    _pad("sdu place", targets=("x", "y"), factor=1e3, unit="mm", goal=5.0, run=run_places),
    _pad("sdu force", targets=("force",), factor=1.0, unit="N", goal=0.6, run=run_places),
    _pad("sdu alarm above 4 N", targets=("force",), factor=1.0, unit="%", goal=None, run=run_alarm),
)


def read_presses(row: RealRow, folder: Path, share: float, seed: int) -> Presses:
    """Return the presses of a row with known targets; a share of them, or of the places of a pad."""
    recording = convert_files(read_format(row.mapping), folder / row.path)
    targets = row.factor * np.stack([recording.parameters[name].numpy() for name in row.targets], axis=1)
    groups = {name: values.numpy() for name, values in recording.parameters.items() if name.startswith(GROUP)}
    session = groups.get(f"{GROUP}session", np.zeros(len(targets))).astype(int)
    place = groups.get(f"{GROUP}place", _grid(recording)).astype(int)
    presses = Presses(make_inputs(row, recording, session), targets.astype(float), session, place)
    draw = np.random.default_rng([seed, 1])
    units = place if f"{GROUP}place" in groups else np.arange(len(place))
    chosen = draw.permutation(np.unique(units))[: max(1, round(share * len(np.unique(units))))]
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


def measure_rows(settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Yield the lines of all rows whose recordings are in the folder."""
    chosen = [row for row in ROWS if row.name.startswith(tuple(settings.rows.split(",")))]
    if not chosen:
        raise InputError(f"rows={settings.rows} begins no row: {', '.join(row.name for row in ROWS)}")
    folder = Path(settings.data).expanduser()
    present = [row for row in chosen if (folder / row.path).exists()]
    if not present:
        raise InputError(
            f"data={settings.data} holds none of {', '.join(sorted({row.path for row in chosen}))}"
        )
    for path in sorted({row.path for row in chosen} - {row.path for row in present}):
        print(f"left out, no such file or folder: {folder / path}", file=sys.stderr)
    for row in present:
        yield from row.run(row, read_presses(row, folder, settings.share, settings.seed), settings)


def write_lines(lines: Iterator[dict[str, Any]], path: Path) -> None:
    """Print lines as they come, and write them as CSV, rounded to three digits."""
    whole = []
    for values in lines:
        rounded = {
            name: round(value, 3) if isinstance(value, float) else value for name, value in values.items()
        }
        print(*rounded.values(), sep=", ", flush=True)
        whole.append(rounded)
    text = io.StringIO()
    table = csv.DictWriter(text, whole[0], lineterminator="\n")
    table.writeheader()
    table.writerows(whole)
    print(write(text.getvalue(), path))


def main(words: Sequence[str]) -> None:
    """Run what the words ``name=value`` select."""
    entries = OmegaConf.to_container(OmegaConf.from_dotlist(list(words)))
    settings = configured(RealSettings, entries, "real")  # type: ignore[arg-type]
    write_lines(measure_rows(settings), Path(settings.out) / "real.csv")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
