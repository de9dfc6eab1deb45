"""`realsim doctor`: all findings, as tables and as JSON.

Cameras and the robot: what is connected.

realsim, Python, packages and libraries of the system.

The packages that realsim stands on: what each is for, and the command that gets it.
"""

import os
import platform
import shutil
import socket
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from realsim import __version__
from realsim.app.console import Console
from realsim.app.doctor.machine import Finding, Kind, Outcome, isolated, machine_findings
from realsim.errors import InputError
from realsim.interop import offer

REINSTALL = "`uv sync --inexact`, or `pip install realsim` once more"
"""How a required package is got."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Package:
    """A package of the index."""

    name: str
    """On the index, as pyproject.toml has it."""
    module: str
    """As it is imported; empty where it holds files only."""
    use: str
    """What realsim does with it."""
    extra: str = ""
    """The extra it belongs to; empty where it is required."""

    @property
    def how(self) -> str:
        """The command that gets it."""
        return offer(self.extra) if self.extra else REINSTALL


_REQUIRED = (
    ("numpy", "numpy", "arrays"),
    ("scipy", "scipy", "optimisation, search trees"),
    ("numba", "numba", "inner loops"),
    ("open3d-cpu", "open3d", "point clouds, ray casting, ICP"),
    ("kiss-icp", "kiss_icp", "camera motion from depth alone"),
    ("pycolmap", "pycolmap", "structure from motion"),
    ("gtsam", "gtsam", "factor graphs"),
    ("opencv-python-headless", "cv2", "images, targets"),
    ("pyrealsense2", "pyrealsense2", "RealSense cameras"),
    ("pybullet", "pybullet", "the Robot School's physics"),
    ("trimesh", "trimesh", "mesh files"),
    ("rosbags", "rosbags", "ROS recordings"),
    ("viser", "viser", "the review in the browser"),
    ("click", "click", "this command line"),
    ("rich", "rich", "tables and progress"),
    ("matplotlib", "matplotlib", "plots of the reports"),
    ("pillow", "PIL", "textures"),
    ("msgspec", "msgspec", "the project's own files"),
    ("jinja2", "jinja2", "pages"),
    ("threadpoolctl", "threadpoolctl", "one thread where more cost time"),
    ("eaik", "eaik.IK_Robot", "inverse kinematics"),
    ("coacd", "coacd", "convex parts of meshes"),
    ("libusb-package", "libusb_package", "libusb without the system's"),
    ("reportlab", "reportlab", "calibration targets as PDF"),
    ("ruamel.yaml", "ruamel.yaml", "YAML files"),
    ("coal", "coal", "collision distances"),
    ("pin", "pinocchio", "the arm's kinematics"),
    ("ompl", "ompl", "motion planning"),
    ("ur-rtde", "rtde_control", "the UR robot"),
    ("toppra", "toppra", "time along the arm's path"),
    ("h5py", "h5py", "HDF5 files"),
    ("isal", "isal", "fast compression of images"),
)
_EXTRAS = (
    ("looks", "example-robot-data", "", "the UR5's own meshes in the replay"),
    ("usd", "usd-core", "pxr.Usd", "USD files, scenes for Isaac Sim"),
    ("franka", "franky-control", "franky", "captures with a Franka arm"),
    ("lerobot", "av", "av", "demonstrations with videos"),
    ("lerobot", "pyarrow", "pyarrow", "tables of demonstrations"),
    ("parquet", "pyarrow", "pyarrow", "grasps as Parquet tables"),
    ("mujoco", "mujoco", "mujoco", "the Robot School's second engine"),
    ("cluster", "ray", "ray", "the Robot School on several machines"),
    ("photo", "mitsuba", "mitsuba", "photoreal pictures"),
    ("photo", "pyoidn", "pyoidn", "the denoiser of photoreal pictures"),
    ("photo", "karellen-llvm-core", "", "what Mitsuba compiles with"),
)
REQUIRED = tuple(Package(name=n, module=m, use=u) for n, m, u in _REQUIRED)
EXTRAS = tuple(Package(name=n, module=m, use=u, extra=e) for e, n, m, u in _EXTRAS)


PYTHON = (3, 11)
"""The only one that every required package has a wheel for."""
LEAST_GLIBC = (2, 35)
"""Least version of glibc that open3d's wheel runs on."""
LIBUSB = "libusb-1.0.so.0"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox")


def software_probes() -> list[str]:
    """Return the probes that `software_findings` needs."""
    modules = [p.module for p in (*REQUIRED, *EXTRAS) if p.module and _version(p) is not None]
    return [f"library:{LIBUSB}", *(f"import:{m}" for m in modules)]


def software_findings(outcomes: Mapping[str, Outcome]) -> list[Finding]:
    """Return versions, and what is missing with the command that gets it."""
    return [
        *_platform(),
        *(_package(p, outcomes) for p in REQUIRED),
        *(_package(p, outcomes) for p in EXTRAS),
        _libusb(outcomes),
        _browser(),
    ]


