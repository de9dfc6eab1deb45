"""Where the camera beside the table stands: as near as what happens lets it.

Its picture holds the objects where they stand, and fingers and object from the pre-grasps to the
ends of the lifts of all attempts; in the swings that follow, a wide one may leave it. The hand
behind the fingers is not asked for, or the objects would be a fifth smaller.

Of the directions from which a person would look, from opposite the arm's base and to the sides,
the one is taken that shows most: the share of grasps that the arm does not hide, times the size of
the objects in the picture.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.records.grasps import PHASES
from realsim.robots.hand import Hand, find_hand
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.demonstrations.records import DemonstrationCamera

# --- Where demonstrations are seen from: from a view of the session, from the hand ---------------
# The camera beside the table is placed in `front_view`. Pictures have square pixels and no
# distortion. The hand's camera is on Franka's usual mount unless another pose is given.


SIZE_PX = (320, 240)
"""Width and height of the pictures: what policies are fed with, or a little more."""
FRONT, WRIST = "front", "wrist"
WRIST_VIEW_DEG = 69.0
"""Horizontal angle of view of the hand's camera: a RealSense D435's colour camera."""
WRIST_AT_M = (0.075, 0.0, -0.055)
"""Where the hand's camera is in the grasp frame [m]: before the palm, over the fingers' plane."""
WRIST_LOOKS_M = (0.0, 0.0, 0.03)
"""What it looks at, grasp frame [m]: just beyond the fingertips."""


def view_intrinsics(view_deg: float, size_px: tuple[int, int] = SIZE_PX) -> CameraIntrinsics:
    """Return a camera without distortion, by its horizontal angle of view."""
    width, height = size_px
    f = width / 2.0 / np.tan(np.radians(view_deg) / 2.0)
    return CameraIntrinsics(
        width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2.0, cy=(height - 1) / 2.0
    )


def wrist_camera(
    T_ee_cam: Array | None = None, size_px: tuple[int, int] = SIZE_PX, hand: Hand | None = None
) -> DemonstrationCamera:
    """Return a camera in the hand.

    Args:
        T_ee_cam: (4, 4) camera in the arm's flange, as a hand-eye calibration gives it [m];
            None = the usual mount.
        size_px: width and height of its pictures.
        hand: the one that is on the flange; None = Franka's.
    """
    if T_ee_cam is None:
        z = np.array(WRIST_LOOKS_M) - WRIST_AT_M
        z = z / np.linalg.norm(z)
        x = np.array([0.0, 1.0, 0.0])
        T = se3.from_rt(np.stack([x, np.cross(z, x), z], axis=-1), np.array(WRIST_AT_M))
    else:
        T = se3.invert((hand or find_hand()).T_ee_grasp) @ T_ee_cam
    return DemonstrationCamera(
        name=WRIST, intrinsics=view_intrinsics(WRIST_VIEW_DEG, size_px), T_frame_cam=T, on_hand=True
    )


def sees_fingertips(camera: DemonstrationCamera) -> bool:
    """Return whether a camera in the hand has what is between the fingertips in its picture."""
    x, y, z = se3.invert(camera.T_frame_cam)[:3, 3].tolist()
    i = camera.intrinsics
    if z <= 0.0:
        return False
    u, v = i.fx * x / z + i.cx, i.fy * y / z + i.cy
    return 0.0 <= u <= i.width - 1 and 0.0 <= v <= i.height - 1


def view_camera(
    name: str, intrinsics: CameraIntrinsics, T_table_cam: Array, width_px: int = SIZE_PX[0]
) -> DemonstrationCamera:
    """Return a camera where one of a session stood, with smaller pictures without distortion.

    Args:
        name: of the camera.
        intrinsics: of the session's camera.
        T_table_cam: (4, 4) [m].
        width_px: of the pictures; their height follows, made even for the video.

    Raises:
        InputError: the width is less than 16 pixels.
    """
    if width_px < 16:
        raise InputError(f"pictures {width_px} px wide show nothing; 16 or more is accepted.")
    height = max(2, 2 * round(width_px * intrinsics.height / intrinsics.width / 2))
    sx, sy = width_px / intrinsics.width, height / intrinsics.height
    scaled = replace(
        intrinsics,
        width=width_px,
        height=height,
        fx=intrinsics.fx * sx,
        fy=intrinsics.fy * sy,
        # Pixel centres are whole numbers.
        cx=(intrinsics.cx + 0.5) * sx - 0.5,
        cy=(intrinsics.cy + 0.5) * sy - 0.5,
        distortion=np.zeros(8),
    )
    return DemonstrationCamera(name=name, intrinsics=scaled, T_frame_cam=T_table_cam)


VIEW_DEG = 40.0
"""Horizontal angle of view: as a person's that looks at a table from an arm's length or two."""
AZIMUTHS_DEG = (0.0, -30.0, 30.0, -60.0, 60.0)
"""Directions that are tried, from opposite the arm's base; of equal ones the first is taken."""
ELEVATIONS_DEG = (25.0, 35.0, 45.0)
"""Heights that are tried: lower, objects hide one another; higher, a lift is hardly seen."""
BORDER = 0.04
"""Share of the picture that stays free along each side."""
FINGERS_M = np.array(
    [[x, y, z] for x in (-0.012, 0.012) for y in (-0.05, 0.05) for z in (-0.0584, 0.0)]
)
"""(8, 3) corners of the opened fingers in the grasp frame [m]."""
HAND_RADIUS_M, ARM_RADIUS_M = 0.035, 0.06
"""Half the thickness of the hand over its fingers, and of the arm's links [m]."""
PALM_M = np.array([[0.0, y, -0.075] for y in np.linspace(-0.1, 0.1, 9)])
"""(9, 3) points of the hand over its fingers, in the grasp frame [m]."""
ON_A_LINK = 8
"""Points between two joints that stand for a link."""
APPROACH, CLOSE, LIFT = (PHASES.index(name) for name in ("approach", "close", "lift"))


