"""A campaign: many scenes on many machines, and what losing some of them costs.

  school      ray_two_nodes_ratio            what a second node brings the School
  generate    ray_two_nodes_generate_ratio   what it brings the generation of scenes
  losses      lost_node_equal                1 = a node killed in the middle changes no byte
              lost_head_told                 1 = a lost head ends in a sentence, what was made is
                                             kept, and the same command goes on
  graspnet    graspnet_grasps_back       grasps of a GraspNet export that another reader gets back
  reproduce   reproduce_equal            1 = register, school, annotate and export are made again
                                         bit for bit from their records
  demonstrations  see campaign_demonstrations.py
  scenes          see campaign_scenes.py; --keep FOLDER keeps its campaign
  whole_loop, upgrade  see campaign_loop.py

    uv run --extra cluster python benchmarks/campaign.py [--quick] [--part PART] [--json FILE]

A part is a function of a module; further ones are added to FIGURES and PARTS.
"""

from campaign_scenes import FIGURES as SCENES
from campaign_scenes import keep
from figures import Figure, Goal, run

FIGURES = {
    "ray_two_nodes_ratio": Figure(unit="x", goal=Goal(low=1.8)),
    "ray_two_nodes_generate_ratio": Figure(unit="x", goal=Goal(low=1.7)),
    "lost_node_equal": Figure(unit="", goal=Goal(low=1, high=1)),
    "lost_head_told": Figure(unit="", goal=Goal(low=1, high=1)),
    "reproduce_equal": Figure(unit="", goal=Goal(low=1, high=1)),
    "demo_attempt_cpu_s": Figure(unit="s", goal=Goal(high=5.0)),
    "languages_checked_share": Figure(unit="", goal=Goal(low=1.0, high=1.0)),
    "graspnet_grasps_back": Figure(unit="", goal=Goal(low=0.999)),
    "graspnet_worst_mm": Figure(unit="mm", goal=Goal(high=0.1)),
    "graspnet_view_deg": Figure(unit="deg"),
    "upgrade_cpu_s": Figure(unit="s", goal=Goal(high=240)),
    "whole_loop_min": Figure(unit="min", goal=Goal(high=25)),
    "whole_loop_cpu_min": Figure(unit="min"),
    **SCENES,
}
PARTS = {
    "school": "campaign_ray:school",
    "generate": "campaign_ray:generate",
    "losses": "campaign_ray:losses",
    "reproduce": "campaign_reproduce:reproduce",
    "demonstrations": "campaign_demonstrations:demonstrations",
    "graspnet": "campaign_graspnet:grasps_back",
    "scenes": "campaign_scenes:scenes",
    "whole_loop": "campaign_loop:whole_loop",
    "upgrade": "campaign_loop:upgrade",
}

if __name__ == "__main__":
    run("campaign", __doc__ or "", ("realsim", "ray", "numpy", "mujoco"), FIGURES, PARTS,
        options=keep)  # fmt: skip
