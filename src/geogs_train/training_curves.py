"""The course of a training run as a picture."""

import json
from pathlib import Path
from typing import Any

from geogs_train.course import Panels
from geogs_train.training_run import LOG


def draw_curves(out: Path, panels: Panels) -> None:
    """Draw ``curves.png`` from the log of a run: the loss, and a panel for each title with names
    of scores, and whether it is logarithmic. Scores in scores have names with dots; those that a
    run does not have are left out."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    entries = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    losses = [e for e in entries if "loss" in e]
    scores = [e for e in entries if "scores" in e]
    width = 13 / 3 * (1 + len(panels))
    figure, axes = plt.subplots(1, 1 + len(panels), figsize=(width, 3.6), layout="constrained")
    axes[0].plot([e["step"] for e in losses], [e["loss"] for e in losses], linewidth=0.7)
    axes[0].set_title("training loss")
    steps = [e["step"] for e in scores]
    for axis, (title, names, logarithmic) in zip(axes[1:], panels, strict=True):
        for name in names:
            values = [_score(e["scores"], name) for e in scores]
            if any(v is not None for v in values):
                axis.plot(steps, values, label=name.split(".", 1)[-1])
        if logarithmic:
            axis.set_yscale("log")
        if any(name.endswith("within") for name in names):
            axis.axhline(0.95, color="grey", linewidth=0.7)
        axis.set_title(title)
        axis.legend()
    for axis in axes:
        axis.set_xlabel("steps")
        axis.grid(alpha=0.3)
    figure.savefig(out / "curves.png", dpi=120)
    plt.close(figure)


def _score(scores: dict[str, Any], name: str) -> float | None:
    """The score of a name with dots; None where there is none."""
    found: Any = scores
    for part in name.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return found