@dataclass(frozen=True, kw_only=True, slots=True)
class FrontView:
    """A fixed camera that a source places where it sees what happens."""

    size_px: tuple[int, int] = SIZE_PX
    """Width and height of its pictures."""
    name: str = FRONT


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Happening:
    """What is to be seen; points in the table's frame [m]."""

    standing: Array
    """(N, 3) extreme points of the objects where they stand."""
    moving: Array
    """(M, 3) extreme points of the fingers, and of the object that they hold, on their ways."""
    grasps: Array
    """(A, 3) between the fingertips as they close."""
    hands: Array
    """(A, H, 3) points in the hand over its fingers, then."""
    arms: Array
    """(A, L, 3) points in the arm, then."""
    away_from_base: Array
    """(2,) horizontal direction from the arm's base over the scene, of length 1."""


def placed_front(view: FrontView, seen: Happening) -> DemonstrationCamera:
    """Return the camera that shows most of what happens."""
    intrinsics = view_intrinsics(VIEW_DEG, view.size_px)
    best: tuple[float, Array] | None = None
    for azimuth in np.radians(AZIMUTHS_DEG).tolist():
        for elevation in np.radians(ELEVATIONS_DEG).tolist():
            ahead = np.append(se3.exp_so3([0, 0, azimuth])[:2, :2] @ seen.away_from_base, 0.0)
            towards = np.cos(elevation) * ahead + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
            T = nearest_camera(np.concatenate([seen.standing, seen.moving]), towards, intrinsics)
            size = float(np.mean(1.0 / se3.transform(se3.invert(T), seen.standing)[:, 2]))
            worth = size * float(np.mean(~hidden(seen, T[:3, 3])))
            # Equal up to rounding: the first stays.
            if best is None or worth > best[0] * (1.0 + 1e-6):
                best = worth, T
    assert best is not None, "directions are tried"
    return DemonstrationCamera(name=view.name, intrinsics=intrinsics, T_frame_cam=best[1])


def nearest_camera(points: Array, towards: Array, intrinsics: CameraIntrinsics) -> Array:
    """Return T_table_cam (4, 4) of the nearest camera of a direction that sees all points [m].

    Turned into the camera's axes, a point p is in the picture of a camera at c where
    |p_x - c_x| <= s_x (p_z - c_z), and likewise in y: bounds that are linear in c. The largest c_z
    that they leave follows from the extremes of p_x + s_x p_z and p_x - s_x p_z.

    Args:
        points: (N, 3) table frame.
        towards: (3,) direction from the scene to the camera, not upright.
        intrinsics: of the camera.
    """
    R = se3.look_at(towards, np.zeros(3))[:3, :3]
    x, y, z = (points @ R).T
    c_z, low_high = np.inf, list[tuple[float, float, float]]()
    for p, half, f in ((x, intrinsics.width, intrinsics.fx), (y, intrinsics.height, intrinsics.fy)):
        s = (0.5 - BORDER) * half / f
        low, high = float(np.max(p - s * z)), float(np.min(p + s * z))
        low_high.append((low, high, s))
        c_z = min(c_z, (high - low) / (2.0 * s))
    c = [(low + high) / 2.0 for low, high, _ in low_high]
    return se3.from_rt(R, R @ np.array([*c, c_z]))


