"""Maps as counts: the same as what the formulas make of the labels' own maps."""

import numpy as np

from map_formulas import coordinate_counts, normal_counts
from plain_meshes import box
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim_sim_bridge.annotation import frame_maps

CAMERA = CameraIntrinsics(
    width=160, height=120, fx=150, fy=150, cx=79.5, cy=59.5,
    distortion=np.array([-0.05, 0.06, 0.0005, -0.0007, -0.02]),
)  # fmt: skip


def test_counts_equal_those_of_the_float_maps() -> None:
    rng = np.random.default_rng(0)
    placed = [
        PlacedMesh(i, box(rng.uniform(0.02, 0.08, 3)),
                   se3.exp([*rng.normal(size=3), *rng.uniform(-0.08, 0.08, 3)]))
        for i in range(3)
    ]  # fmt: skip
    placed.append(PlacedMesh(BACKGROUND, box((1, 1, 0.01)), se3.from_translation([0, 0, -0.15])))
    T = se3.look_at([0.1, 0.2, 0.5], [0, 0, 0])
    labels = LabelRenderer(placed).render(CAMERA, T)
    window = (slice(10, 110), slice(20, 150))
    seen = (labels.ids[window] >= 0) & (rng.random((100, 130)) < 0.9)
    boxes = np.stack([p.mesh.bounds for p in placed])
    got = frame_maps.coordinate_counts(labels, window, seen, boxes)
    points = labels.object_coordinates()[window]
    for k in range(3):
        mask = seen & (labels.ids[window] == k)
        assert mask.any()
        wanted = coordinate_counts(points[mask], *boxes[k])
        # Float32 products may fall on either side of a half.
        assert np.max(np.abs(got[mask].astype(int) - wanted)) <= 1
    assert not got[~seen].any()
    normals = frame_maps.normal_counts(labels).astype(int)
    assert np.max(np.abs(normals - normal_counts(labels.normals()))) <= 1
    assert np.array_equal(normals.any(axis=-1), labels.geometry >= 0)
