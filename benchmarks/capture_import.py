"""Importing a recording: megabytes of bag per CPU second, and peak memory.

A bag of the simulated lab's photographs (rgb8 1280x720, 16UC1 millimetres, camera_info, 125 Hz
joint states) is written in each container and imported into a session by a fresh process.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from capture import KINDS
from figures import Found
from numpy.typing import NDArray

from realsim.arrays import UInt8, UInt16

WIDTH, HEIGHT = 1280, 720
FRAME_HZ, JOINT_HZ = 5, 125
RENDERED = 4
"""Different photographs; the others are these, shifted sideways and with new noise."""
SHIFT_PX = 37
JOINTS = ("elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint",
          "wrist_2_joint", "wrist_3_joint")  # fmt: skip
"""In the alphabetic order in which the UR driver sends them."""
Images = list[tuple[UInt8, UInt16]]


def photographs() -> tuple[Any, Images]:
    """Return the lab's camera and some of its frames: colour, depth in millimetres."""
    from realsim.geometry import se3
    from realsim.robots.arm import UR5
    from realsim_capture_plans.lab.lab import SimulatedLab

    lab = SimulatedLab()
    lab.place_objects()
    images: Images = []
    for azimuth in np.linspace(-0.5, 0.5, RENDERED):
        offset = 0.35 * np.array([-np.cos(azimuth), np.sin(azimuth), 1.2]) / np.sqrt(2.44)
        T_base_cam = se3.look_at(lab.scene_center + offset, lab.scene_center)
        reachable = UR5.inverse(T_base_cam @ se3.invert(lab.nominal_T_ee_cam))
        if len(reachable):
            lab.arm.move(reachable[0])
        frame = lab.camera.grab()
        images.append((frame.rgb, np.rint(frame.depth_m * 1e3).astype(np.uint16)))
    return lab.camera.intrinsics, images


def frames(images: Images, n: int) -> Iterator[tuple[UInt8, UInt16]]:
    """Yield n frames, no two alike."""
    rng = np.random.default_rng(0)
    for k in range(n):
        rgb, depth = images[k % len(images)]
        shift = SHIFT_PX * (k // len(images))
        noise = rng.integers(-1, 2, (HEIGHT, WIDTH, 1), dtype=np.int16)
        noisy = np.clip(np.roll(rgb, shift, axis=1) + noise, 0, 255).astype(np.uint8)
        yield noisy, np.roll(depth, shift, axis=1)


class BagWriter:
    """Writes the four topics in one of the containers."""

    def __init__(self, path: Path, kind: str, camera: Any) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.is_ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        self.t = self.store.types
        self.camera = camera
        self.writer: Any
        if self.is_ros1:
            from rosbags.rosbag1 import Writer

            self.writer = Writer(path)
        else:
            from rosbags.rosbag2 import StoragePlugin
            from rosbags.rosbag2 import Writer as Writer2

            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}

    def header(self, time_ns: int) -> Any:
        """Return a header of the colour camera's frame."""
        stamp = self.t["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
        first = (0,) if self.is_ros1 else ()
        return self.t["std_msgs/msg/Header"](*first, stamp, "camera_color_optical_frame")

    def send(self, topic: str, message: Any, time_ns: int) -> None:
        """Write a message, received at a time."""
        kind = message.__msgtype__
        if topic not in self.connections:
            store = {"typestore": self.store}
            self.connections[topic] = self.writer.add_connection(topic, kind, **store)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time_ns, serialize(message, kind))

    def image(self, topic: str, pixels: NDArray[Any], encoding: str, time_ns: int) -> None:
        """Write an image that was taken at a time."""
        flat = pixels.reshape(-1).view(np.uint8)
        step = flat.size // HEIGHT
        image = self.t["sensor_msgs/msg/Image"]
        self.send(
            topic,
            image(self.header(time_ns), HEIGHT, WIDTH, encoding, 0, step, flat),
            time_ns + 20_000_000,
        )

    def info(self, time_ns: int) -> None:
        """Write the camera for both topics."""
        roi = self.t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        K = self.camera.K
        P = np.concatenate([K, np.zeros((3, 1))], 1)
        info = self.t["sensor_msgs/msg/CameraInfo"](
            self.header(time_ns), HEIGHT, WIDTH, "plumb_bob", np.zeros(5), K.ravel(),
            np.eye(3).ravel(), P.ravel(), 0, 0, roi,
        )  # fmt: skip
        self.send("/camera/color/camera_info", info, time_ns + 20_000_000)
        self.send("/camera/aligned_depth_to_color/camera_info", info, time_ns + 20_000_000)

    def joints(self, time_ns: int) -> None:
        """Write a joint reading."""
        q = np.linspace(0.1, 0.6, 6) + 1e-3 * np.sin(time_ns * 1e-9)
        message = self.t["sensor_msgs/msg/JointState"](
            self.header(time_ns), list(JOINTS), q, np.zeros(6) + 1e-4, np.zeros(6)
        )
        self.send("/joint_states", message, time_ns + 1_000_000)


