"""What a config's values mean."""

import pytest

from pnet.cli.build import share


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("1/3", 1 / 3),
        ("1/5", 0.2),
        (1, 1.0),
        (0.2, 0.2),
        ("0.2", 0.2),
        (" 2/4 ", 0.5),
        ("1e-1", 0.1),
        (1.5, 1.5),
    ],
)
def test_a_share_may_be_a_fraction(value, expected):
    """Whether it lies in (0, 1] the data module says."""
    assert share("data.learn", value) == expected and isinstance(share("data.learn", value), float)


@pytest.mark.parametrize("value", ["a third", "", "1/0", "1/3/5", None, True, "nan", "inf", [1, 3]])
def test_what_is_no_share_is_refused(value):
    with pytest.raises(ValueError, match=r"data\.learn is .*, expected a share, for instance 1/3"):
        share("data.learn", value)
