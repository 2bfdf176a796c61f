"""Logs written by the libraries of their formats, with values that are functions of the time."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

START = 1_700_000_000 * 10**9
"""ns: time of the first messages."""

SECONDS = 2.0


def pose(t: float) -> tuple[float, float, float]:
    """x, y (m) and yaw (rad) at a time (s)."""
    return 2.0 * t, np.sin(t), 0.9 * t - 1.0


def spin(t: float) -> list[float]:
    """Angular velocity, rad/s."""
    return [0.1 * t, -t, 0.9]


def colour(t: float) -> np.ndarray:
    """(4, 6, 3) image that becomes brighter."""
    return np.full((4, 6, 3), [100, 50, 20 * t], np.uint8)


def stage(t: float) -> str:
    return "reach" if t < 1.0 else "lift"


@dataclass(frozen=True)
class Stream:
    """Messages every ``period`` s from ``first`` s on. name: of the ROS type."""

    name: str
    period: float
    first: float = 0.0

    def times(self) -> np.ndarray:
        """(N,) s since ``START``."""
        return self.first + self.period * np.arange(int((SECONDS - self.first) / self.period + 1e-9) + 1)


STREAMS = {
    "/truth": Stream("nav_msgs/msg/Odometry", 0.02),
    "/odom": Stream("nav_msgs/msg/Odometry", 0.03, 0.31),
    "/imu": Stream("sensor_msgs/msg/Imu", 0.007, 0.1),
    "/camera": Stream("sensor_msgs/msg/Image", 0.2, 0.05),
    "/preview": Stream("sensor_msgs/msg/CompressedImage", 0.5, 0.01),
    "/stage": Stream("std_msgs/msg/String", 0.25, 0.6),
}
"""Topic -> its messages."""


def held(topic: str, ticks: np.ndarray) -> np.ndarray:
    """(T,) time of the last message of a topic at or before each tick, s; NaN without one."""
    times = STREAMS[topic].times()
    return np.array([max(times[times <= tick + 1e-9], default=np.nan) for tick in ticks])


def in_order() -> Iterator[tuple[str, float, int]]:
    """Topic, time in s, and time in ns of all messages in the order of their times."""
    every = [(float(t), topic) for topic, stream in STREAMS.items() for t in stream.times()]
    for t, topic in sorted(every):
        yield topic, t, START + round(t * 1e9)


def png(image: np.ndarray) -> bytes:
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image).save(data, "png")
    return data.getvalue()


def fields(topic: str, t: float) -> dict[str, Any]:
    """A message as nested fields."""
    header = {"stamp": {"sec": int(t), "nanosec": 0}, "frame_id": "map"}
    match topic:
        case "/truth" | "/odom":
            x, y, yaw = pose(t)
            half = {"x": 0.0, "y": 0.0, "z": np.sin(yaw / 2), "w": np.cos(yaw / 2)}
            covariance = (np.diag([0.04, 0.09, 1.0, 1.0, 1.0, 0.01]) * (1.0 + t)).ravel()
            zero = {"x": 0.0, "y": 0.0, "z": 0.0}
            place = {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": half}, "covariance": covariance}
            twist = {"twist": {"linear": zero, "angular": zero}, "covariance": np.zeros(36)}
            return {"header": header, "child_frame_id": "base", "pose": place, "twist": twist}
        case "/imu":
            zero = {"x": 0.0, "y": 0.0, "z": 0.0}
            turn = dict(zip("xyz", spin(t), strict=True))
            names = ("orientation_covariance", "angular_velocity_covariance", "linear_acceleration_covariance")
            values = {"orientation": zero | {"w": 1.0}, "angular_velocity": turn, "linear_acceleration": zero}
            parts = [pair for n, c in zip(values, names, strict=True) for pair in ((n, values[n]), (c, np.zeros(9)))]
            return {"header": header, **dict(parts)}
        case "/camera":
            image = colour(t)
            size = {"height": 4, "width": 6, "encoding": "rgb8", "is_bigendian": 0, "step": 18}
            return {"header": header, **size, "data": image.ravel()}
        case "/preview":
            return {"header": header, "format": "png", "data": np.frombuffer(png(colour(t)), np.uint8)}
    return {"data": stage(t)}


def mcap_writer(stream: io.BufferedWriter, plain: bool) -> Any:
    from mcap.writer import CompressionType, Writer

    compression = CompressionType.NONE if plain else CompressionType.ZSTD
    return Writer(stream, chunk_size=20_000, compression=compression, enable_crcs=not plain)


def write_json_mcap(path: Path, plain: bool = False) -> None:
    """MCAP with JSON messages; bytes are base64. plain: without compression and checksums."""
    import base64

    def encode(value: Any) -> Any:
        return base64.b64encode(value.tobytes()).decode() if value.dtype == np.uint8 else value.tolist()

    with path.open("wb") as stream:
        writer = mcap_writer(stream, plain)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in STREAMS}
        for topic, t, time in in_order():
            data = json.dumps(fields(topic, t), default=encode).encode()
            writer.add_message(channels[topic], time, data, time)
        writer.finish()


def ros_store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def ros_message(store: Any, name: str, values: dict[str, Any]) -> Any:
    """A message of rosbags from nested fields."""
    types = dict(store.fielddefs[name][1])
    parts = {
        key: ros_message(store, types[key][1], value) if isinstance(value, dict) else value
        for key, value in values.items()
    }
    return store.types[name](**parts)


def write_ros_mcap(path: Path, plain: bool = False) -> None:
    """MCAP with CDR messages, written by the mcap library."""
    store = ros_store()
    with path.open("wb") as stream:
        writer = mcap_writer(stream, plain)
        writer.start("ros2")
        channels = {}
        for topic, entry in STREAMS.items():
            definition = store.generate_msgdef(entry.name, ros_version=2)[0].encode()
            schema = writer.register_schema(entry.name, "ros2msg", definition)
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, t, time in in_order():
            name = STREAMS[topic].name
            data = store.serialize_cdr(ros_message(store, name, fields(topic, t)), name)
            writer.add_message(channels[topic], time, bytes(data), time)
        writer.finish()


def write_bag(path: Path, storage: str = "SQLITE3", compression: str = "") -> None:
    """ROS 2 bag, a folder; compression: ``FILE`` or ``MESSAGE``."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = ros_store()
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage])
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connections = {t: writer.add_connection(t, s.name, typestore=store) for t, s in STREAMS.items()}
        for topic, t, time in in_order():
            name = STREAMS[topic].name
            writer.write(
                connections[topic], time, store.serialize_cdr(ros_message(store, name, fields(topic, t)), name)
            )


