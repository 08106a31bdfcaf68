"""Numbers beside the figures of the report."""

import math

import numpy as np
import pytest
import torch

from experiments.studies.pages import confusion_rows
from skin.evaluation.metrics import encode
from skin.touch.labels import TOUCH


def outcomes(called, dangerous):
    """Return the outcomes of a run that calls each gesture dangerous or not, and is right about the rest."""
    labels = torch.zeros(len(dangerous), len(TOUCH))
    position = TOUCH.names.index("dangerous")
    labels[:, position] = torch.tensor(dangerous)
    said = labels.clone()
    said[:, position] = torch.tensor(called)
    return encode(said, labels, TOUCH)


def test_the_two_kinds_of_errors_are_shares_of_safe_and_of_dangerous_gestures():
    dangerous = [0.0] * 8 + [1.0] * 4
    first = outcomes([1.0] * 4 + [0.0] * 4 + [1.0] * 4, dangerous)  # half of the safe ones
    second = outcomes([1.0] * 4 + [0.0] * 5 + [1.0] * 3, dangerous)  # and one of four dangerous ones
    (found,) = confusion_rows({"gru": np.array([first, second])}).to_dict("records")
    assert float(found["safe_called_dangerous"]) == 0.5
    assert float(found["dangerous_called_safe"]) == 0.125
    assert float(found["difference"]) == 0.375
    # By hand: over runs 0.5 and 0.25; over 8 safe gestures, of which 4 are wrong, and over 4 dangerous ones,
    # of which one is wrong in half of the runs.
    runs, safe, missed = 0.25**2 / 2 / 2, 0.25 * 8 / 7 / 8, 3 / 64 * 4 / 3 / 4
    assert float(found["error"]) == pytest.approx(math.sqrt(runs + safe + missed), abs=1e-4)
    # Student's quantiles of two runs, of eight and of four gestures.
    margin = math.sqrt(12.706**2 * runs + 2.3646**2 * safe + 3.1824**2 * missed)
    assert float(found["margin"]) == pytest.approx(margin, abs=1e-4)
