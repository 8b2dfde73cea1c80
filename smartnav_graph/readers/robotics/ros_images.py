"""Images of a ROS bag: listed when it is read, decoded and written as pictures when the session is saved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Table, Times
from smartnav_graph.core.errors import warn
from smartnav_graph.readers.robotics.ros_bag import IMAGES, Message, Topic, messages, opened

LARGEST = 20_000  # pixels of a side
# Encoding (sensor_msgs/image_encodings.hpp) -> type, channels, conversion of OpenCV to grey or blue-green-red.
_ENCODINGS = {
    "mono8": (np.uint8, 1, ""),
    "8UC1": (np.uint8, 1, ""),
    "mono16": (np.uint16, 1, ""),
    "16UC1": (np.uint16, 1, ""),
    "bgr8": (np.uint8, 3, ""),
    "8UC3": (np.uint8, 3, ""),
    "rgb8": (np.uint8, 3, "COLOR_RGB2BGR"),
    "bgra8": (np.uint8, 4, "COLOR_BGRA2BGR"),
    "rgba8": (np.uint8, 4, "COLOR_RGBA2BGR"),
    "bayer_rggb8": (np.uint8, 1, "COLOR_BayerRGGB2BGR"),
    "bayer_bggr8": (np.uint8, 1, "COLOR_BayerBGGR2BGR"),
    "bayer_gbrg8": (np.uint8, 1, "COLOR_BayerGBRG2BGR"),
    "bayer_grbg8": (np.uint8, 1, "COLOR_BayerGRBG2BGR"),
    "yuv422": (np.uint8, 2, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (np.uint8, 2, "COLOR_YUV2BGR_YUYV"),
}


def _folder(topic: str) -> str:
    """``/cam0/image_raw`` -> ``cam0_image_raw``."""
    return "".join(mark if mark.isalnum() or mark in "-_" else "_" for mark in topic.strip("/")) or "camera"


def _name(topic: Topic | str, count: int, text: str, kind: str) -> str:
    """File of an image in the pictures of the session; empty where it cannot be written."""
    name = topic if isinstance(topic, str) else topic.name
    if kind == IMAGES[0]:
        return f"{_folder(name)}/{count:06d}.png" if text in _ENCODINGS else ""
    return f"{_folder(name)}/{count:06d}.{'png' if 'png' in text.lower() else 'jpg'}"


def image_table(cameras: Sequence[tuple[Topic, Times]]) -> Table:
    """Columns of the stream ``images``: one row an image of any topic, by time.

    Parameters
    ----------
    cameras : topics and their stamps (n,)
    """
    t_ns = np.concatenate([times for _, times in cameras])
    order = np.argsort(t_ns, kind="stable")
    files = [_name(topic, i, text, topic.kind) for topic, _ in cameras for i, text in enumerate(topic.texts)]
    for topic, _ in cameras:
        unknown = sorted({text for text in topic.texts if not _name(topic, 0, text, topic.kind)})
        if unknown:
            encodings = ", ".join(map(repr, unknown))
            warn(f"{topic.name}: images in {encodings} are not written: only {', '.join(_ENCODINGS)} are")
    names = [_folder(topic.name) for topic, times in cameras for _ in times]
    return {
        "t_ns": t_ns[order],
        "image_id": np.arange(len(order)),
        "file": np.array(files, dtype=object)[order],
        "camera": np.array(names, dtype=object)[order],
    }


def write_bag_pictures(path: Path, folder: Path) -> None:
    """Write the images of a bag as the files that `image_table` lists; one that is damaged is left out.

    Raises
    ------
    SessionError
        The bag cannot be read.
    """
    count: dict[str, int] = {}
    faulty: dict[str, int] = {}
    with opened(path) as reader:
        for connection, _, message in messages(reader, [c for c in reader.connections if c.msgtype in IMAGES]):
            topic, kind = connection.topic, connection.msgtype
            i = count[topic] = count.get(topic, -1) + 1
            raw = kind == IMAGES[0]
            name = _name(topic, i, message.encoding if raw else message.format, kind)
            data = _encoded(message) if raw else bytes(np.asarray(message.data, dtype=np.uint8))
            if not name or not data:
                faulty[topic] = faulty.get(topic, 0) + 1
                continue
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
    for topic, n in faulty.items():
        warn(f"{path}: {n} of {count[topic] + 1} images of {topic} are not written")


def _encoded(message: Message) -> bytes:
    """A raw image as PNG; empty where its size and its data do not fit."""
    if message.encoding not in _ENCODINGS or not 0 < max(message.height, message.width) <= LARGEST:
        return b""
    import cv2

    dtype, channels, conversion = _ENCODINGS[message.encoding]
    kind = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    data = np.asarray(message.data, dtype=np.uint8)
    width = message.width * channels * kind.itemsize
    if not width <= message.step or len(data) < message.height * message.step or not width:
        return b""
    rows = data[: message.height * message.step].reshape(message.height, message.step)[:, :width]
    shape = (message.height, message.width, channels)[: 2 + (channels > 1)]
    pixels = np.ascontiguousarray(rows).view(kind).reshape(shape).astype(dtype)
    ok, png = cv2.imencode(".png", cv2.cvtColor(pixels, getattr(cv2, conversion)) if conversion else pixels)
    return png.tobytes() if ok else b""
