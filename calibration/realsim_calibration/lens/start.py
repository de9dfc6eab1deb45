"""Where the camera's bundle adjustment starts: Zhang's closed form, and a pose for every view.

Source: Z. Zhang, A flexible new technique for camera calibration, PAMI 2000, with the principal
point in the image's middle and square pixels, which leaves one unknown, 1/f^2: the columns h1, h2
of a homography are images of perpendicular directions of equal length,

    h1^T W h2 = 0,   h1^T W h1 = h2^T W h2,   W = diag(1/f^2, 1/f^2, 1).

Views that face the board squarely make it blow up, so focal lengths from a fan are tried as well,
and the one of least median reprojection starts.
"""

from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import undistort
from realsim_calibration.detect.homography import fit_homography
from realsim_calibration.fit.view_system import camera_record
from realsim_calibration.lens import bundle

FAN = np.geomspace(0.3, 8.0, 18)
"""Focal lengths that are tried, in longer image sides: from 118 deg of field of view to 7 deg."""
TWIN_STEPS = 8
"""Steps that a mirrored pose gets to show that it fits better; the next fit does the rest."""
TWIN_TOLERANCE = 0.1
"""A mirrored pose whose next step promises less than this [sigma^2] is where it wants to be."""
FLATNESS = 1e-4
"""Points whose spread across is less than this of their spread along lie on a line."""


def is_line(points: Array) -> bool:
    """Return whether points (n, 2) lie on a line, as far as a homography is concerned."""
    if len(points) < 2:
        return True
    values = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(values[1] <= FLATNESS * values[0])


def zhang_focal(homographies: Array, image_size: tuple[int, int]) -> float:
    """Return the focal length [px] of homographies (n, 3, 3), NaN where they do not give one."""
    width, height = image_size
    size = max(width, height)
    to_unit = np.array([[1 / size, 0, -(width - 1) / 2 / size], [0, 1 / size, 0], [0, 0, 1.0]])
    to_unit[1, 2] = -(height - 1) / 2 / size
    H = to_unit @ homographies
    length = np.linalg.norm(H[:, :, :2], axis=(1, 2))
    h1, h2 = H[:, :, 0] / length[:, None], H[:, :, 1] / length[:, None]
    a = np.concatenate(
        [np.sum(h1[:, :2] * h2[:, :2], -1), np.sum(h1[:, :2] ** 2 - h2[:, :2] ** 2, -1) / 2]
    )
    b = np.concatenate([h1[:, 2] * h2[:, 2], (h1[:, 2] ** 2 - h2[:, 2] ** 2) / 2])
    inverse_square = -float(a @ b) / max(float(a @ a), 1e-300)
    return float(size / np.sqrt(inverse_square)) if inverse_square > 0 else float("nan")


def pose_of_homography(H: Array) -> Array:
    """Return T_cam_board (..., 4, 4) of homographies (..., 3, 3) in ideal coordinates."""
    length = np.linalg.norm(H[..., :2], axis=-2).prod(-1) ** 0.5
    H = H / np.maximum(length, 1e-300)[..., None, None]
    H = H * np.where(H[..., 2, 2] < 0, -1.0, 1.0)[..., None, None]
    third = np.cross(H[..., 0], H[..., 1])
    U, _, Vt = np.linalg.svd(np.stack([H[..., 0], H[..., 1], third], -1))
    R = U @ Vt
    flip = np.where(np.linalg.det(R) < 0, -1.0, 1.0)
    return se3.from_rt(R * flip[..., None, None], H[..., 2])


def _homographies(obs: bundle.Observations, image: Array) -> Array:
    cuts = list(zip(obs.offsets[:-1], obs.offsets[1:], strict=True))
    return np.stack([fit_homography(obs.flat[a:b], image[a:b]) for a, b in cuts])


