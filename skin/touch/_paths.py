"""Sample the paths of drawn gestures: the place and the share of full force in each frame."""

from typing import NamedTuple

import numpy as np
import torch

from skin.touch.gesture import Draws, GestureSettings, fold
from skin.touch.problem import Trajectories


class SampledPaths(NamedTuple):
    """Sampled trajectories of gestures.

    Attributes:
        trajectories: the frames (U,) of gestures (B,).
        place: (U, 2), place of each frame within the gesture's span, m.
        first: (B,), the first frame of each gesture.
        net: (B, 2), from its first place to its last, m.
        travel: (B,), largest distance from its first place, m.
    """

    trajectories: Trajectories
    place: np.ndarray
    first: np.ndarray
    net: np.ndarray
    travel: np.ndarray


def sample_paths(
    gestures: Draws, wanted: np.ndarray, settings: GestureSettings, proportional: bool
) -> SampledPaths:
    """Return the distinct frames of gestures.

    A sliding touch has one per step. A static touch has one, or one per force level where pressure is not
    proportional to force.

    Args:
        gestures: the draws of ``draw_gestures`` and ``draw_paths``, (B, ...).
        wanted: (B, 4), bool, the wanted labels.
        settings: ranges of the gestures.
        proportional: whether pressure is proportional to force.
    """
    duration, onset, sliding = gestures["duration"], gestures["onset"], gestures["speed"] > 0
    time = np.arange(settings.frames.window) - onset[:, None]
    rise = duration[:, None] // settings.ramp + 1
    level = np.clip(np.minimum(time + 1, duration[:, None] - time), 0, rise)
    scale = level / rise

    peak_level = level.max(axis=1)
    counts = np.where(sliding, duration, 1 if proportional else peak_level)
    first = np.cumsum(counts) - counts
    shown = np.where(sliding[:, None], time, level - 1)
    index = first[:, None] + np.clip(shown, 0, counts[:, None] - 1)
    owner = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(owner)) - first[owner]
    velocity = gestures["speed"] * np.stack([np.cos(gestures["direction"]), np.sin(gestures["direction"])])
    place = fold(gestures["start"][owner] + step[:, None] * velocity.T[owner], gestures["span"][owner])

    share = np.zeros(len(owner))
    np.maximum.at(share, index, scale)
    trajectories = Trajectories(
        owner,
        gestures["shape"][owner],
        gestures["angle"][owner],
        gestures["scale"][owner],
        place - gestures["low"][owner],
        share,
        torch.from_numpy(index),
        torch.from_numpy(scale).float(),
        gestures["peak"],
        wanted,
        gestures["stretch"][owner],
    )
    from_first = place - place[first[owner]]
    travel = np.zeros(len(first))
    np.maximum.at(travel, owner, np.hypot(*from_first.T))
    return SampledPaths(trajectories, place, first, from_first[first + counts - 1], travel)