def hidden(seen: Happening, eye: Array) -> Mask:
    """Return (A,) which grasps are behind hand or arm for a camera at `eye` (3,) [m]."""
    out = np.zeros(len(seen.grasps), dtype=np.bool_)
    ways = eye - seen.grasps
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    for parts, radius in ((seen.hands, HAND_RADIUS_M), (seen.arms, ARM_RADIUS_M)):
        offsets = parts - seen.grasps[:, None]
        along = np.einsum("apk,ak->ap", offsets, ways)
        beside = np.linalg.norm(offsets - along[..., None] * ways[:, None], axis=2)
        out |= np.any((along > 0) & (beside < radius), axis=1)
    return out


def happening(
    grasps: SceneGrasps,
    models: Mapping[int, ObjectModel],
    Ts_table_obj: Mapping[int, Array],
    T_table_base: Array,
    arm: GraspingArm,
) -> Happening:
    """Return what happens in all attempts of a scene.

    Args:
        grasps: the sets with their trajectories.
        models: the objects, by instance.
        Ts_table_obj: (4, 4) where they stand [m], by instance.
        T_table_base: (4, 4) the arm's base [m].
        arm: the arm with its hand.
    """
    extremes = {i: _extremes(model) for i, model in models.items()}
    standing = [se3.transform(T, extremes[i]) for i, T in Ts_table_obj.items()]
    moving: list[Array] = []
    closed: list[Array] = []
    for s in grasps.sets:
        attempts = grasps.trajectories.get(s.instance)
        for row in [] if attempts is None else attempts.rows.tolist():
            assert attempts is not None
            rows = attempts.attempt(row)
            joints, phase = attempts.joints_rad[rows], attempts.phase[rows]
            at = _turning_points(phase)
            Ts = T_table_base @ arm.forward(joints[at])
            moving.append(_placed(Ts, FINGERS_M))
            in_hand = se3.transform(se3.invert(s.Ts_obj_grasp[row]), extremes[s.instance])
            moving.append(_placed(Ts[phase[at] >= CLOSE], in_hand))
            closed.append(joints[np.argmax(phase >= CLOSE)])
    frames = T_table_base @ arm.frames(np.array(closed))
    origins = frames[:, :-1, :3, 3]
    share = np.linspace(0.0, 1.0, ON_A_LINK)[:, None, None, None]
    links = (1.0 - share) * origins[None, :, :-1] + share * origins[None, :, 1:]
    stand = np.concatenate(standing)
    away = stand.mean(axis=0)[:2] - T_table_base[:2, 3]
    length = float(np.linalg.norm(away))
    return Happening(
        standing=stand,
        moving=np.concatenate(moving),
        grasps=frames[:, -1, :3, 3],
        hands=np.stack([se3.transform(T, PALM_M) for T in frames[:, -1]]),
        arms=np.moveaxis(links, 0, 1).reshape(len(closed), -1, 3),
        away_from_base=away / length if length > 1e-6 else np.array([1.0, 0.0]),
    )


def _turning_points(phase: Int64) -> Int64:
    """Return the samples of an attempt at the ends of its straight ways: pre-grasp to lift.

    On its way to the pre-grasp the hand comes from wherever the arm rests.
    """
    ways = np.nonzero((phase >= APPROACH) & (phase <= LIFT))[0]
    ends = ways[np.nonzero(np.diff(phase[ways]))[0]]
    return np.unique(np.concatenate([ways[:1], ends, ways[-1:]]))


def _placed(Ts: Array, points: Array) -> Array:
    """Return points (P, 3) at each of the poses (S, 4, 4), as one list (S * P, 3)."""
    return (points @ np.swapaxes(Ts[:, :3, :3], 1, 2) + Ts[:, None, :3, 3]).reshape(-1, 3)


def _extremes(model: ObjectModel) -> Array:
    """Return the outermost vertices of an object in some directions (P, 3) [m]."""
    steps = np.array(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3)).reshape(3, -1).T
    v = model.mesh.vertices
    return v[np.unique(np.argmax(v @ steps[np.any(steps != 0, axis=1)].T, axis=0))]
