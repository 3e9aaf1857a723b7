"""Keyframes: what they measured, where they stand, and which planes they show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import overload

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.geometry import inverse, orthonormalized
from tgslam.map.holes import Guess, filled
from tgslam.map.plane_labels import PlaneLabels
from tgslam.ops.normals import normals_of
from tgslam.types import Exposure, Frame, Matrix4, Trajectory

_DEPTH_UNIT_M = 0.0002  # TUM's and finer than any RGB-D sensor's: 16 bits reach 13.1 m
_DECODED = 2  # latest keyframes whose images stay decoded: everything that happens with a new one looks at these


class Keyframe:
    """Images are stored as 8 and 16 bits, so that an hour's keyframes fit in memory.

    Its pose is changed by `Keyframes.move` alone, its labels by `show`, its exposure by `expose`.
    """

    def __init__(
        self,
        frame: Frame,
        T_cw: Matrix4,
        exposure: Exposure,
        information: NDArray[np.float64],
    ) -> None:
        """Keep a frame, whose images may lie on the host or on the device.

        T_cw: [4, 4] and information: [6, 6] of its left perturbation, as the frame was tracked. exposure: of its image.
        """
        self.index, self.timestamp_s = frame.index, frame.timestamp_s
        self.information = information
        self._T_cw, self._exposure = T_cw, exposure
        self._colour = np.rint(runtime.to_host(frame.colour) * 255.0).astype(np.uint8)
        limit = np.iinfo(np.uint16).max
        units = np.rint(runtime.to_host(frame.depth_m) / _DEPTH_UNIT_M)
        self._depth = np.where(units <= limit, units, 0).astype(np.uint16)
        self._left_out: NDArray[np.bool_] | None = None
        self._labels: PlaneLabels | None = None
        self._label_version = 0
        self._decoded: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None

    @property
    def T_cw(self) -> Matrix4:
        """[4, 4] world to camera."""
        return self._T_cw

    @property
    def exposure(self) -> Exposure:
        """Of its image, against the map."""
        return self._exposure

    def expose(self, exposure: Exposure) -> None:
        """Its exposure has become better known."""
        self._exposure = exposure

    @property
    def left_out(self) -> NDArray[np.bool_] | None:
        """[H, W] pixels that show nothing of the world that stays; None = there are none."""
        return self._left_out

    def leave_out(self, pixels: NDArray[np.bool_]) -> None:
        """Of these pixels [H, W], neither depth nor colour counts from now on."""
        if pixels.any():
            self._left_out, self._depth = pixels, np.where(pixels, 0, self._depth).astype(np.uint16)
            kept, self._decoded = self._decoded is not None, None
            self.keep_decoded(kept)

    @property
    def labels(self) -> PlaneLabels | None:
        """The plane of each pixel; None where planes are not looked for."""
        return self._labels

    @property
    def label_version(self) -> int:
        """Grows whenever the labels change."""
        return self._label_version

    def show(self, ids: NDArray[np.integer]) -> None:
        """The plane of each pixel [H, W], -1 = on none."""
        labels = PlaneLabels.of(ids)
        if self._labels is None or not (
            np.array_equal(labels.ids, self._labels.ids) and np.array_equal(labels.places, self._labels.places)
        ):
            self._labels, self._label_version = labels, self._label_version + 1

    def colour(self) -> NDArray[np.float32]:
        """[H, W, 3] RGB in [0, 1]; to be read only."""
        return self._decoded[0] if self._decoded else self._colour.astype(np.float32) / np.float32(255.0)

    def depth_m(self) -> NDArray[np.float32]:
        """[H, W] m, 0 = none; to be read only."""
        return self._decoded[1] if self._decoded else self._depth.astype(np.float32) * np.float32(_DEPTH_UNIT_M)

    def pixels(
        self, rows: NDArray[np.integer], columns: NDArray[np.integer]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The colours [..., 3] and depths [...] m at some pixels [...]; the images are not decoded for these."""
        colour = self._colour[rows, columns].astype(np.float32) / np.float32(255.0)
        return colour, self._depth[rows, columns].astype(np.float32) * np.float32(_DEPTH_UNIT_M)

    def keep_decoded(self, keep: bool) -> None:
        """Whether its images stay decoded, which takes 16 bytes a pixel: by default they are decoded at each use."""
        self._decoded = (self.colour(), self.depth_m()) if keep else None


