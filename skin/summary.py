"""Summary of a data set in one line: forces, strains, clipped readings, accepted draws."""

from typing import Any

import torch

from skin.body.base import AbstractBody
from skin.recording import Recording


def summarise(recording: Recording, body: AbstractBody) -> dict[str, Any]:
    """Return what a simulated data set is like, as shares of 1 and SI units.

    The strain is the largest of the top layer by the linear solution or, where a recording has none, its
    highest pressure by its modulus. Linear theory is good to about 0.3; beyond 1 a linear layer would be
    squeezed to nothing. The report's thresholds are kept all the same.

    Returns:
        gestures; acceptance (share of draws kept); force (N: quantiles .05, .5, .95 and the largest);
        strain_over_30_percent and strain_over_100_percent; strain_solved (else pressure by modulus);
        clipped and clipped_dangerous (gestures in which a sensor passes the clip, of all and of the dangerous
        ones); unconverged (frames whose pressure was not found, so that their gestures were drawn again),
        where it had to be.
    """
    known, labels = recording.parameters, recording.touches.labels
    assert labels is not None
    strain = known.get("strain", known["peak"] / body.layers[-1].material.young)
    force = torch.quantile(known["force"], torch.tensor([0.05, 0.5, 0.95, 1.0]))
    dangerous = labels[:, recording.task.names.index("dangerous")] > 0.5
    summary = {
        "gestures": len(recording),
        "acceptance": len(recording) / float(known["draws"].sum()),
        "force": dict(zip(("q05", "q50", "q95", "largest"), force.tolist(), strict=True)),
        "strain_over_30_percent": float((strain > 0.3).float().mean()),
        "strain_over_100_percent": float((strain > 1).float().mean()),
        "strain_solved": "strain" in known,
        "clipped": float(known["clipped"].mean()),
        "clipped_dangerous": float(known["clipped"][dangerous].mean()) if dangerous.any() else 0.0,
    }
    if "unconverged" in known:
        summary["unconverged"] = int(known["unconverged"].sum())
    return summary


def summary_line(summary: dict[str, Any]) -> str:
    """Return a summary in one line."""
    force = summary["force"]
    strain = "strain" if summary.get("strain_solved") else "pressure by modulus"
    solved = f"; {summary['unconverged']} frames not solved" if "unconverged" in summary else ""
    return (
        f"{summary['gestures']} gestures, {summary['acceptance']:.0%} of draws kept; force median "
        f"{force['q50']:.0f} N (5 to 95 %: {force['q05']:.0f} to {force['q95']:.0f} N, largest "
        f"{force['largest']:.0f} N); {strain} over 30 % in {summary['strain_over_30_percent']:.0%}, "
        f"over 100 % in {summary['strain_over_100_percent']:.0%}; clipped {summary['clipped']:.0%} "
        f"({summary['clipped_dangerous']:.0%} of dangerous){solved}"
    )
