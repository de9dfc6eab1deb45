"""What is left over: clusters of it, starts in it, and objects it makes suspect."""

import numpy as np

from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface
from realsim.geometry.parts import part
from realsim.records import ObjectPose
from realsim.registration.body import make_body
from realsim.registration.evidence import Cloud
from realsim.registration.search.candidates import Candidate, Sought
from realsim.registration.search.peel import PeelConfig, clusters, explained_points, suspects
from realsim.registration.search.sameness import make_sameness
from realsim.registration.search.scoring import Render, Score

CONFIG = PeelConfig()


def sought(name: str) -> Sought:
    start = ObjectPose(obj_id=part(name).obj_id, instance=0, T_world_obj=np.eye(4))
    return Sought(
        body=make_body(start, part(name), 48, 100), sameness=make_sameness(part(name))
    )  # fmt: skip


def surface(name: str, T: np.ndarray, count: int, rng: np.random.Generator) -> Cloud:
    points, normals = sample_surface(part(name).mesh, count, rng)
    return Cloud(
        points=se3.transform(T, points), towards=normals @ T[:3, :3].T,
        sigmas=np.full(count, 5e-4),
    )  # fmt: skip


def at(s: Sought, T: np.ndarray) -> tuple[Sought, Candidate]:
    nothing = Render(np.zeros(0, np.int32), np.zeros(0, np.float32))
    score = Score(gain=0.0, cells=0, agree=1.0)
    return s, Candidate(
        obj_id=s.obj_id, T_world_obj=T, rendered=nothing, alone=score, source="test"
    )  # fmt: skip


def both(a: Cloud, b: Cloud) -> Cloud:
    parts = [
        np.concatenate([getattr(c, k) for c in (a, b)]) for k in ("points", "towards", "sigmas")
    ]
    return Cloud(points=parts[0], towards=parts[1], sigmas=parts[2])


def test_an_object_in_the_wrong_turn_is_suspect_and_its_neighbour_is_not():
    rng = np.random.default_rng(0)
    shaft, mug = sought("stepped_shaft"), sought("mug")
    T_shaft = se3.from_rt(se3.exp_so3([np.pi / 2, 0, 0]), [0.0, 0.0, 0.1])
    T_mug = se3.from_translation([0.25, 0.0, 0.05])
    cloud = both(surface("stepped_shaft", T_shaft, 900, rng), surface("mug", T_mug, 900, rng))
    center = shaft.body.center(T_shaft)
    R = se3.exp_so3([0, 0, np.pi / 2])
    wrong = se3.from_rt(R, center - R @ center) @ T_shaft

    def worst(T: np.ndarray) -> list[int]:
        placed = [at(shaft, T), at(mug, T_mug)]
        rest = cloud.points[~explained_points(cloud, placed, CONFIG)]
        return suspects(cloud, clusters(rest, np.eye(4), CONFIG), placed, CONFIG)

    assert worst(T_shaft) == []
    assert worst(wrong) == [0]
