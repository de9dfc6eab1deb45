"""Folders that a whole test run shares, and copies of them that a test may write to."""

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

LINKED = {".png", ".jpg", ".npy", ".npz", ".ply", ".obj", ".stl"}
"""Written once under a temporary name and renamed, never appended to: safe to link."""


def once(run_folder: Path, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder of a test run; the first process that asks for it makes it."""
    folder, done = run_folder / name, run_folder / f"{name}.done"
    with (run_folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.is_file():
            shutil.rmtree(folder, ignore_errors=True)
            make(folder)
            done.touch()
    return folder


def copy_of(folder: Path, to: Path) -> Path:
    """Copy a folder to one that a test may write to; images and meshes are linked, not copied."""

    def link(source: str, target: str) -> object:
        if Path(source).suffix in LINKED:
            return os.link(source, target)
        return shutil.copy2(source, target)

    return Path(shutil.copytree(folder, to, copy_function=link))
