"""Robot School: ten grasps of one part, from the arm's reach to the four stages of the slip."""

import numpy as np

from realsim import ObjectPose, Scene, SupportPlane
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import STAGES
from realsim_sim_bridge.school import SchoolConfig, ScoreLimits, recompute_scores, run_school


def main() -> None:
    model = part("box")
    standing = se3.from_translation([0.0, 0.0, -model.mesh.bounds[0, 2]])
    scene = Scene(
        name="one box",
        objects=(ObjectPose(obj_id=model.obj_id, instance=0, T_world_obj=standing),),
        plane=SupportPlane(T_world_table=np.eye(4)),
    )
    config = SchoolConfig(max_candidates=10, seed=1)
    (grasps,) = run_school(scene, {model.obj_id: model}, config, workers=1)

    print("grasp  width  reach  slip [mm] in " + ", ".join(STAGES) + "      score")
    for k in range(len(grasps)):
        slips = " ".join(f"{1e3 * s:7.2f}" for s in grasps.slip_m[k])
        reach = "yes" if grasps.reachable[k] else "no"
        width = 1e3 * grasps.widths_m[k]
        print(f"{k:5d}  {width:2.0f} mm  {reach:5s} {slips}    {grasps.scores[k]:.2f}")
        if grasps.failures[k]:
            print(f"       {grasps.failures[k]}")
    print(f"{int(grasps.good.sum())} of {len(grasps)} are good (score 0.5 or more)")

    # The slips are kept, so a stricter rule needs no new physics.
    strict = ScoreLimits(slip_m=0.005, slip_deg=3.0)
    _, scores = recompute_scores(grasps, strict)
    _, same = recompute_scores(grasps)
    print(f"recomputed from the slips: the same {np.array_equal(same, grasps.scores)}")
    print(f"good if 5 mm and 3 deg are the limits: {int(np.sum(scores >= 0.5))}")


# With workers=2 or more, each process runs this file again: the guard keeps it from starting anew.
if __name__ == "__main__":
    main()
