"""Identity switches where nobody has labelled the scene: what measurements show at one place should keep its id.

What bore one id when it was last seen is one surface; where enough of it bears another id now, that is a switch. What
comes into view later, and follows switches that have been counted since it was last seen, is the same switch. The
places are patches (see `patches`): neither the ids' own planes nor how the map was made have a part in what those are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.evaluation.panoptic import IDENTITY_SHARE, SHOWN_SHARE, IdImage
from tgslam.evaluation.patches import Patches, patches_of
from tgslam.evaluation.plane_metrics import MIN_AREA_M2
from tgslam.types import FloatImage, Matrix4

SURFACE_KEY = "plane_surface_switches_per_100"


class SurfaceSwitches:
    """Counts how often surfaces change their id from one frame that shows them to the next.

    Part of a surface that bore one id has switched when it bears another one and covers, in this frame, 1/500 of the
    image, and a quarter of what is seen of the surface again or `MIN_AREA_M2`: the shares by which `IdentitySwitches`
    speaks of instances and identities. Changing there and back are two switches, a plane that falls into two is one.
    """

    def __init__(self, camera: Camera) -> None:
        self.frames = 0
        self._camera = camera
        self._switches: list[tuple[int, int, int]] = []  # frame, id before, id since
        self._keys: NDArray[np.int64] = np.zeros(0, np.int64)  # ascending
        self._ids: NDArray[np.int32] = np.zeros(0, np.int32)  # of each, when it was last seen
        self._seen: NDArray[np.int64] = np.zeros(0, np.int64)  # the frame in which it was

    @property
    def switches(self) -> int:
        """How many there have been."""
        return len(self._switches)

    @property
    def per_100_frames(self) -> float | None:
        """None before the first frame."""
        return 100.0 * self.switches / self.frames if self.frames else None

    def add(self, depth_m: FloatImage, ids: IdImage, T_wc: Matrix4) -> None:
        """Take the next frame: its measured depth [H, W] m (0 = none), the ids that the map shows, and its pose."""
        patches = patches_of(depth_m, ids, self._camera, T_wc)
        _, now, before = np.intersect1d(patches.keys, self._keys, assume_unique=True, return_indices=True)
        known, unexplained = self._ids[before], ~self._explained(patches.ids[now], before)
        for first in np.unique(known):
            self._count(patches, now[known == first], unexplained[known == first], int(first))
        keys = np.concatenate([patches.keys, self._keys])  # of equal ones the first one stays
        self._keys, kept = np.unique(keys, return_index=True)
        self._ids = np.concatenate([patches.ids, self._ids])[kept]
        self._seen = np.concatenate([np.full(len(patches.keys), self.frames), self._seen])[kept]
        self.frames += 1

    def _explained(self, ids: NDArray[np.int32], before: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of the patches seen again have the id [K] that they had, or one that it has switched to since then.

        before: [K] their place among the known ones.
        """
        result = np.zeros(len(ids), bool)
        last = np.stack([self._ids[before], self._seen[before]], axis=1)
        for first, frame in np.unique(last, axis=0):
            possible = {int(first)}
            for when, earlier, later in self._switches:
                if when > frame and earlier in possible:
                    possible.add(later)
            result |= (last == (first, frame)).all(axis=1) & np.isin(ids, list(possible))
        return result

    def _count(self, patches: Patches, again: NDArray[np.intp], changed: NDArray[np.bool_], known: int) -> None:
        """Note to which other ids the patches seen again, of one id before, have switched where they have changed."""
        image_px, seen_px = self._camera.width * self._camera.height, int(patches.pixels[again].sum())
        for other in np.unique(patches.ids[again[changed]]):
            part = again[changed & (patches.ids[again] == other)]
            part_px = int(patches.pixels[part].sum())
            much = part_px >= IDENTITY_SHARE * seen_px or float(patches.areas_m2[part].sum()) >= MIN_AREA_M2
            if much and part_px >= SHOWN_SHARE * image_px:
                self._switches.append((self.frames, known, int(other)))
