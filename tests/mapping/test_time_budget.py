"""How many images a time lasts for, against a simulation."""

from dataclasses import replace

import pytest

from geogs.config import SearchConfig
from geogs.mapping.time_budget import ViewCost, affordable_views, helpers, rounds


@pytest.mark.parametrize("repeat", [True, False])
@pytest.mark.parametrize("cost", [ViewCost(0.01, 0.05, 0.02), ViewCost(0.2, 1.5, 0.4)])
def test_the_depths_of_so_many_images_take_their_part_of_what_mesh_and_files_leave(cost, repeat):
    search = replace(SearchConfig(), repeat=repeat, depth_ratio=0.6)
    views = affordable_views(60.0, cost, search)
    before = views * (cost.reading + rounds(search) * cost.search)
    left = 60.0 - views * cost.output
    assert before <= 0.6 * left
    one = cost.reading + rounds(search) * cost.search + cost.output
    assert before > 0.6 * left - one


def test_what_has_been_done_is_not_paid_for_again():
    search, cost = replace(SearchConfig(), depth_ratio=0.6), ViewCost(0.1, 0.5, 0.0)
    views = affordable_views(100.0, cost, search)
    spent = 20 * cost.reading + 8 * cost.search
    again = affordable_views(100.0 - spent, cost, search, searched=8, read=20)
    # What was done was all of the depths' part, not 60 % of it.
    assert views < again <= views + 1 + 0.4 * spent / (cost.reading + 2.0 * cost.search)


def test_too_little_time_is_for_no_image():
    assert affordable_views(-5.0, ViewCost(0.1, 0.5, 0.1), SearchConfig()) == 0
    assert affordable_views(1e9, ViewCost(0.0, 0.0, 0.0), SearchConfig()) > 1000


def test_few_images_get_others_to_be_matched_with_and_many_have_each_other():
    cost = ViewCost(0.01, 1.0, 0.1)
    assert helpers(10, 100.0, cost) == 30
    assert helpers(40, 100.0, cost) == 60
    assert helpers(150, 100.0, cost) == 0
    assert helpers(10, 100.0, ViewCost(0.5, 1.0, 0.1)) == 10
    assert helpers(10, -1.0, cost) == 0
