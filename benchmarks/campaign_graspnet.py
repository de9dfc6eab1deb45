"""Whether grasps come back from a GraspNet export by a reader that shares no code with realsim.

  graspnet   graspnet_grasps_back    share of the grasps that held, over all images, whose place
                                     between the fingertips is read within 0.1 mm, with the closing
                                     axis within the rounding of 300 views; what is read and was
                                     not written counts against it
             graspnet_worst_mm       the worst of them
             graspnet_view_deg       median turn of the approach, which is what 300 views cost

The reader is written from what graspnetAPI 1.2.11 publishes (loadGrasp, generate_views,
batch_viewpoint_params_to_matrix, xmlReader): numpy and xml.etree only.

    uv run python benchmarks/campaign_graspnet.py [--session SESSION] [--quick]
"""

import argparse
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from campaign_loop import demo, timed
from figures import Figure, Found, Goal, run

FIGURES = {
    "graspnet_grasps_back": Figure(unit="", goal=Goal(low=0.999)),
    "graspnet_worst_mm": Figure(unit="mm", goal=Goal(high=0.1)),
    "graspnet_view_deg": Figure(unit="deg"),
}
NEAR_MM = 0.1
VIEW_DEG = 9.0
"""No direction is farther than this from the nearest of 300 views."""
VIEWS, FRICTION = 300, 2.0


def grasps_back(args: argparse.Namespace) -> Found:
    """Return how many grasps of an export of a session are read back."""
    found = Found()
    with tempfile.TemporaryDirectory(prefix="campaign_graspnet_") as place:
        given: Path | None = getattr(args, "session", None)
        session = given or demo(args.seed, *((8, 2, 6) if args.quick else (8, 5, 60)))[0]
        out = Path(place) / "graspnet"
        timed("export", session, "--to", "graspnet", "--out", out)
        right, count, worst, turned = _compared(session, out)
    words = f"{count} grasps of all images of {given or 'a demo'}"
    found.add("graspnet_grasps_back", right / max(count, 1), words)
    found.add("graspnet_worst_mm", worst, "the worst of them")
    found.add("graspnet_view_deg", turned, "median; 300 views are up to 8.8 deg from a direction")
    return found


def _compared(session: Path, out: Path) -> tuple[int, int, float, float]:
    """Return how many grasps are right, of how many, the worst [mm] and the median turn [deg]."""
    from realsim.formats.grasps.scene_grasps import executed
    from realsim.formats.session_scene import open_session_scene
    from realsim.store import SessionStore

    scene = open_session_scene(SessionStore.open(session))
    grasps = scene.grasps()
    assert grasps is not None, "the session has no grasps: run realsim school"
    folder = next(out.glob("scenes/scene_*"))
    right, count, apart, turns = 0, 0, list[float](), list[float]()
    for image, index in enumerate(scene.indices):
        poses = {o.instance: o.T_cam_obj for o in scene.frame(index).objects}
        Ts = np.concatenate(
            [poses[s.instance] @ s.Ts_obj_pads[s.good & executed(s)] for s in grasps.sets]
        )
        places, rotations = load_grasp(out, folder, image)
        for T in Ts if len(places) else ():
            far = np.linalg.norm(places - T[:3, 3], axis=1) * 1e3
            nearest = np.flatnonzero(far <= max(NEAR_MM, far.min()))
            # Fingers may meet at one point from several sides: of those, the one turned least.
            approach = _degrees(rotations[nearest, :, 0], T[:3, 2])
            closing = _degrees(rotations[nearest, :, 1], T[:3, 1])
            closing = np.minimum(closing, 180.0 - closing)
            best = np.argmin(np.maximum(approach, closing))
            near = far[nearest[best]] <= NEAR_MM
            right += bool(near and approach[best] <= VIEW_DEG and closing[best] <= VIEW_DEG)
            apart.append(float(far[nearest[best]]))
            turns.append(float(approach[best]))
        count += max(len(Ts), len(places))
    return right, count, max(apart, default=np.inf), float(np.median(turns)) if turns else np.nan


def _degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0)))


# --- the reader ---------------------------------------------------------------------------------


def load_grasp(root: Path, scene: Path, image: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where fingertips meet (N, 3) [m] and rotations (N, 3, 3) of an image's grasps.

    In the image's camera; graspnetAPI's loadGrasp, and `depth` along its approach.
    """
    camera = next(p for p in scene.iterdir() if p.is_dir())
    tree = ET.parse(camera / "annotations" / f"{image:04d}.xml").getroot()
    collisions = np.load(root / "collision_label" / scene.name / "collision_labels.npz")
    towards = -_views()
    places, rotations = [np.zeros((0, 3))], [np.zeros((0, 3, 3))]
    for k, node in enumerate(tree):
        number = int(node[0].text or "")
        t = np.array((node[3].text or "").split(), float)
        R = _matrix(np.array((node[4].text or "").split(), float))
        labels = np.load(root / "grasp_label" / f"{number:03d}_labels.npz")
        points, offsets, friction = (labels[n] for n in ("points", "offsets", "scores"))
        kept = (friction <= FRICTION) & (friction > 0) & ~collisions[f"arr_{k}"]
        point, view, turn, depth = np.nonzero(kept)
        angle, reach, _ = offsets[point, view, turn, depth].T
        turned = R @ _viewpoint(towards[view], angle)
        places.append(points[point] @ R.T + t + reach[:, None] * turned[:, :, 0])
        rotations.append(turned)
    return np.concatenate(places), np.concatenate(rotations)


def _views() -> np.ndarray:
    phi = (np.sqrt(5) - 1) / 2
    i = np.arange(VIEWS)
    z = (2 * i + 1) / VIEWS - 1
    r = np.sqrt(1 - z**2)
    x, y = r * np.cos(2 * i * np.pi * phi), r * np.sin(2 * i * np.pi * phi)
    return np.stack([x, y, z], axis=1)


def _viewpoint(towards: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the rotation (N, 3, 3) of directions (N, 3) and turns (N,)."""
    zero, one = np.zeros(len(towards)), np.ones(len(towards))
    y = np.stack([-towards[:, 1], towards[:, 0], zero], axis=1)
    y[np.linalg.norm(y, axis=1) == 0] = [0, 1, 0]
    x = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    sin, cos = np.sin(angle), np.cos(angle)
    turn = np.stack([one, zero, zero, zero, cos, -sin, zero, sin, cos], axis=1).reshape(-1, 3, 3)
    return np.stack([x, y, np.cross(x, y)], axis=2) @ turn


def _matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


PARTS = {"graspnet": grasps_back}


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--session", type=Path, default=None, help="with grasps; else a demo")


if __name__ == "__main__":
    run("campaign_graspnet", __doc__ or "", ("realsim", "numpy"), FIGURES, PARTS, options=_options)
