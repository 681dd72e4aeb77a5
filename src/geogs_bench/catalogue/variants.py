"""Rows of many benchmarks: a plain run, the map during the run, the paper's choices."""

from collections.abc import Sequence
from dataclasses import replace

from geogs_bench.benchmark import Variant
from geogs_bench.data.benchmark_scene import Option

ONLINE_RESULTS = Option("online-results")
DEFAULT = Variant("default")
ONLINE = Variant("online", (ONLINE_RESULTS,))
PAPER = Variant("paper", (Option("preset", "paper"),))

PIPELINES = (
    "Rows default are what geogs run does: the map is made once, after the stream. Rows online are "
    "mapped on the way (--online-results), which shows the stages that the paper's online figures "
    "are of. Rows paper have --preset paper, which maps on the way and refines nothing."
)


def with_paper(variants: Sequence[Variant]) -> tuple[Variant, ...]:
    """All variants, followed by all with the paper's preset (``paper-``)."""
    papers = (
        replace(variant, name=f"paper-{variant.name}", options=(*PAPER.options, *variant.options))
        for variant in variants
    )
    return (*variants, *papers)
