"""Procedure made of given moves."""


class Moves:
    """Procedure made of given moves; its result is the number of samples of each."""

    def __init__(self, *moves):
        self._moves = moves

    def moves(self, axis):
        counts = []
        for move in self._moves:
            counts.append(len((yield move)))
        return counts
