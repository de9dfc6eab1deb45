"""realsim, Python, packages and libraries of the system."""

import os
import platform
import shutil
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version

from realsim import __version__
from realsim.app.doctor.finding import Finding, Kind
from realsim.app.doctor.isolation import Outcome
from realsim.app.doctor.packages import EXTRAS, REQUIRED, Package

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
