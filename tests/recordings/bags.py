"""Bags of ROS 1 and ROS 2, MCAP, and one as RealSense's recorder writes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.recordings.shots import CX, CY, FX, FY, Case, H, K, Shot, W, encoded, shots

TIMES = (1700000000.0, 1700000000.04, 1700000000.08)
Write = Callable[[str, str, int, Any], None]  # topic, type, time in ns, message


class _Bag:
    """rosbags' writers behind one call; `make` builds messages of the bag's version of ROS."""

    def __init__(self, path: Path, version: int, plugin: str = "SQLITE3") -> None:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore

        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        if version == 1:
            self.writer: Any = rosbag1.Writer(path)
        else:
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=getattr(rosbag2.StoragePlugin, plugin))
        self.writer.open()
        self.connections: dict[str, Any] = {}

    def make(self, kind: str, **values: Any) -> Any:
        if kind == "std_msgs/msg/Header" and self.version == 1:
            values["seq"] = 0
        if kind == "sensor_msgs/msg/CameraInfo" and self.version == 1:
            values = {name.upper() if name in "kdrp" else name: value for name, value in values.items()}
        return self.store.types[kind](**values)

    def write(self, topic: str, kind: str, time_ns: int, **values: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.make(kind, **values)
        data = (
            self.store.serialize_ros1(message, kind) if self.version == 1 else self.store.serialize_cdr(message, kind)
        )
        self.writer.write(self.connections[topic], time_ns, data)

    def header(self, time_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def image(self, topic: str, time_ns: int, encoding: str, pixels: np.ndarray, frame: str = "colour") -> None:
        rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
        padded = np.pad(rows, ((0, 0), (0, 4)))  # drivers may align rows
        self.write(
            topic, "sensor_msgs/msg/Image", time_ns, header=self.header(time_ns, frame), height=len(pixels),
            width=pixels.shape[1], encoding=encoding, is_bigendian=0, step=padded.shape[1], data=padded.ravel(),
        )  # fmt: skip

    def compressed(self, topic: str, time_ns: int, form: str, data: bytes) -> None:
        header = self.header(time_ns, "colour")
        kind = "sensor_msgs/msg/CompressedImage"
        self.write(topic, kind, time_ns, header=header, format=form, data=np.frombuffer(data, np.uint8))

    def camera(self, topic: str, time_ns: int, matrix: np.ndarray = K) -> None:
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        self.write(
            topic, "sensor_msgs/msg/CameraInfo", time_ns, header=self.header(time_ns, "colour"), height=H, width=W,
            distortion_model="plumb_bob", d=np.zeros(5), k=matrix.ravel(), r=np.eye(3).ravel(),
            p=np.hstack([matrix, np.zeros((3, 1))]).ravel(), binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    def transform(self, t: tuple[float, float, float]) -> Any:
        return self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", x=t[0], y=t[1], z=t[2]),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )


def stamped() -> list[tuple[Shot, int]]:
    return [(shot, round(time_s * 1e6) * 1000) for shot, time_s in zip(shots(), TIMES, strict=True)]


def write_raw(bag: _Bag, colour_topic: str = "/camera/color/image_raw", depth_mm: bool = True) -> None:
    """Registered depth, and a depth image and an infrared one that are not meant."""
    for shot, time_ns in stamped():
        bag.camera("/camera/color/camera_info", time_ns)
        bag.image(colour_topic, time_ns, "bgr8", shot.colour[..., ::-1])
        bag.image("/camera/depth/image_rect_raw", time_ns, "16UC1", shot.depth_mm // 2)
        bag.image("/camera/infra1/image_rect_raw", time_ns, "mono8", shot.colour[..., 0])
        depth, encoding = (shot.depth_mm, "16UC1") if depth_mm else (shot.depth_m, "32FC1")
        bag.image("/camera/aligned_depth_to_color/image_raw", time_ns + 3_000_000, encoding, depth)
    bag.writer.close()


def write_ros1(folder: Path) -> Path:
    write_raw(_Bag(folder / "room.bag", 1))
    return folder / "room.bag"


def write_ros2(folder: Path) -> Path:
    write_raw(_Bag(folder / "room", 2), depth_mm=False)
    return folder / "room"


def write_mcap(folder: Path) -> Path:
    """Compressed images, and only the file of the bag."""
    bag = _Bag(folder / "room", 2, "MCAP")
    for shot, time_ns in stamped():
        bag.camera("/color/camera_info", time_ns)
        bag.compressed("/color/image/compressed", time_ns, "rgb8; jpeg compressed bgr8", encoded(shot.colour, ".jpg"))
        png = bytes(12) + encoded(shot.depth_mm, ".png")
        bag.compressed("/depth/image/compressedDepth", time_ns, "16UC1; compressedDepth png", png)
    bag.writer.close()
    (file,) = (folder / "room").glob("*.mcap")
    return file.rename(folder / "room.mcap")


MOTION = (0.015, 0.001, -0.002)  # T_colour_depth of the RealSense bag


def write_realsense(folder: Path) -> Path:
    """Depth with a camera of its own, in units of 0.1 mm."""
    bag = _Bag(folder / "realsense.bag", 1)
    depth, colour = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
    start = stamped()[0][1]
    bag.write("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", start, data=0.0001)
    for stream, t in ((depth, (0.0, 0.0, 0.0)), (colour, MOTION)):
        motion = bag.transform(t)
        values = {"translation": motion.translation, "rotation": motion.rotation}
        bag.write(f"{stream}/tf/0", "geometry_msgs/msg/Transform", start, **values)
    bag.camera(f"{depth}/info/camera_info", start, np.array([[20.0, 0, 16], [0, 20, 12], [0, 0, 1]]))
    bag.camera(f"{colour}/info/camera_info", start)
    for shot, time_ns in stamped():
        bag.image(f"{depth}/image/data", time_ns, "mono16", shot.depth_mm * 10)
        bag.image(f"{colour}/image/data", time_ns, "rgb8", shot.colour)
    bag.writer.close()
    return folder / "realsense.bag"


def without_depth(path: Path) -> None:
    path.unlink()
    bag = _Bag(path, 1)
    bag.image("/camera/color/image_raw", stamped()[0][1], "rgb8", shots()[0].colour)
    bag.writer.close()


def cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def scribble(path: Path) -> None:
    """Zeros in the middle of the file, where images are."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle - 3000 : middle + 3000] = bytes(6000)
    path.write_bytes(bytes(data))


