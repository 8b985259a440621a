"""Wrong values of settings get one message that names the key."""

import math

import pytest

from pnet.scenes.limits import require_number, require_range


@pytest.mark.parametrize("value", [0, 0.0, 3, 2.5, 10])
def test_a_number_within_its_limits_passes(value):
    require_number("a.b", value, 0, 10)


@pytest.mark.parametrize("value", [-1, 10.1, math.nan, math.inf, "abc", None, True, [1]])
def test_anything_else_is_refused_by_its_key(value):
    with pytest.raises(ValueError, match=r"a\.b is .*, expected 0 to 10"):
        require_number("a.b", value, 0, 10)


def test_a_limit_may_be_open():
    require_number("a", 1e-9, 0, above=True)
    with pytest.raises(ValueError, match="a is 0, expected more than 0"):
        require_number("a", 0, 0, above=True)
    with pytest.raises(ValueError, match="a is -2, expected at least -1"):
        require_number("a", -2, -1)


@pytest.mark.parametrize("values", [[1, 2], (1, 1), [0.0, 10]])
def test_a_range_within_its_limits_passes(values):
    require_range("a", values, 0, 10)


@pytest.mark.parametrize(
    "values", [0.65, None, "12", [1], [1, 2, 3], [2, 1], [0, 11], [0, "x"], [math.nan, 1]]
)
def test_what_is_no_range_is_refused(values):
    with pytest.raises(ValueError, match=r"a is .*, expected \[smallest, largest\], both 0 to 10"):
        require_range("a", values, 0, 10)
