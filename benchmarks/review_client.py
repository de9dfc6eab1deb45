"""A browser without a screen: it speaks Viser's websocket protocol, and counts what it is sent.

Messages of the server are [length, compressed length, zstd(msgpack), arrays]; those to it are plain
msgpack. See viser/infra/_infra.py, `_message_producer`.
"""

import time
from dataclasses import dataclass, field
from typing import Any, cast

import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect
from websockets.typing import Subprotocol

HEAD_BYTES = 16
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (0.0, 1.0, 0.0, 0.0), "position": (0.0, 0.0, 1.0),
    "fov": 1.0, "near": 0.01, "far": 100.0, "image_height": 800, "image_width": 1200,
    "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip
"""What a browser says first; before that it does not count as connected."""


@dataclass(eq=False, kw_only=True, slots=True)
class Browser:
    """A connected browser."""

    socket: Any
    received_bytes: int = 0
    messages: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """Every message so far, arrays left out."""
    _arrays: dict[int, list[bytes]] = field(default_factory=dict[int, list[bytes]])
    """The arrays that came with a message."""

    @staticmethod
    def open(url: str) -> "Browser":
        """Return a browser that has opened the page."""
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        socket = connect(
            url.replace("http", "ws", 1), subprotocols=[protocol], origin=cast(Any, url),
            max_size=None, compression=None, ping_interval=None,
        )  # fmt: skip
        browser = Browser(socket=socket)
        browser.send(CAMERA)
        return browser

    def send(self, message: dict[str, Any]) -> None:
        """Send a message of a browser."""
        self.socket.send(msgspec.msgpack.encode(message))

    def receive(self, timeout_s: float) -> bool:
        """Take one window of messages; return whether there was one in time."""
        try:
            data = self.socket.recv(timeout=timeout_s)
        except TimeoutError:
            return False
        self.received_bytes += len(data)
        length = int.from_bytes(data[8:HEAD_BYTES], "little")
        inner = zstandard.ZstdDecompressor().decompress(data[HEAD_BYTES : HEAD_BYTES + length])
        window = msgspec.msgpack.decode(inner)
        at, arrays = HEAD_BYTES + length, list[bytes]()
        for size in window["binaryBufferLengths"]:
            at += -at % 8
            arrays.append(data[at : at + size])
            at += size
        self.messages += window["messages"]
        for message in window["messages"]:
            self._arrays[id(message)] = arrays
            if message["type"] == "LocalStorageGetItemRequestMessage":  # it keeps nothing
                said = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
                self.send({"type": "LocalStorageGetItemResponseMessage"} | said)
        return True

    def until_quiet(self, quiet_s: float, timeout_s: float = 120.0) -> float:
        """Take what comes until nothing has come for a while; return when the last came [s]."""
        last = time.perf_counter()
        end = last + timeout_s
        while last <= end and self.receive(quiet_s):
            last = time.perf_counter()
        return last

    def until_scene(self, quiet_s: float, timeout_s: float = 240.0) -> None:
        """Take what comes until the scene has come, and nothing more for a while."""
        end = time.perf_counter() + timeout_s
        while not self.of_type("CameraFrustumMessage") and time.perf_counter() < end:
            self.receive(1.0)
        self.until_quiet(quiet_s)

    def array(self, message: dict[str, Any], key: str, dtype: Any = np.float32) -> np.ndarray:
        """Return an array of a message, flat."""
        index = message["props"][key]["__binary_index"]
        return np.frombuffer(self._arrays[id(message)][index], dtype)

    def count(self, message: dict[str, Any], key: str) -> int:
        """Return how many rows of three an array of a message has."""
        return self.array(message, key).size // 3

    def of_type(self, *types: str) -> list[dict[str, Any]]:
        """Return the messages of these types, in order."""
        return [m for m in self.messages if m["type"] in types]

    def control(self, label: str, kind: str = "GuiButtonMessage") -> str | None:
        """Return the uuid of the first control whose label begins so; None = there is none."""
        of_kind = self.of_type(kind)
        named = (m for m in of_kind if str(m["props"].get("label", "")).startswith(label))
        return next((str(m["uuid"]) for m in named), None)

    def set(self, uuid: str, value: Any) -> None:
        """Press a button, or set a control."""
        self.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def click_node(self, name: str, owner: str, instance_index: int | None = None) -> None:
        """Click a node of the scene."""
        self.send({
            "type": "SceneNodeClickMessage", "name": name, "instance_index": instance_index,
            "ray_origin": (0.0, 0.0, 1.0), "ray_direction": (0.0, 0.0, -1.0),
            "screen_pos": (0.5, 0.5), "modifier": None, "owner": owner,
        })  # fmt: skip

    def close(self) -> None:
        """Leave."""
        self.socket.close()