COMMON: dict[str, Any] = {"times_s": TIMES, "has_poses": False, "intrinsics": (FX, FY, CX, CY)}
ROS1 = Case(
    "ros",
    write_ros1,
    {
        "cut": (lambda path: cut(path, 0.6), r"room\.bag: not a bag that can be read"),
        "no bag": (lambda path: path.write_bytes(b"#ROSBAG V2.0\n"), r"room\.bag: not a bag that can be read"),
        "no depth": (without_depth, r"room\.bag: holds no depth images .*/camera/color/image_raw"),
    },
    name="ros1",
    **COMMON,
)
ROS2 = Case(
    "ros",
    write_ros2,
    {
        "metadata": (lambda path: (path / "metadata.yaml").write_text("a: [1"), r"room: not a bag that can be read"),
        "version": (lambda path: (path / "metadata.yaml").write_text("a: 1"), r"room: not a bag that can be read"),
        "database": (lambda path: cut(next(path.glob("*.db3")), 0.3), r"room: "),
    },
    name="ros2",
    **COMMON,
)
MCAP = Case(
    "ros",
    write_mcap,
    {
        "cut": (lambda path: cut(path, 0.02), r"room\.mcap: not a bag that can be read"),
        "no bag": (lambda path: path.write_bytes(b"\x89MCAP0\r\n"), r"room\.mcap: not a bag that can be read"),
        "image": (scribble, r"room\.mcap: "),
    },
    colour_steps=6,
    name="mcap",
    **COMMON,
)
REALSENSE = Case("ros", write_realsense, {**ROS1.damages}, name="realsense", **COMMON)
