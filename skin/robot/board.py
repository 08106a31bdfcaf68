"""Write a run of boosted trees or rules as one C file, which classifies and raises the alarm on a board.

The arithmetic is in ``skin_model.h`` beside this file. It follows :mod:`skin.live.engine` for readings
that are all valid.
"""

import json
import textwrap
from collections.abc import Callable, Sequence
from math import ceil, sqrt
from pathlib import Path

import numpy as np
import torch

from skin.core.files import write
from skin.core.rng import Stream, generator
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.alarm import choose_alarm_threshold
from skin.evaluation.decisions import (
    DECISIONS,
    DRIFT,
    ContactLimits,
    LiveConditions,
    held_frames,
    longest_shown,
)
from skin.evaluation.operating_point import DangerScore, OperatingPoint
from skin.learning.features import FRACTIONS, LEVELS, NOISE, feature_blocks
from skin.runs.build import TorchModel
from skin.touch.labels import ALARM, RELEASE

STEP = 2.0**-8
"""N, to which readings are rounded: a twelfth of the usual noise, and 16 bits hold 128 N."""
LARGEST = 1_000_000
"""Bytes of trees: the flash of the largest common boards (nRF52840, SAMD51) has 1 MiB."""


def write_header(
    model: TorchModel,
    conditions: Sequence[LiveConditions],
    label: float,
    calm: float,
    path: Path,
    say: Callable[[str], None],
) -> Path:
    """Write the C file of a model and its alarm; return its path.

    Args:
        model: of boosted trees or rules, on one skin.
        conditions: of the live view of a device with the rate of the board.
        label, calm: s, of :class:`skin.live.engine.DebounceSettings`.
        path: of the file.
        say: called with each message for the user.

    Raises:
        InputError: the model has no alarm, is neither trees nor rules, or too large; the rate does not fit;
            no threshold raises alarms as seldom as wanted; or the file cannot be written.
    """
    arrays, numbers = _learned(model)
    rates = [live.rate for live in conditions]
    decisions = min(DECISIONS, *rates)
    tick, phases = rates[0] / decisions, decisions / model.rate
    if len(rates) > 1 or tick % 1 or phases % 1:
        raise InputError(
            f"format=c needs one rate, a multiple of {DECISIONS:g} Hz or, below that, of the model's "
            f"{model.rate:g} Hz, got {', '.join(map(str, rates))}: as in export.rates=[100]"
        )
    point = choose_alarm_threshold(model.alarm, conditions[0], say=say) or OperatingPoint(0.5)
    score = point.score or DangerScore(1.0, 0.0, 0.0)  # the model's probability
    arrays |= _self_test(model, score)
    numbers |= _contact(model, decisions) | {
        "RATE": round(rates[0]),
        "TICK": round(tick),  # frames per decision
        "ABOVE": point.announced(say),
        "RISE": conditions[0].decisions(rates[0]),
        "FALL": ceil(calm * decisions - 1e-6),
        "WAIT": ceil(label * decisions - 1e-6),
        "ODDS": score.odds,
        "LOUDNESS": score.level,
        "OFFSET": score.offset,
    }
    lines = [
        *(
            f"#define SKIN_{name} {value if isinstance(value, int) else f'{value:.8e}f'}"
            for name, value in numbers.items()
        ),
        f"#define SKIN_RUN {json.dumps(f'{model.title} ({model.identity})')}",
        f"static const char *const SKIN_NAMES[] = {{{', '.join(map(json.dumps, model.labels))}}};",
    ]
    for name, array in arrays.items():
        values = textwrap.fill(", ".join(map(str, array.ravel())), 110)
        lines.append(f"static const skin_{array.dtype} SKIN_{name}[] SKIN_FLASH = {{\n{values}}};")
    template = Path(__file__).with_name("skin_model.h")
    return write(template.read_text(encoding="utf-8").replace("/* NUMBERS */", "\n".join(lines)), path)


def _contact(model: TorchModel, decisions: float) -> dict[str, float]:
    """Return the numbers of window and contact, given the decisions per second."""
    limits, contact, frames = ContactLimits(), model.contact, model.window
    held, recent = held_frames(model.longest, model.rate, frames), ceil(RELEASE * model.rate - 1e-9)
    phases = round(decisions / model.rate)
    return {
        "PHASES": phases,  # decisions per interval of the model
        "FRAMES": frames,
        "SENSORS": len(model.positions),
        "LABELS": len(model.labels),
        "DANGEROUS": model.labels.index(ALARM),
        "GATE": model.labels.index(str(model.task.gate)) if model.learned else -1,
        "HELD": held,
        "SHOWN": (longest_shown(held, recent, frames) + 1) * phases,
        "RECENT": recent,
        "LONG_REST": ceil(limits.rest * model.rate - 1e-9),
        "STEP": STEP,
        "USUAL_NOISE": NOISE,
        "ROOT": sqrt(len(model.positions)),
        "CONTACT": contact,
        "LIFT": limits.lift,
        "MARGIN": limits.margin * contact,
        "SINK": limits.sink * contact / decisions,
        "DRIFT": DRIFT / decisions,
    }


