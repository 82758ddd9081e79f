"""Aliases are symmetric."""

from hdbridge.axis.effects import CATALOGUE, aliases_of


def test_look_alikes_are_symmetric():
    for name in CATALOGUE:
        assert name not in aliases_of(name)
        for other in aliases_of(name):
            assert name in aliases_of(other)
