"""Pieces of the map: keyframes that are known relative to each other, and not to those of other pieces."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import inverse
from tgslam.types import Matrix4

_APART_M = 100.0  # beyond any sensor's range: no camera sees two of them
_ALONG = np.ones(3) / np.sqrt(3.0)  # askew, so that floors and walls of two pieces are not in one plane


class Pieces:
    """Which keyframe belongs to which piece. A piece is named by its first keyframe; the first one is 0."""

    def __init__(self) -> None:
        self._of: list[int] = []
        self._begun = 0
        self._led: dict[int, tuple[int, Matrix4]] = {}  # by piece: the keyframe before, and from there where it began

    def start(self, T_cw: Matrix4, latest_T_cw: Matrix4) -> Matrix4:
        """[4, 4] where the next piece is put, apart from all others, as upright as T_cw [4, 4] says that it is.

        T_cw: where motion has led, and latest_T_cw: [4, 4] from the latest keyframe.
        """
        T_wc = inverse(T_cw)
        self._led[len(self._of)] = len(self._of) - 1, latest_T_cw @ T_wc
        T_wc[:3, 3] = (self._begun * _APART_M) * _ALONG
        return inverse(T_wc)

    def led(self, T_wc: Mapping[int, Matrix4]) -> dict[int, Matrix4]:
        """By keyframe of the pieces that nothing ties to the first one, the motion p_w <- motion p_w [4, 4] to where
        the camera was led, as far as is known. T_wc: [4, 4] of all keyframes.
        """
        motions = {0: np.eye(4)}
        for first, (earlier, T_ec) in self._led.items():
            motions[first] = motions[self._of[earlier]] @ T_wc[earlier] @ T_ec @ inverse(T_wc[first])
        return {number: motions[piece] for number, piece in enumerate(self._of) if piece != 0}

    def begin(self) -> None:
        """The next keyframe is the first one of a piece."""
        self._of.append(len(self._of))
        self._begun += 1

    def add(self, number: int) -> None:
        """The next keyframe is in the piece of that one."""
        self._of.append(self._of[number])

    def of(self, number: int) -> int:
        """The piece of a keyframe."""
        return self._of[number]

    def apart(self) -> bool:
        """Whether the latest keyframe is in a piece that is not tied to the first one."""
        return self._of[-1] != 0

    def others(self, number: int) -> NDArray[np.bool_]:
        """[K] the keyframes that are in other pieces than this one."""
        return np.array(self._of) != self._of[number]

    def join(self, one: int, other: int) -> list[int]:
        """The pieces of two keyframes are one now. Returns the keyframes of the later piece, which are to move."""
        first, last = sorted((self._of[one], self._of[other]))
        moved = [number for number, piece in enumerate(self._of) if piece == last]
        for number in moved:
            self._of[number] = first
        return moved


def nearest(T_cw: Matrix4, keyframes_T_cw: NDArray[np.float64]) -> int:
    """Which of the keyframes [K, 4, 4] is nearest to a camera at T_cw [4, 4]."""
    places = inverse(keyframes_T_cw)[:, :3, 3] - inverse(T_cw)[:3, 3]
    return int(np.argmin(np.linalg.norm(places, axis=1)))
