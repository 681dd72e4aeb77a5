"""The stages of a profiled run."""

import threading
import time

import pytest

from run_profile import StageMeter, print_functions, print_stages


def busy(seconds: float) -> None:
    """Use the CPU for so long."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


@pytest.mark.parametrize("profiles", [False, True])
def test_a_stage_within_another_is_taken_out_of_it(profiles):
    meter = StageMeter(profiles)
    with meter("outer"):
        busy(0.04)
        with meter("inner"):
            busy(0.12)
        busy(0.04)
    assert meter.processor["outer"] == pytest.approx(0.08, rel=0.3)
    assert meter.processor["inner"] == pytest.approx(0.12, rel=0.3)
    assert set(meter.seconds) == {"outer", "inner"}
    assert meter.seconds["inner"] >= 0.9 * meter.processor["inner"]
    said: list[str] = []
    print_stages(meter, said.append)
    assert len(said) == 3
    assert "inner" in said[0] or profiles
    if profiles:
        print_functions(meter, 3, said.append)
        assert sum("busy" in line for line in said) == 2


def test_what_is_done_aside_belongs_to_no_stage():
    meter = StageMeter(False)

    def aside() -> None:
        with meter.aside(), meter("rendering"):
            pass

    with meter("mesh"):
        thread = threading.Thread(target=aside)
        thread.start()
        thread.join()
    assert set(meter.seconds) == {"mesh"}
