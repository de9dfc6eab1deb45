"""Runs one probe after the other in a process of its own, and writes a line of JSON for each.

    python -m realsim.app.doctor.probe import:numpy library:libusb-1.0.so.0 numba-cache realsense

A library that crashes takes this process along and nothing else; `isolation` starts another one.
"""

import json
import os
import sys
from importlib import import_module
from typing import Any, TextIO


def main(names: list[str]) -> None:
    """Run the probes, and answer on what was stdout; what libraries print goes nowhere."""
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        for name in names:
            _answer(name, answers)
    os._exit(0)  # libraries that crash when they are unloaded have answered already


def _answer(name: str, answers: TextIO) -> None:
    kind, _, what = name.partition(":")
    try:
        told: Any = PROBES[kind](what)
        line = {"probe": name, "ok": True, "told": told}
    except Exception as error:  # whatever a library raises is its finding
        line = {"probe": name, "ok": False, "told": f"{type(error).__name__}: {error}"}
    answers.write(json.dumps(line) + "\n")
    answers.flush()


def imported(module: str) -> str:
    """Import a module as realsim does."""
    from realsim import interop

    own = getattr(interop, f"import_{module}", None)
    own() if own else import_module(module)
    return ""


def library(name: str) -> str:
    """Load a library of the system."""
    import ctypes

    ctypes.CDLL(name)
    return name


def numba_cache(_: str) -> str:
    """Return the folder that realsim's compiled functions are kept in, proven to be writable."""
    import tempfile

    from realsim.compiled import cache_folder

    cache_folder().mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=cache_folder()).close()
    return str(cache_folder())


def realsense(_: str) -> list[dict[str, str]]:
    """Return the RealSense cameras that are connected."""
    from realsim.interop import import_pyrealsense2

    rs = import_pyrealsense2()
    wanted = {
        "name": rs.camera_info.name,
        "serial": rs.camera_info.serial_number,
        "firmware": rs.camera_info.firmware_version,
        "usb": rs.camera_info.usb_type_descriptor,
    }
    return [
        {key: device.get_info(i) for key, i in wanted.items() if device.supports(i)}
        for device in rs.context().query_devices()
    ]


PROBES = {
    "import": imported,
    "library": library,
    "numba-cache": numba_cache,
    "realsense": realsense,
}

if __name__ == "__main__":
    main(sys.argv[1:])
