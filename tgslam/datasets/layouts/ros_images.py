"""Messages sensor_msgs/Image and CompressedImage of ROS 1 and 2 as images.

Compressed depth is what compressed_depth_image_transport writes: 12 bytes of header, two floats A and B in it, and a
PNG. Float depth is stored as whole numbers v of its inverse, z = A / (v - B).
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.datasets import image_files as images
from tgslam.datasets.image_header import MOST_PIXELS
from tgslam.errors import FrameError

COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
_DEPTH_TYPES: dict[str, np.dtype[Any]] = {
    "16uc1": np.dtype(np.uint16),
    "mono16": np.dtype(np.uint16),
    "32fc1": np.dtype(np.float32),
}
_TO_RGB = {  # channels, and OpenCV's conversion
    "rgb8": (3, None), "8uc3": (3, cv2.COLOR_BGR2RGB), "bgr8": (3, cv2.COLOR_BGR2RGB), "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB), "mono8": (1, cv2.COLOR_GRAY2RGB), "8uc1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY), "yuyv": (2, cv2.COLOR_YUV2RGB_YUYV),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUYV), "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB), "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
}  # fmt: skip
_GREY = ("mono8", "8uc1")
_HEADER = struct.Struct("<iff")


def kind_of(message: Any) -> str:
    """ "depth", "colour", "grey", or "" for what is no image that can be read."""
    if hasattr(message, "format"):
        text = message.format.lower()
        if "compresseddepth" in text or text.startswith(tuple(_DEPTH_TYPES)):
            return "depth"
        return "grey" if text.startswith("mono8") else "colour"
    encoding = message.encoding.lower()
    if encoding in _DEPTH_TYPES:
        return "depth"
    return "grey" if encoding in _GREY else "colour" if encoding in _TO_RGB else ""


def colour_of(message: Any, name: str) -> NDArray[np.uint8]:
    """[H, W, 3] RGB. Raises FrameError."""
    if hasattr(message, "format"):
        return images.decode_colour(bytes(message.data), name)
    channels, conversion = _TO_RGB.get(message.encoding.lower(), (0, None))
    if not channels:
        raise FrameError(f"{name}: its encoding {message.encoding!r} is not known as colour")
    pixels = _pixels(message, np.dtype(np.uint8), channels, name)
    if channels == 1:
        pixels = pixels[..., 0]
    return np.ascontiguousarray(pixels if conversion is None else cv2.cvtColor(pixels, conversion))


def depth_of(message: Any, name: str) -> NDArray[Any]:
    """[H, W]: whole numbers, or float metres. Raises FrameError."""
    if hasattr(message, "format"):
        return _compressed_depth(bytes(message.data), message.format.lower(), name)
    dtype = _DEPTH_TYPES.get(message.encoding.lower())
    if dtype is None:
        raise FrameError(f"{name}: its encoding {message.encoding!r} is not known as depth")
    return _pixels(message, dtype, 1, name)[..., 0].copy()


def _pixels(message: Any, dtype: np.dtype[Any], channels: int, name: str) -> NDArray[Any]:
    """[H, W, channels] without what pads the rows."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.asarray(message.data, np.uint8).ravel()
    row = width * channels * dtype.itemsize
    if not 0 < width * height <= MOST_PIXELS or step < row or len(data) < step * height:
        raise FrameError(f"{name}: {len(data)} bytes in rows of {step} are no image of {width}x{height} px")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    order = dtype.newbyteorder(">" if message.is_bigendian else "<")
    return rows.view(order).astype(dtype).reshape(height, width, channels)


def _compressed_depth(data: bytes, form: str, name: str) -> NDArray[Any]:
    if "compresseddepth" not in form:
        return images.decode_raw_depth(data, name)
    if len(data) <= _HEADER.size:
        raise FrameError(f"{name}: {len(data)} bytes are no compressed depth image")
    _, a, b = _HEADER.unpack_from(data)
    raw = images.decode_raw_depth(data[_HEADER.size :], name)
    if not form.startswith("32fc1") or raw.dtype.kind == "f":
        return raw
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(raw > 0, np.float32(a) / (raw.astype(np.float32) - np.float32(b)), np.float32(0.0))
