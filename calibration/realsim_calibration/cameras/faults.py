"""What is wrong with a set of several cameras, named before anything is fitted.

Where the arm moves a camera against a board, the board turns in the image by the angle that the
hand turns by; where it does not, the board stands still in the image. Angles need no calibration,
and every mistake of who is where breaks them: cameras exchanged, boards exchanged, a camera or a
board said to be where it is not.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import get_args

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, CharucoBoard, Chessboard, TagBoard
from realsim_calibration.cameras.rig import MOUNTS, PLACES, Mount, Place, Rig, RigBoard, Sighting
from realsim_calibration.fit.closed_forms import relative

OPTIONS = {"table": "--board", "hand": "--held-board", "free": "--moved-board"}
MOVES_DEG = 5.0
"""The hand must turn by so much between views (median) to tell who moves."""
FITS_DEG = 3.0
"""Angles that agree to this are the same: a planar pose seen at a slant is off by a degree or two.
"""
LEAST_VIEWS = 4
"""Fewer views of a pair do not tell who moves."""
FEW_VIEWS = 3
"""A lens is not calibrated from fewer."""


def require_distinct(boards: Sequence[RigBoard]) -> None:
    """Raise if two boards cannot be told apart in an image.

    Raises:
        InputError: they carry the same markers, or none and the same pattern.
    """
    for a, b in combinations(boards, 2):
        one, other = a.target, b.target
        alike = type(one) is type(other)
        if isinstance(one, TagBoard) and isinstance(other, TagBoard):
            same_ids = bool(set(one.ids.tolist()) & set(other.ids.tolist()))
            alike = one.family == other.family and same_ids
        elif isinstance(one, CharucoBoard) and isinstance(other, CharucoBoard):
            alike = one.dictionary == other.dictionary
        elif isinstance(one, Chessboard) and isinstance(other, Chessboard):
            alike = (one.rows, one.columns) == (other.rows, other.columns)
        if alike:
            raise InputError(
                f"boards '{a.name}' and '{b.name}' carry the same markers or pattern, so an image "
                "does not tell which of them it shows. Print one of them with other markers: "
                "another first id, another dictionary, another number of rows."
            )


def require_sightings(rig: Rig) -> None:
    """Raise if a camera never sees a board, or a board is never seen.

    Raises:
        InputError: names the camera or board and says what to do.
    """
    for c, camera in enumerate(rig.cameras):
        own = rig.of_camera(c)
        if not any(len(s.detection) for s in own):
            raise InputError(
                f"camera '{camera.name}' never sees a board: none was found in its "
                f"{len({s.instant for s in own})} images. Point it at the board, check the target "
                f"that was given, or leave the camera out of --cameras."
            )
    for b, board in enumerate(rig.boards):
        if not any(len(s.detection) for s in rig.sightings if s.board == b):
            raise InputError(
                f"board '{board.name}' ({PLACES[board.place]}) is in no image of any camera. Give "
                f"the target as it was printed ({OPTIONS[board.place]}), or leave it out."
            )


def require_sizes(rig: Rig) -> None:
    """Raise if a camera's images are of several sizes, or not of its given intrinsics' size.

    Raises:
        InputError: names the camera, and another one whose intrinsics fit.
    """
    sizes = {c: {s.detection.image_size for s in rig.of_camera(c)} for c in range(len(rig.cameras))}
    for c, camera in enumerate(rig.cameras):
        if len(sizes[c]) > 1:
            raise InputError(
                f"camera '{camera.name}' has images of several sizes: "
                f"{', '.join(sorted(f'{w}x{h}' for w, h in sizes[c]))}. One camera at one "
                "resolution is calibrated: are images of another camera among them?"
            )
        (w, h) = next(iter(sizes[c]))
        given = camera.intrinsics0
        if given is None or (given.width, given.height) == (w, h):
            continue
        others = [
            o.name for k, o in enumerate(rig.cameras)
            if k != c and sizes[k] == {(given.width, given.height)}
        ]  # fmt: skip
        hint = f" Those of '{others[0]}' are: are the two exchanged?" if others else ""
        raise InputError(
            f"camera '{camera.name}': its intrinsics are for images of {given.width}x"
            f"{given.height} px, its images are {w}x{h}.{hint} Give the file of this camera, at "
            "this resolution, with --intrinsics."
        )


def require_lenses(rig: Rig, own: Sequence[CameraIntrinsics | None], limit: float) -> None:
    """Raise if the given intrinsics of two cameras fit each other's images.

    Args:
        rig: the cameras.
        own: every camera's lens as its own images show it; None = they do not tell.
        limit: by how much a given focal length may be off, relative.

    Raises:
        InputError: names the two.
    """

    def off(image: int, file: int) -> float:
        seen, given = own[image], rig.cameras[file].intrinsics0
        if (
            seen is None
            or given is None
            or (seen.width, seen.height) != (given.width, given.height)
        ):
            return float("nan")
        return abs(float(np.log(np.sqrt(seen.fx * seen.fy / (given.fx * given.fy)))))

    for a, b in combinations(range(len(rig.cameras)), 2):
        wrong = off(a, a) > limit and off(b, b) > limit
        if wrong and off(a, b) < limit and off(b, a) < limit:
            names = rig.cameras[a].name, rig.cameras[b].name
            raise InputError(
                f"cameras '{names[0]}' and '{names[1]}' look exchanged: the images of each fit the "
                "other's intrinsics, and not its own. Exchange their folders, or their files of "
                "intrinsics (--intrinsics)."
            )


def require_motion(rig: Rig, C: dict[int, Array]) -> None:
    """Raise if cameras or boards are not where they are said to be.

    Args:
        rig: what was said.
        C: T_cam_board (4, 4) of sightings, by their places [m].

    Raises:
        InputError: names what explains the angles: two cameras or two boards exchanged, or one
            that is somewhere else.
    """
    pairs = _turns(rig, C)
    wrong = _contradictions(pairs, rig)
    if not wrong:
        return
    explained = [text for text, other in _alternatives(rig) if not _contradictions(pairs, other)]
    first = min(wrong)
    camera, board = rig.cameras[first[0]], rig.boards[first[1]]
    hand, seen = pairs[first]
    found = (
        f"camera '{camera.name}' ({MOUNTS[camera.mount]}) and board '{board.name}' "
        f"({PLACES[board.place]}) contradict the robot: between views the hand turns by "
        f"{np.degrees(np.median(hand)):.0f} deg (median), and in the image the board turns by "
        f"{np.degrees(np.median(seen)):.0f} deg"
    )
    if not explained:
        raise InputError(
            f"{found}; exchanging cameras or boards does not explain it. Check that images and "
            "poses belong together and that the board stays where you said."
        )
    raise InputError(f"{found}. This fits if {' or if '.join(explained[:3])}.")


def _turns(rig: Rig, C: dict[int, Array]) -> dict[tuple[int, int], tuple[Array, Array]]:
    """Return (turns of the hand, turns in the image) [rad] of all view pairs of (camera, board)."""
    groups: dict[tuple[int, int], list[tuple[Sighting, Array]]] = {}
    for k, T in C.items():
        s = rig.sightings[k]
        if rig.instants[s.instant].T_base_ee is not None:
            groups.setdefault((s.camera, s.board), []).append((s, T))
    found: dict[tuple[int, int], tuple[Array, Array]] = {}
    for key, group in groups.items():
        if len(group) < LEAST_VIEWS or rig.boards[key[1]].place == "free":
            continue
        hands = np.array([rig.instants[s.instant].T_base_ee for s, _ in group])
        seen = np.array([se3.invert(T) for _, T in group])
        hand, image = (np.linalg.norm(relative(Ts).turns, axis=-1) for Ts in (hands, seen))
        if np.degrees(np.median(hand)) >= MOVES_DEG:
            found[key] = hand, image
    return found


def _contradictions(
    pairs: dict[tuple[int, int], tuple[Array, Array]], said: Rig
) -> list[tuple[int, int]]:
    """Return the (camera, board) whose turns contradict what is said of them."""
    wrong: list[tuple[int, int]] = []
    for (c, b), (hand, image) in pairs.items():
        if said.boards[b].place == "free":
            continue  # it may be anywhere
        moved, still = np.median(np.abs(hand - image)), np.median(image)
        misfit, other = (moved, still) if said.moves(c, b) else (still, moved)
        if np.degrees(misfit) > FITS_DEG and misfit > 2 * other:
            wrong.append((c, b))
    return wrong


def _alternatives(rig: Rig) -> Iterator[tuple[str, Rig]]:
    """Yield other readings of a rig, each with the words for it; the likeliest first."""
    for what, parts in (("camera", rig.cameras), ("board", rig.boards)):
        for a, b in combinations(range(len(parts)), 2):
            words = f"{what}s '{parts[a].name}' and '{parts[b].name}' are exchanged"
            advice = "exchange their folders" if what == "camera" else "exchange the two options"
            yield f"{words} ({advice})", _exchanged(rig, what, a, b)
    for c, camera in enumerate(rig.cameras):
        mount: Mount = "fixed" if camera.mount == "hand" else "hand"
        cameras = list(rig.cameras)
        cameras[c] = replace(camera, mount=mount)
        text = f"camera '{camera.name}' is {MOUNTS[mount]} (--cameras {camera.name}={mount})"
        yield text, replace(rig, cameras=tuple(cameras))
    for b, board in enumerate(rig.boards):
        for place in get_args(Place):
            if place == board.place:
                continue
            boards = list(rig.boards)
            boards[b] = replace(board, place=place)
            text = f"board '{board.name}' is {PLACES[place]} (give it as {OPTIONS[place]})"
            yield text, replace(rig, boards=tuple(boards))


def _exchanged(rig: Rig, what: str, a: int, b: int) -> Rig:
    """Return the rig in which two cameras or two boards have each other's mount or place."""
    if what == "camera":
        cameras = list(rig.cameras)
        cameras[a] = replace(cameras[a], mount=rig.cameras[b].mount)
        cameras[b] = replace(cameras[b], mount=rig.cameras[a].mount)
        return replace(rig, cameras=tuple(cameras))
    boards = list(rig.boards)
    boards[a] = replace(boards[a], place=rig.boards[b].place)
    boards[b] = replace(boards[b], place=rig.boards[a].place)
    return replace(rig, boards=tuple(boards))
