"""Cameras and the robot: what is connected."""

import socket
from dataclasses import replace
from typing import Any

from realsim.app.doctor.finding import Finding
from realsim.app.doctor.isolation import Outcome

GROUP = "Devices"
PORTS = {29999: "dashboard", 30004: "RTDE"}
"""Ports of a Universal Robots controller: power and programs, real-time data."""
FRANKA_PORT = 1337
"""Port of a Franka controller, open where its control interface (FCI) is active."""
TIMEOUT_S = 2.0
"""For one port of the robot [s]: in a lab's network it answers within milliseconds."""


def camera_findings(outcome: Outcome) -> list[Finding]:
    """Return the RealSense cameras."""
    name = "RealSense"
    if not outcome.ok:
        said = " ".join(str(outcome.told).split())
        return [Finding(
            group=GROUP, name=name, kind="note", found=f"could not be looked for: {said}",
            todo="see pyrealsense2 above",
        )]  # fmt: skip
    devices: list[dict[str, str]] = outcome.told
    if not devices:
        return [Finding(
            group=GROUP, name=name, kind="note", found="no camera is connected",
            todo="needed to capture; the simulated lab needs none",
        )]  # fmt: skip
    return [_camera(name, device) for device in devices]


def _camera(name: str, device: dict[str, Any]) -> Finding:
    usb = str(device.get("usb", ""))
    slow = usb.startswith("2")
    told = ", ".join(f"{k} {v}" for k, v in device.items() if k != "name")
    return Finding(
        group=GROUP, name=name, kind="note" if slow else "ok",
        found=f"{device.get('name', 'camera')}: {told}",
        todo="plug it into a USB 3 port: USB 2 has fewer sizes and frames" if slow else "",
    )  # fmt: skip


def robot_findings(host: str, timeout_s: float = TIMEOUT_S) -> list[Finding]:
    """Return whether the robot's controller answers at its ports."""
    if not _is_host(host):
        shown = host.encode("utf-8", "backslashreplace").decode()
        return [Finding(
            group=GROUP, name="robot", kind="problem",
            found=f"'{shown:.60}' is no host name: between dots there are 1 to 63 characters",
            todo="give the address from the robot's network settings, such as 192.168.1.10",
        )]  # fmt: skip
    found = [_port(host, port, use, timeout_s) for port, use in PORTS.items()]
    if all(finding.kind != "ok" for finding in found):
        fci = _port(host, FRANKA_PORT, "a Franka's control interface, FCI", timeout_s)
        if fci.kind == "ok":
            return [fci]
        franka = f" A Franka's control interface (port {FRANKA_PORT}) is closed, too: activate FCI."
        found = [replace(finding, todo=finding.todo + franka) for finding in found]
    return found


def _is_host(host: str) -> bool:
    """Return whether a name can be asked for at all; an IPv6 address can."""
    try:
        host.encode("idna")
    except UnicodeError:
        return False
    return "\0" not in host


def _port(host: str, port: int, use: str, timeout_s: float) -> Finding:
    name = f"robot {host}:{port}"
    try:
        with socket.create_connection((host, port), timeout=timeout_s):
            return Finding(group=GROUP, name=name, kind="ok", found=f"answers ({use})")
    except OSError as error:
        said = error.strerror or str(error)
    return Finding(
        group=GROUP, name=name, kind="problem", found=f"no answer ({use}): {said}",
        todo="is the robot on, the cable in, the address that of its network settings, and this "
        "machine in the same network?",
    )  # fmt: skip