def _platform() -> list[Finding]:
    group = "realsim and Python"
    python = platform.python_version()
    fits = sys.version_info[:2] == PYTHON
    machine = f"{platform.system()} {platform.machine()}"
    name, glibc = platform.libc_ver()
    number = tuple(int(n) for n in glibc.split(".")[:2]) if glibc else ()
    known = machine == "Linux x86_64"
    found = [
        Finding(group=group, name="realsim", kind="ok", found=__version__),
        Finding(
            group=group, name="Python", kind="ok" if fits else "problem", found=python,
            todo="" if fits else "install Python 3.11: PyBullet has no wheel for a later one",
        ),
        Finding(
            group=group, name="system", kind="ok" if known else "note", found=machine,
            todo="" if known else "realsim is tested on Linux x86_64 only",
        ),
    ]  # fmt: skip
    if number:
        old = number < LEAST_GLIBC
        todo = "open3d's wheel needs 2.35: Debian 12, Ubuntu 22.04 or later" if old else ""
        kind: Kind = "problem" if old else "ok"
        found.append(Finding(group=group, name=name, kind=kind, found=glibc, todo=todo))
    return found


def _version(package: Package) -> str | None:
    try:
        return version(package.name)
    except PackageNotFoundError:
        return None


def _package(package: Package, outcomes: Mapping[str, Outcome]) -> Finding:
    group = f"Extras ({_extras()})" if package.extra else "Required packages"
    number = _version(package)
    missing: Kind = "note" if package.extra else "problem"
    if number is None:
        return Finding(
            group=group, name=package.name, kind=missing, found=f"not installed: {package.use}",
            todo=package.how,
        )  # fmt: skip
    outcome = outcomes.get(f"import:{package.module}", Outcome(ok=True, told=""))
    if outcome.ok:
        return Finding(group=group, name=package.name, kind="ok", found=f"{number}: {package.use}")
    said = " ".join(str(outcome.told).split())
    return Finding(
        group=group, name=package.name, kind=missing, found=f"{number} cannot be loaded: {said}",
        todo=f"see the libraries below; else {package.how}",
    )  # fmt: skip


def _extras() -> str:
    return ", ".join(dict.fromkeys(p.extra for p in EXTRAS))


def _libusb(outcomes: Mapping[str, Outcome]) -> Finding:
    group, use = "Libraries of the system", "RealSense cameras"
    camera = outcomes.get("import:pyrealsense2", Outcome(ok=False, told=""))
    if camera.ok or outcomes[f"library:{LIBUSB}"].ok:  # the wheel libusb-package brings one
        return Finding(group=group, name=LIBUSB, kind="ok", found=use)
    return Finding(
        group=group, name=LIBUSB, kind="problem", found=f"missing: {use} need it",
        todo="`sudo apt-get install --no-install-recommends libusb-1.0-0`",
    )  # fmt: skip


def _browser() -> Finding:
    group = "Libraries of the system"
    there = [name for name in BROWSERS if shutil.which(name)]
    if there:
        return Finding(group=group, name="browser", kind="ok", found=there[0])
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    todo = "`sudo apt-get install chromium`" if display else "open the pages on another machine"
    return Finding(
        group=group, name="browser", kind="note", found="none: pages and review need one",
        todo=todo,
    )  # fmt: skip


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


NUMBA, CAMERAS = "numba-cache", "realsense"
HEADER = ("", "", "found", "what to do")


def examine(
    session: Path | None, robot_host: str, console: Console, settings: Sequence[Finding] = ()
) -> list[Finding]:
    """Look at everything.

    Args:
        session: whose disk is looked at; None = the current folder's.
        robot_host: address of the robot's controller; empty = it is not asked.
        console: progress goes there.
        settings: findings about the file of settings.

    Raises:
        InputError: `session` is no folder.
    """
    if session is not None and not session.is_dir():
        raise InputError(f"'{session}' is no folder; give the folder of a session, or nothing.")
    with console.stage("doctor", "libraries and devices") as tick:
        outcomes = isolated([*software_probes(), NUMBA, CAMERAS], tick)
    robot = robot_findings(robot_host) if robot_host else []
    return [
        *software_findings(outcomes),
        *settings,
        *machine_findings(session, outcomes[NUMBA]),
        *camera_findings(outcomes[CAMERAS]),
        *robot,
    ]


def show(findings: Sequence[Finding], console: Console) -> bool:
    """Print the findings; return whether there is no problem."""
    for group in dict.fromkeys(f.group for f in findings):
        rows = [[f.name, f.kind, f.found, f.todo] for f in findings if f.group == group]
        told = any(row[3] for row in rows)
        width = 4 if told else 3
        console.table(group, HEADER[:width], [row[:width] for row in rows])
    problems = [f for f in findings if f.kind == "problem"]
    notes = sum(f.kind == "note" for f in findings)
    if problems:
        names = ", ".join(p.name for p in problems)
        console.say(f"{len(problems)} problems, {notes} notes: {names}")
    else:
        console.say(f"everything that realsim needs is there ({notes} notes).")
    console.result({"ok": not problems, "findings": list(findings)})
    return not problems
