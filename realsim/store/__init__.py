"""A session on disk: atomic, checksummed, resumable."""

from realsim.store.atomic import StorageError
from realsim.store.results import (
    load_board,
    load_grasps,
    load_hand_eye,
    load_scene,
    save_board,
    save_grasps,
    save_hand_eye,
    save_scene,
)
from realsim.store.session_store import SessionStore

__all__ = [
    "SessionStore",
    "StorageError",
    "load_board",
    "load_grasps",
    "load_hand_eye",
    "load_scene",
    "save_board",
    "save_grasps",
    "save_hand_eye",
    "save_scene",
]