def _learned(model: TorchModel) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return what a model has learned, as arrays and numbers.

    Raises:
        InputError: it has no alarm, is neither trees nor rules, or is too large.
    """
    empty, task = torch.zeros(1, model.window, len(model.sites)), model.task
    blocks = [names for names, _ in feature_blocks(Touches(empty, empty == 0, model.sites, None, model.rate))]
    match task.kind == "binary" and not task.direction and getattr(model.learner, "_learned", None):
        case dict() as rules if model.alarms:
            names = [name for block in blocks for name in block]
            compared = right = np.array([names.index(rule.measurement) for rule in rules.values()])
            threshold, slope = np.array([(rule.threshold, rule.slope) for rule in rules.values()]).T
            arrays = {"LIMIT": threshold, "SLOPE": slope}
        case [[*models], _] if model.alarms and all(hasattr(fitted, "_predictors") for fitted in models):
            trees = [tree.nodes for fitted in models for (tree,) in fitted._predictors]
            nodes = np.concatenate(trees)
            leaf, exact = nodes["is_leaf"] > 0, nodes["num_threshold"].clip(-3e38, 3e38)
            compared = np.where(leaf, 0, nodes["feature_idx"])
            # The left child is the next node. The right one is that much further, 0 in a leaf.
            right = np.where(leaf, 0, nodes["right"] - np.concatenate([np.arange(len(t)) for t in trees]))
            # The largest number of 32 bits that does not exceed the threshold decides alike.
            below = np.nextafter(np.float32(exact), np.float32(-np.inf))
            limit = np.where(np.float32(exact) > exact, below, np.float32(exact))
            arrays = {
                "VALUE": np.where(leaf, nodes["value"], limit).astype(np.float32),
                "RIGHT": right.astype(np.uint8),
                "NODE": np.cumsum([0, *map(len, trees[:-1])]).astype(np.uint32),
                "TREE": np.cumsum([0, *(len(fitted._predictors) for fitted in models)]).astype(np.uint32),
                "BASE": np.array([fitted._baseline_prediction.item() for fitted in models]),
            }
        case _:
            raise InputError(
                f"{model.title}, {type(model.learner).__name__} of {model.learner.parameters} parameters "
                f"({model.learner.parameters / 250:.0f} kB), predicts {', '.join(task.names)}: format=c "
                f"writes learner=boosted_trees and learner=rules of labels with {ALARM} and without a "
                "direction; networks need format=onnx"
            )
    size, ends = 6 * len(compared), np.cumsum([len(block) for block in blocks])
    if size > LARGEST or right.max() > 255:
        raise InputError(
            f"{model.title} has {len(compared)} nodes ({size / 1000:.0f} kB): format=c writes at most "
            f"{LARGEST / 1000:.0f} kB of trees, each below 256 nodes: train fewer, as with learner.rounds=100"
        )
    used, slots = np.unique(compared), np.full(ends[-1], 255, np.uint8)
    slots[used] = np.arange(len(used))
    arrays |= {
        "SLOT": slots,
        "COMPARED": slots[compared],
        "LEVEL": np.array(LEVELS),
        "FRACTION": np.array(FRACTIONS),
        "X": model.positions[:, 0],
        "Y": model.positions[:, 1],
    }
    needed = np.unique(np.searchsorted(ends, used, side="right"))
    return arrays, {"RULES": int("SLOPE" in arrays), "SLOTS": len(used), "USED": int((1 << needed).sum())}


def _self_test(model: TorchModel, score: DangerScore, count: int = 10) -> dict[str, np.ndarray]:
    """Return touches, with their probabilities, where these depend least on rounding."""
    device, column = model.device.reference, model.labels.index(ALARM)
    touches = (model.device.touches("test") if device is None else device.fresh_touches(100))[:100]
    valid = touches.valid.numpy()
    steps = (touches.readings.double().numpy() / STEP).round().clip(-32767, 32767)
    noise = 1e-6 * generator(Stream.NOISE, count).standard_normal((4, *steps.shape))
    answers = np.array([model.probabilities(STEP * steps + each, valid) for each in (0, *noise)], float)
    largest = STEP * np.where(valid, steps, 0).max(axis=(1, 2))
    answers[..., column] = score.probability(answers[..., column], largest)
    steady = np.argsort(np.ptp(answers, axis=0).max(axis=1) > 1e-5, kind="stable")[:count]
    stored = np.where(valid, steps, -32768).astype(np.int16)[steady]
    return {"STORED": stored, "EXPECTED": answers[0, steady].astype(np.float32)}
