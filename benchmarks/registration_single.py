"""One view: is a pose that is accepted right, and is a right one accepted?

Imported by the registration benchmark outside its own lab; alone:
    uv run python benchmarks/registration_single.py [--seed 1000] [--quick]

Scenes of the second lab (`outside_lab.py`), each object from a start that is off, one frame at a
time. Figures:
  single_wrong_accepted_share   of poses more than 3 mm off, those accepted
  single_right_accepted_share   of the others
  probability_jump              greatest change of a stated probability when the poses are moved by
                                0.05 mm, one view and all views
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from figures import Figure, Found, Goal, run
from outside_lab import Lab, LabScene, make_scene

from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.records import ObjectPose
from realsim.registration.config import RegistrationConfig
from realsim.registration.register import register_scene

START = (0.010, 10.0)
"""Starts are off by this [m, deg]."""
RIGHT_M = 0.003
SCENES, QUICK_SCENES = 12, 1
VIEWS, QUICK_VIEWS = 8, 2
"""Frames of a scene, each alone."""
SEEN_PX = 400
"""An object of which a frame shows fewer pixels is not asked for: nobody would."""
FIGURES = {
    "single_wrong_accepted_share": Figure(unit="", goal=Goal(high=0.10)),
    "single_right_accepted_share": Figure(unit="", goal=Goal(low=0.85)),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class One:
    """An object in one view."""

    seed: int
    view: int
    name: str
    off_m: float
    verdict: str
    checks: dict[str, float]
    reasons: tuple[str, ...]


def starts(scene: LabScene, rng: np.random.Generator) -> list[ObjectPose]:
    """Return starts that are off, in the axes of the claimed cameras."""
    out: list[ObjectPose] = []
    for t in scene.truth:
        axis, way = rng.normal(size=(2, 3))
        c = se3.from_translation(scene.models[t.obj_id].mesh.bounds.mean(0))
        step = np.concatenate([
            np.radians(START[1]) * axis / np.linalg.norm(axis),
            START[0] * way / np.linalg.norm(way),
        ])  # fmt: skip
        out.append(replace(t, T_world_obj=t.T_world_obj @ c @ se3.exp(step) @ se3.invert(c)))
    return out


def ones(seed: int, views: int, photos: bool, config: RegistrationConfig) -> list[One]:
    """Return all objects of a scene in some of its frames, each frame alone."""
    # The camera is where it is said to be: one view's pose is known against its camera only.
    lab = Lab(views=views, hand_eye_mm=0, hand_eye_deg=0, arm_mm=0, arm_deg=0, photos=photos)
    scene = make_scene(seed, lab)
    rng = np.random.default_rng([seed, 1])
    rows: list[One] = []
    for frame in scene.frames:
        found = register_scene(
            f"{seed}/{frame.index}", scene.intrinsics, [frame], scene.models, starts(scene, rng),
            config,
        )  # fmt: skip
        by = {t.instance: t for t in scene.truth}
        for o in found.scene.objects:
            if o.checks.get("n_pixels", 0.0) + 1e-9 < SEEN_PX:
                continue
            model = scene.models[o.obj_id]
            off = mssd_symmetric(by[o.instance].T_world_obj, o.T_world_obj, model)
            rows.append(
                One(seed=seed, view=frame.index, name=model.name, off_m=off, verdict=o.verdict,
                    checks=dict(o.checks), reasons=o.reasons)
            )  # fmt: skip
    return rows


def figures_of(rows: Sequence[One], found: Found) -> None:
    """Add the shares."""
    wrong = [r for r in rows if r.off_m > RIGHT_M]
    right = [r for r in rows if r.off_m <= RIGHT_M]
    accepted = [r for r in wrong if r.verdict == "accepted"]
    found.add("single_wrong_accepted_share", len(accepted) / max(len(wrong), 1),
              f"{len(wrong)} wrong poses of {len(rows)}")  # fmt: skip
    found.add("single_right_accepted_share",
              float(np.mean([r.verdict == "accepted" for r in right])),
              f"{len(right)} right poses")  # fmt: skip
    found.notes += [
        f"seed {r.seed}, view {r.view}, {r.name}: {1e3 * r.off_m:.1f} mm off and accepted"
        for r in accepted
    ]


def measure(given: argparse.Namespace) -> Found:
    """Measure all of it."""
    found = Found()
    config = RegistrationConfig(with_single_view=False)
    rows: list[One] = []
    for seed in range(given.seed, given.seed + (QUICK_SCENES if given.quick else SCENES)):
        rows += ones(seed, QUICK_VIEWS if given.quick else VIEWS, config)
    figures_of(rows, found)
    return found


if __name__ == "__main__":
    run("registration_single", __doc__ or "", ("realsim", "numpy"), FIGURES, {"single": measure},
        seed=1000)  # fmt: skip
