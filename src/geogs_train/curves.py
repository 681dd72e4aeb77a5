"""The course of a training run as a picture."""

import json
from pathlib import Path

from geogs_train.run import LOG


def draw_curves(out: Path) -> None:
    """Draw ``curves.png`` from the log of a run: loss, validation errors, calibration."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    entries = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    losses = [e for e in entries if "loss" in e]
    scores = [e for e in entries if "scores" in e]
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
    axes[0].plot([e["step"] for e in losses], [e["loss"] for e in losses], linewidth=0.7)
    axes[0].set_title("training loss")
    steps = [e["step"] for e in scores]
    for name in ("epe", "dense", "textureless", "large", "median"):
        axes[1].plot(steps, [e["scores"][name] for e in scores], label=name)
    axes[1].set_yscale("log")
    axes[1].set_title("validation error, pixels")
    axes[1].legend()
    for name in ("within", "outliers", "sure_share"):
        axes[2].plot(steps, [e["scores"][name] for e in scores], label=name)
    axes[2].axhline(0.95, color="grey", linewidth=0.7)
    axes[2].set_title("shares of validation cells")
    axes[2].legend()
    for axis in axes:
        axis.set_xlabel("steps")
        axis.grid(alpha=0.3)
    figure.savefig(out / "curves.png", dpi=120)
    plt.close(figure)