class KeyframeImages:
    """What a keyframe's images say, computed when it is first asked for."""

    def __init__(self, keyframe: Keyframe, camera: Camera, noise: SensorNoise) -> None:
        self.colour, self.depth_m = keyframe.colour(), keyframe.depth_m()
        self._camera, self._noise = camera, noise

    @cached_property
    def guess(self) -> Guess:
        """The depth image without holes."""
        return filled(self.depth_m, self._camera.fx)

    @cached_property
    def normals(self) -> NDArray[np.float32]:
        """[H, W, 3] of what was measured, camera frame, towards the camera; 0 = unknown."""
        return self._normals(self.depth_m)

    @cached_property
    def guessed_normals(self) -> NDArray[np.float32]:
        """[H, W, 3] likewise of the depth image without holes."""
        return self._normals(self.guess.depth_m)

    def _normals(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        return runtime.to_host(normals_of(runtime.to_device(depth_m), self._camera, self._noise))


class Keyframes(Sequence[Keyframe]):
    """Owns the keyframes; the only place where one of them gets another pose."""

    def __init__(self, camera: Camera, noise: SensorNoise) -> None:
        self._camera, self._noise = camera, noise
        self._all: list[Keyframe] = []
        self._T_wc: dict[int, Matrix4] = {}
        self._images: KeyframeImages | None = None  # of the latest one, once somebody has asked for them
        self.version = 0  # grows whenever poses change

    def add(self, keyframe: Keyframe) -> int:
        """Take in the next keyframe; returns its number, from 0."""
        number = len(self._all)
        self._all.append(keyframe)
        self._images = None
        keyframe.keep_decoded(True)
        for earlier in self._all[-_DECODED - 1 : -_DECODED]:
            earlier.keep_decoded(False)
        self._T_wc[number] = inverse(keyframe.T_cw)
        return number

    def move(self, motions: Mapping[int, Matrix4]) -> None:
        """Keyframes move in the world, p_w <- motions[number] p_w, [4, 4] each; the others stay."""
        for number, motion in motions.items():
            keyframe = self._all[number]
            keyframe._T_cw = orthonormalized(keyframe.T_cw @ inverse(motion))
            self._T_wc[number] = inverse(keyframe.T_cw)
        self.version += 1

    @property
    def T_wc(self) -> Mapping[int, Matrix4]:
        """[4, 4] camera to world by number, as it is now."""
        return self._T_wc

    def T_cw(self) -> NDArray[np.float64]:
        """[K, 4, 4] world to camera, of all."""
        return np.array([keyframe.T_cw for keyframe in self._all], np.float64).reshape(-1, 4, 4)

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses."""
        return Trajectory(np.array([keyframe.timestamp_s for keyframe in self._all], np.float64), inverse(self.T_cw()))

    @property
    def latest_images(self) -> KeyframeImages:
        """The images of the latest keyframe, and what follows from them."""
        if self._images is None:
            self._images = KeyframeImages(self._all[-1], self._camera, self._noise)
        return self._images

    @overload
    def __getitem__(self, number: int) -> Keyframe: ...

    @overload
    def __getitem__(self, number: slice) -> Sequence[Keyframe]: ...

    def __getitem__(self, number: int | slice) -> Keyframe | Sequence[Keyframe]:
        return self._all[number]

    def __len__(self) -> int:
        return len(self._all)

    def __iter__(self) -> Iterator[Keyframe]:
        return iter(self._all)
