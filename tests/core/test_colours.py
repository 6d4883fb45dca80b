"""Colours of configurations, against the palette as it was published."""

from copem_replay.core.colours import configuration_colours

OKABE_ITO = ("E69F00", "56B4E9", "009E73", "F0E442", "0072B2", "D55E00", "CC79A7")


def test_the_first_seven_are_those_of_okabe_and_ito() -> None:
    given = configuration_colours([f"configuration {k}" for k in range(9)]).values()
    assert ["{:02X}{:02X}{:02X}".format(*colour) for colour in given][:7] == [*OKABE_ITO]
    assert len({*given}) == 9, "those that follow are other shades"
