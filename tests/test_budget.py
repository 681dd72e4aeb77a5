"""What counts as a line of code, as a constant and as over the budget."""

import pytest

import budget

MODULE = '''"""A docstring
of two lines."""

import math  # an import

LIMIT = 0.5
"""A constant."""
LOW, HIGH = -1, 2 * 3.0
_RANGE: tuple[float, float] = (0.0, 1e-3)
NAMES = "a", "b"
IS_ON = True
TWICE = 2 * LIMIT
lower = 3


def function(x: float) -> float:
    """Doc."""
    # A comment.
    return math.sqrt(
        x
    )
'''


def test_lines_that_carry_code_are_counted():
    assert budget.code_lines(MODULE) == 11
    assert budget.code_lines("") == 0
    assert budget.code_lines('"""Doc."""\nimport os\n\n# no\n') == 0


def test_numbers_with_upper_case_names_are_constants():
    assert budget.constants(MODULE) == 3
    assert budget.constants("A = 1\nB = A\nc = 2\nclass D:\n    E = 3\n") == 1


def test_who_exceeds_a_budget_is_told_which(monkeypatch, capsys):
    found = budget.counted()
    monkeypatch.setattr(budget, "counted", lambda: {**found, "constants": 10**6})
    with pytest.raises(SystemExit, match=r"Over budget .*: constants\."):
        budget.main()
    assert f"code-lines: {found['code-lines']} of" in capsys.readouterr().out
