"""Errors of an ideal observer: how well any classifier could know the labels of touches."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge

from experiments.studies.gesture_prior import GesturePrior
from experiments.studies.posterior_samples import Samples
from experiments.studies.subject import Measurement, Subject
from skin.labels import TOUCH


@dataclass(frozen=True)
class IdealObserver:
    """Errors of an observer that knows the skin, the device and the distribution of the gestures.

    It decides every label by its posterior probability given the readings. No classifier makes fewer errors
    on average (Bayes). The posterior of shape, place, size, timing, path and pressure is sampled by
    sequential Monte Carlo (Del Moral, Doucet and Jasra, 2006), which simulates the readings of many gestures.

    The true gestures are among those from which the sampling starts. The samples therefore include the right
    explanation of the readings, but may miss others, and the errors are too low rather than too high.

    Args:
        touches: number of touches.
        samples: of the posterior of each touch.
        moves: changes of every sample in each step.
        draws: gestures of each combination of labels, from which the sampling starts.
        seed: of the touches, their noise and the samples.
    """

    touches: Annotated[int, Ge(16)] = 480
    samples: Annotated[int, Ge(8)] = 64
    moves: Annotated[int, Ge(1)] = 12
    draws: Annotated[int, Ge(20)] = 1000
    seed: int = 0

    def __call__(self, subject: Subject) -> Measurement:
        from experiments.studies.tables import Page

        device = subject.device.simulated("the density of readings is known in simulation only")
        known, labels, misfit = self.posterior(GesturePrior(device, self.draws))
        expected, wrong = np.minimum(known, 1 - known), (known > 0.5) != labels
        columns = np.concatenate([expected, expected.mean(axis=1, keepdims=True)], axis=1)
        decided = np.concatenate([wrong, wrong.mean(axis=1, keepdims=True)], axis=1)
        error = columns.std(axis=0) / np.sqrt(self.touches)
        names = [*TOUCH.names, "overall"]
        rows = list(zip(names, columns.mean(axis=0), error, decided.mean(axis=0), strict=True))
        head = ["label", "error", "standard_error", "wrong_decisions"]
        data = [[name, *(f"{x:.5f}" for x in each)] for name, *each in rows]
        shown = [[n, f"{100 * e:.2f} ± {200 * s:.2f}", f"{100 * w:.2f}"] for n, e, s, w in rows]
        about = (
            f"{self.touches} touches, {self.samples} samples each; mean squared misfit of the samples over "
            f"that of the noise: {misfit.mean():.3f}, at most {misfit.max():.2f} for a touch"
        )
        title = "Errors of an ideal observer, % ± two standard errors over touches"
        tables = {title: [["label", "expected", "on these touches"], *shown]}
        return Measurement({}, Page(about, tables, [head, *data]))

    def posterior(self, prior: GesturePrior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the posterior probabilities of labels (B, 4), the labels, bool, and the misfits (B,).

        A misfit is the mean square of what a sample leaves of the readings, in units of the noise: about 1
        where the samples explain the readings.
        """
        random = np.random.default_rng(self.seed)
        share = np.exp(prior.weights)
        chosen = random.choice(len(share), self.touches, p=share / share.sum())
        true = {name: each[chosen] for name, each in prior.pool.items()}
        noise = float(prior.device.constants.noise)
        error = torch.from_numpy(random.standard_normal(prior.readings[chosen].shape)).float()
        samples = Samples(prior, prior.readings[chosen] + noise * error, self.samples, random)
        known = samples.run(self.moves)
        return known, prior.evaluate(true)[1], samples.misfit
