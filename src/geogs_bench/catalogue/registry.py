"""Every benchmark by its name."""

import difflib

from geogs.errors import InputError
from geogs_bench.benchmark import Benchmark
from geogs_bench.catalogue.ablations import ABLATIONS
from geogs_bench.catalogue.data_sets import DATA_SETS
from geogs_bench.catalogue.paper_tables import SUITES

BENCHMARKS: dict[str, Benchmark] = {b.name: b for b in (*DATA_SETS, *ABLATIONS)}


def find_benchmark(name: str) -> Benchmark:
    """Find a benchmark by its name. Raises InputError with near names if there is none."""
    if name in BENCHMARKS:
        return BENCHMARKS[name]
    known = [*BENCHMARKS, *SUITES]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(known)}."
    raise InputError(f"there is no benchmark {name}; {hint}")