def write_rerun(path: Path) -> None:
    """Rerun recording of another program, with the time since ``START`` and the number of the message as timelines."""
    import rerun as rr

    recording = rr.RecordingStream("other", recording_id="log")
    recording.save(path)
    for number, (topic, t, time) in enumerate(in_order()):
        recording.set_time("sim", duration=np.timedelta64(time - START, "ns"))
        recording.set_time("number", sequence=number)
        match topic:
            case "/truth" | "/odom":
                x, y, yaw = pose(t)
                rotation = rr.Quaternion(xyzw=[0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
                recording.log(topic, rr.Transform3D(translation=[x, y, 0.0], rotation=rotation))
            case "/imu":
                recording.log(topic, rr.Scalars(spin(t)))
                recording.log("/turn", rr.Scalars(spin(t)[1]))
                recording.log("/matrix", rr.Tensor(np.array([spin(t), pose(t)])))
            case "/camera":
                recording.log(topic, rr.Image(colour(t)[:, :, ::-1], color_model="BGR"))
                recording.log("/depth", rr.DepthImage(np.full((4, 6), 1000 * t, np.uint16), meter=1000))
            case "/preview":
                recording.log(topic, rr.EncodedImage(contents=png(colour(t)), media_type="image/png"))
            case _:
                recording.log(topic, rr.TextLog(stage(t)))
    recording.disconnect()


EPISODES = (7, 4, 9)
"""Lengths of the episodes of replay buffers and data sets."""


def buffer_arrays() -> dict[str, np.ndarray]:
    """Arrays over the steps of all episodes."""
    steps = np.arange(sum(EPISODES))
    action = np.stack([steps, 0.5 * steps], axis=1).astype(np.float32)
    state = np.stack([0.1 * steps, -0.2 * steps, np.sin(steps)], axis=1)
    image = np.stack([colour(0.4 * step) for step in steps])
    return {
        "action": action,
        "state": state,
        "img": image.astype(np.float32),
        "camera": image,
        "obs/pose": state[:, :2],
    }


def write_zarr(path: Path, zarr_format: int = 3) -> None:
    """Replay buffer in a folder, or a zip archive if the path ends in .zip."""
    import zarr

    is_zip = path.suffix == ".zip"
    store = zarr.storage.ZipStore(path, mode="w") if is_zip else zarr.storage.LocalStore(path)
    group = zarr.create_group(store, zarr_format=zarr_format)
    data, meta = group.create_group("data"), group.create_group("meta")
    for name, array in buffer_arrays().items():
        stored = data.create_array(name, shape=array.shape, dtype=array.dtype, chunks=(8, *array.shape[1:]))
        stored[:] = array
    ends = meta.create_array("episode_ends", shape=(len(EPISODES),), dtype="i8")
    ends[:] = np.cumsum(EPISODES)
    store.close()


FPS = 10
FRAME = (32, 48)


def level(episode: int, frame: int) -> int:
    """Grey level of a frame of the videos."""
    return 40 + 60 * episode + 5 * frame


def write_lerobot(path: Path, video: bool = True) -> None:
    """LeRobot data set in the layout of version 3: two data files, and two videos, one with two episodes."""
    import pyarrow as pa
    from pyarrow import parquet

    starts = np.cumsum([0, *EPISODES])
    arrays, rows = buffer_arrays(), []
    features = {
        name: {"dtype": str(arrays[key].dtype), "shape": list(arrays[key].shape[1:]), "names": None}
        for name, key in (("observation.state", "state"), ("action", "action"))
    }
    height, width = FRAME
    features["observation.images.wrist"] = {
        "dtype": "image",
        "shape": [4, 6, 3],
        "names": ["height", "width", "channel"],
    }
    if video:
        features["observation.images.top"] = {"dtype": "video", "shape": [height, width, 3], "names": None}
    tables = []
    for episode, length in enumerate(EPISODES):
        at = slice(starts[episode], starts[episode + 1])
        images = [{"bytes": png(image), "path": None} for image in arrays["camera"][at]]
        columns = {
            "observation.state": pa.array(list(arrays["state"][at]), pa.list_(pa.float64(), 3)),
            "action": pa.array(list(arrays["action"][at]), pa.list_(pa.float32(), 2)),
            "observation.images.wrist": images,
            "timestamp": pa.array(np.arange(length) / FPS, pa.float32()),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, episode),
            "index": np.arange(at.start, at.stop),
            "task_index": np.zeros(length, int),
        }
        tables.append(pa.table(columns))
        file, first = (0, sum(EPISODES[:episode])) if episode < 2 else (1, 0)
        row = {"episode_index": episode, "tasks": ["drive"], "length": length, "data/chunk_index": 0}
        row |= {"data/file_index": file, "dataset_from_index": int(at.start), "dataset_to_index": int(at.stop)}
        top = "videos/observation.images.top"
        row |= {f"{top}/chunk_index": 0, f"{top}/file_index": file, f"{top}/from_timestamp": first / FPS}
        rows.append(row | {f"{top}/to_timestamp": (first + length) / FPS})
    for file, part in enumerate((tables[:2], tables[2:])):
        target = path / "data" / "chunk-000" / f"file-{file:03d}.parquet"
        target.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.concat_tables(part), target)
        if video:
            episodes = [(e, n) for e, n in enumerate(EPISODES) if (e < 2) == (file == 0)]
            target = path / "videos" / "observation.images.top" / "chunk-000" / f"file-{file:03d}.mp4"
            write_video(target, [level(e, frame) for e, n in episodes for frame in range(n)])
    meta = path / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    meta.parent.mkdir(parents=True)
    parquet.write_table(pa.Table.from_pylist(rows), meta)
    info = {"codebase_version": "v3.0", "robot_type": "test", "fps": FPS, "features": features}
    info |= {"total_episodes": len(EPISODES), "total_frames": int(starts[-1]), "splits": {"train": "0:3"}}
    (path / "meta" / "info.json").write_text(json.dumps(info))


def write_video(path: Path, levels: list[int]) -> None:
    """Grey frames in H.264, as LeRobot writes them: pixels in YUV with half the resolution of colours."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "10", "g": "2"})
        stream.height, stream.width = FRAME
        stream.pix_fmt = "yuv420p"
        for grey in levels:
            frame = av.VideoFrame.from_ndarray(np.full((*FRAME, 3), grey, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


MESSAGE_LOGS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "mcap-json": ("log.mcap", write_json_mcap),
    "mcap-ros2": ("log.mcap", write_ros_mcap),
    "bag-sqlite3": ("bag", write_bag),
    "bag-mcap": ("bag", lambda path: write_bag(path, "MCAP")),
    "bag-messages-zstd": ("bag", lambda path: write_bag(path, compression="MESSAGE")),
    "bag-file-zstd": ("bag", lambda path: write_bag(path, compression="FILE")),
}
"""Format -> name of the file or folder, and its writer."""
