"""Arithmetic in declarations: its values, and that nothing else can be written."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.parts.expressions import check_expression, holds, length

NAMES = ["r", "h"]
SIZE = np.array([0.004, 0.010])  # r = 4 mm, h = 10 mm


@pytest.mark.parametrize(
    ("expression", "millimetres"),
    [
        ("r", 4),
        (2.5, 2.5),
        (3, 3),
        ("0.3 * h + 2", 5),
        ("h - r - 1", 5),
        ("-r", -4),
        ("--r", 4),
        ("h / r / 5", 0.5),
        ("h - (r - 1)", 7),
        ("2 + 3 * r", 14),
        ("r * sqrt(3) / 2", 2 * math.sqrt(3)),
        ("min(r, h) - max(r, h)", -6),
        ("h * sin(30)", 5),
        ("h * cos(60) + h * tan(45)", 15),
        ("max(r, min(h, 7))", 7),
        ("1e1", 10),
    ],
)
def test_an_expression_has_its_value_in_millimetres(expression, millimetres):
    assert float(length(expression, NAMES, SIZE)) == pytest.approx(millimetres / 1000, rel=1e-12)


PLAIN = ["r+h", "r-2*h", "r/h", "3*(r-h)/r", "max(r,h)-min(h,r)"]


@settings(max_examples=40, deadline=None)
@given(st.floats(1, 100), st.floats(1, 100), st.sampled_from(PLAIN))
def test_expressions_agree_with_python(r, h, expression):
    found = 1000 * float(length(expression, NAMES, np.array([r, h]) / 1000))
    expected = eval(expression, {"__builtins__": {}}, {"r": r, "h": h, "max": max, "min": min})
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("condition", "expected"),
    [("r < h", True), ("r > h", False), ("r >= 4", True), ("h <= 9.9", False), ("2 * r - h < -1.9", True)],
)
def test_a_comparison_holds_or_not(condition, expected):
    assert bool(holds(condition, NAMES, SIZE)) is expected


def test_many_sizes_are_evaluated_at_once():
    grid = np.arange(1, 13).reshape(3, 2, 2) / 1000
    np.testing.assert_allclose(length("h - r", NAMES, grid), np.full((3, 2), 0.001), rtol=1e-12)
    np.testing.assert_allclose(length("max(r, 5)", NAMES, grid), np.array([[5, 5], [5, 7], [9, 11]]) / 1000)
    assert length(7, NAMES, grid).shape == holds("r < 2", NAMES, grid).shape == (3, 2)
    assert holds("r < 5", NAMES, grid).tolist() == [[True, True], [False, False], [False, False]]
    assert holds("1 < 2", NAMES, grid).all()


FORBIDDEN = [
    "r.real",
    "r.__class__.__mro__",
    "().__class__",
    "open('x')",
    "__import__('os')",
    "exec(r)",
    "r(h)",
    "sqrt.x(r)",
    "(lambda: r)()",
    "lambda: r",
    "r[0]",
    "[r, h]",
    "(r, h)",
    "{r}",
    "{'a': r}",
    "'text'",
    "'a' * 3",
    "f'{r}'",
    "b'a'",
    "r ** 2",
    "r // h",
    "r % h",
    "r @ h",
    "r << 1",
    "r & h",
    "~r",
    "not r",
    "True",
    "False",
    "None",
    "...",
    "1j",
    "r and h",
    "r or h",
    "r if h else r",
    "[x for x in r]",
    "(x := r)",
    "r < h < 20",
    "r == h",
    "r != h",
    "r is h",
    "r in h",
    "min(*r)",
    "sqrt(x=r)",
    "min(r, h, 3)",
    "sqrt()",
    "abs(r)",
    "sqrt",
    "min",
]


@pytest.mark.parametrize("expression", FORBIDDEN)
def test_anything_but_arithmetic_is_refused(expression):
    with pytest.raises(ValueError) as fault:
        check_expression(expression, NAMES)
    assert repr(expression) in str(fault.value)
    assert type(fault.value) is ValueError
    with pytest.raises(ValueError):
        holds(expression, NAMES, SIZE)


BROKEN = ["", " ", "r +", "2 r", "r; h", "r = 2", "import os", "r\nh", "(r", "0x", "r #\n +", "((("]


@pytest.mark.parametrize("text", BROKEN)
def test_what_is_no_expression_at_all_is_refused(text):
    with pytest.raises(ValueError, match="is no expression; write for example"):
        check_expression(text, NAMES)


def test_an_unknown_parameter_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'0.3 \* d': 'd' is not one of the parameters \['r', 'h'\]"):
        length("0.3 * d", NAMES, SIZE)


@pytest.mark.parametrize(("expression", "wanted"), [("min(r)", 2), ("sqrt(r, h)", 1), ("max(r, h, r)", 2)])
def test_the_number_of_a_functions_values_is_checked(expression, wanted):
    with pytest.raises(ValueError, match=rf"\w+ takes {wanted} value"):
        check_expression(expression, NAMES)


@pytest.mark.parametrize("condition", ["r", "r + h", "3"])
def test_a_condition_must_compare(condition):
    with pytest.raises(ValueError, match="compares nothing; write for example 'd > r'"):
        holds(condition, NAMES, SIZE)


def test_evaluating_leaves_the_parameters_alone():
    size = SIZE.copy()
    length("-r + h", NAMES, size)
    assert np.array_equal(size, SIZE)


@pytest.mark.parametrize("expression", ["r > 2", "(r > 2) + 1", "-(r > 2)", "min(r > 2, h)"])
def test_a_comparison_is_no_length(expression):
    with pytest.raises(ValueError):
        check_expression(expression, NAMES)


@pytest.mark.parametrize("expression", ["1 / 0", "r / 0", "h / (r - r)", "sqrt(-1)", "1e400", "9" * 400])
def test_a_length_that_is_no_finite_number_is_refused(expression):
    with np.errstate(all="ignore"), pytest.raises(ValueError):
        length(expression, NAMES, SIZE)


@pytest.mark.parametrize("expression", ["-" * 5000 + "r", "r + " * 5000 + "r"])
def test_an_expression_of_endless_depth_is_refused(expression):
    with pytest.raises(ValueError):
        check_expression(expression, NAMES)