def view_errors(state: bundle.State, obs: bundle.Observations) -> Array:
    """Return the median distance of every view's corners from where they are expected [px].

    (views,), infinite where a corner is behind the camera.
    """
    from realsim.geometry.camera import project

    cam = bundle.points_in_camera(state, obs)
    cam[cam[:, 2] < bundle.NEAREST_M] = np.nan
    error = np.linalg.norm(
        project(camera_record(state.camera, obs.image_size), cam) - obs.uv, axis=-1
    )
    error[~np.isfinite(error)] = np.inf
    cuts = zip(obs.offsets[:-1], obs.offsets[1:], strict=True)
    return np.array([float(np.max(error[a:b])) if np.isinf(error[a:b]).any() else
                     float(np.median(error[a:b])) for a, b in cuts])  # fmt: skip


def start_state(obs: bundle.Observations, camera: Array | None) -> tuple[bundle.State, str]:
    """Return a first state, and how its focal length was found.

    Args:
        obs: the corners; at least four in every view, not on a line.
        camera: (12,) known camera, or None.
    """
    width, height = obs.image_size
    board = np.zeros(bundle.BOARD_TERMS)
    if camera is not None:
        xy, valid = undistort(camera_record(camera, obs.image_size), obs.uv)
        ideal = (obs.uv - camera[2:4]) / camera[:2]
        H = _homographies(obs, np.where(valid[:, None], xy, ideal))
        return bundle.State(camera=camera, board=board, poses=pose_of_homography(H)), "given"
    H = _homographies(obs, obs.uv)
    closed = zhang_focal(H, obs.image_size)
    tries = [(float(f * max(obs.image_size)), "fan") for f in FAN]
    if np.isfinite(closed) and 0.1 < closed / max(obs.image_size) < 50:
        tries.append((closed, "Zhang"))
    best, least = None, np.inf
    for focal, name in tries:
        vector = np.zeros(bundle.CAMERA_TERMS)
        vector[:4] = focal, focal, (width - 1) / 2, (height - 1) / 2
        inverse = np.linalg.inv(camera_record(vector, obs.image_size).K)
        ideal = np.asarray(inverse @ H, dtype=np.float64)
        poses = pose_of_homography(ideal)
        state = bundle.State(camera=vector, board=board, poses=poses)
        error = float(np.median(view_errors(state, obs)))
        if best is None or error < least:
            best, least = (state, name), error
    assert best is not None
    return best


def mirror_poses(poses: Array) -> Array:
    """Return the other pose (views, 4, 4) that a plane seen from afar might have.

    The board's normal is mirrored at the line of sight to its middle: turned by twice the angle
    between the two about the axis perpendicular to both.
    """
    sight = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=-1, keepdims=True)
    normal = poses[:, :3, 2]
    axis = np.cross(normal, sight)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    cosine = np.sum(normal * sight, -1, keepdims=True)
    # A board may be described with its normal towards the camera: mirror the undirected line.
    angle = np.arctan2(sine, np.abs(cosine)) * np.where(cosine < 0, -1.0, 1.0)
    turn = se3.exp_so3(2 * angle * axis / np.maximum(sine, 1e-12))
    mirrored = poses.copy()
    mirrored[:, :3, :3] = turn @ poses[:, :3, :3]
    return mirrored


def choose_twins(state: bundle.State, obs: bundle.Observations, sigma_px: float) -> bundle.State:
    """Return the state with every pose replaced by its mirror twin where that fits better.

    The state's own poses should be fitted already.
    """
    state, costs = bundle.refine_poses(state, obs, sigma_px, TWIN_TOLERANCE, TWIN_STEPS)
    twin = replace(state, poses=mirror_poses(state.poses))
    twin, twin_costs = bundle.refine_poses(twin, obs, sigma_px, TWIN_TOLERANCE, TWIN_STEPS)
    better = twin_costs < costs
    return replace(state, poses=np.where(better[:, None, None], twin.poses, state.poses))
