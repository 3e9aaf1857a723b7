"""Between which keyframes the exposure changes, and by how much: of all courses, the one that is most likely."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAP = -1  # a tie's `other` that is the map, whose gain is 1
_STEP_COST = 1.0  # negative log likelihood that a free step has to save: Akaike's criterion
_TOGGLED = 8  # latest steps that are also looked at one by one
_ROUNDS = 8  # of reweighting
_CONVERGED = 1e-4
_FLAT = 1e-6  # holds what no tie says anything of


class Tie(NamedTuple):
    """A measured difference of log gains, that of `keyframe` less that of `other`, an earlier one or the map."""

    keyframe: int
    other: int
    log_gain: float
    sigma: float


class Course(NamedTuple):
    """Of N keyframes in order: their log gains, and which of them differ from the one before."""

    log_gains: Vector  # [N]
    moves: Mask  # [N]


class Courses:
    """What ties between keyframes say of the courses that the latest of them may have taken.

    The errors of ties have a Cauchy distribution, so that wrong ones do not count. A constant exposure is the rule. A
    step has to earn its freedom, and a run of steps also that it may begin and end anywhere (2 log N): vignetting,
    highlights and whatever else differs between any two views would add up otherwise.
    """

    def __init__(self, ties: Sequence[Tie], before: Vector) -> None:
        """before: [B], B > 0, log gains of the keyframes before those that `ties` have as their first; these stay."""
        k, other, measured, self._sigma = np.array(ties, np.float64).reshape(-1, 4).T
        first, known = len(before), np.append(before, 0.0)  # the last one is the map's
        self._base = float(before[-1])
        self._keyframe, self._other = k.astype(int) - first, other.astype(int) - first
        outside = self._other < 0
        self._measured = measured.copy()
        self._measured[outside] += known[other[outside].astype(int)] - self._base
        self._other[outside] = -1

    def best(self, course: Course, nearest: Vector) -> Course:
        """The most likely course near this one, whose last keyframe is new: what it says of that one does not count.

        nearest: [N] the log gain of each keyframe less that of the one before, as its nearest tie has it.
        """
        steps = np.where(course.moves, np.diff(course.log_gains, prepend=self._base), nearest)
        best, least = course, np.inf
        for moves in _with_other_tails(course.moves):
            found, cost = self._fit(moves, self._base + np.cumsum(steps * moves))
            if cost < least:
                best, least = found, cost
        number = len(best.moves)
        while (number := number - 1) >= max(0, len(best.moves) - _TOGGLED):
            moves = best.moves.copy()
            moves[number] ^= True
            found, cost = self._fit(moves, best.log_gains)
            if cost < least - _CONVERGED:
                best, least, number = found, cost, len(best.moves)
        return best

    def _fit(self, moves: Mask, guess: Vector) -> tuple[Course, float]:
        """The course with these moves that is most likely near `guess` [N], and its negative log likelihood."""
        level = np.cumsum(moves)
        levels = int(level[-1]) + 1
        a, b = level[self._keyframe], np.where(self._other >= 0, level[self._other], 0)
        gains = np.bincount(level, guess, levels) / np.maximum(np.bincount(level, minlength=levels), 1)
        gains[0] = self._base
        for _ in range(_ROUNDS):
            error = self._measured - (gains[a] - gains[b])
            weight = 1.0 / (self._sigma**2 + error**2)
            change = _relaxed(a, b, weight, error, levels)
            gains += change
            if np.abs(change).max() < _CONVERGED:
                break
        error = self._measured - (gains[a] - gains[b])
        runs = np.count_nonzero(np.diff(moves.astype(int), prepend=0) > 0)
        price = _STEP_COST * np.count_nonzero(moves) + 2.0 * np.log(len(moves)) * runs
        return Course(gains[level], moves), float(0.5 * np.log1p((error / self._sigma) ** 2).sum() + price)


def _relaxed(a: NDArray[np.int64], b: NDArray[np.int64], weight: Vector, error: Vector, levels: int) -> Vector:
    """[L] change of the gains of levels, by weighted least squares; the first one stays. a, b: the levels of ties."""
    cells = levels * levels
    across = np.bincount(a * levels + b, weight, cells) + np.bincount(b * levels + a, weight, cells)
    itself = np.bincount(a, weight, levels) + np.bincount(b, weight, levels) + _FLAT
    normal = np.diag(itself) - across.reshape(levels, levels)
    pull = np.bincount(a, weight * error, levels) - np.bincount(b, weight * error, levels)
    return np.append(0.0, np.linalg.solve(normal[1:, 1:], pull[1:]))


def _with_other_tails(moves: Mask) -> Iterator[Mask]:
    """These moves with those of the latest 1, 2, 4, ... keyframes all false or all true."""
    length = 1
    while True:
        for moving in (False, True):
            tail = moves.copy()
            tail[-length:] = moving
            yield tail
        if length >= len(moves):
            return
        length = min(2 * length, len(moves))