def write_bag(path: Path, kind: str, camera: Any, images: Images, mb: float) -> int:
    """Write a bag of about this many megabytes; return the bytes on disk."""
    n = max(1, round(mb * 1e6 / (WIDTH * HEIGHT * 5)))
    bag = BagWriter(path, kind, camera)
    start = 1_700_000_000 * 10**9
    with bag.writer:
        for k, (rgb, depth) in enumerate(frames(images, n)):
            t = start + k * 10**9 // FRAME_HZ
            for j in range(JOINT_HZ // FRAME_HZ):
                bag.joints(t + j * 10**9 // JOINT_HZ)
            bag.image("/camera/color/image_raw", rgb, "rgb8", t)
            bag.image("/camera/aligned_depth_to_color/image_raw", depth, "16UC1", t)
            bag.info(t)
    files = [path] if path.is_file() else list(path.iterdir())
    return sum(f.stat().st_size for f in files)


def peak_mb() -> float:
    """Return the peak resident memory of this program [MB].

    ru_maxrss of a fresh process still has its parent's from before exec; VmHWM does not.
    """
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return float(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def child(bag: Path, session: Path) -> None:
    """Import in this process and print what it took; run by `measured`."""
    from realsim.app.console import Console
    from realsim.app.importing.session import import_session
    from realsim.formats.bags import open_bag

    start, wall = time.process_time(), time.perf_counter()
    source = open_bag(bag)
    opened = time.process_time()
    import_session(source, session, Console(quiet=True))
    cpu = time.process_time() - start
    peak = peak_mb()
    row = {
        "cpu_s": cpu, "open_cpu_s": opened - start, "wall_s": time.perf_counter() - wall,
        "peak_mb": peak, "frames": len(source), "with_joints": int(source.arm.joints is not None),
    }  # fmt: skip
    print(json.dumps(row))


def measured(kind: str, camera: Any, images: Images, mb: float) -> dict[str, float]:
    """Write a bag, import it in a fresh process, and return what that took."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / ("recording.bag" if kind == "ros1" else "recording")
        size = write_bag(bag, kind, camera, images, mb)
        command = [sys.executable, __file__, str(bag), str(Path(folder) / "session")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"the import of a {kind} bag failed:\n{done.stdout}{done.stderr}")
        row: dict[str, float] = json.loads(done.stdout.strip().splitlines()[-1])
    return row | {"bag_mb": size / 1e6, "mb_per_s": size / 1e6 / row["cpu_s"]}


def imports(arguments: argparse.Namespace) -> Found:
    """Return what the import of each container takes; of one, and a fifth of it, if quick."""
    kinds, mb = (KINDS[:1], 100.0) if arguments.quick else (KINDS, 500.0)
    camera, images = photographs()
    rows = {kind: measured(kind, camera, images, mb) for kind in kinds}
    figures = {
        "import_mb_per_s": min(r["mb_per_s"] for r in rows.values()),
        "import_peak_mb": max(r["peak_mb"] for r in rows.values()),
    }
    return Found(figures=figures | {f"{k}_{n}": v for k, r in rows.items() for n, v in r.items()})


if __name__ == "__main__":
    child(Path(sys.argv[1]), Path(sys.argv[2]))
