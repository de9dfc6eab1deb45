"""Grasps that came from elsewhere as candidates of an object where it stands.

The School tries what `sample_candidates` gives; this gives the same of grasps that are known: of
labels, of a data set, of a network. The contacts stay where the grasp has them. The hand is moved
along the closing axis so that both fingers touch at once (the stage `close` counts how far the
fingers push the object, and no label says where the middle of the hand is), and back along the
approach by up to 6 mm, as generated candidates are, where the fingertips would touch the table.
"""

import numpy as np

from realsim.arrays import Array, Rows
from realsim.formats.graspnet.grasp_labels import GraspLabels
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.robots.hand import Hand
from realsim_sim_bridge.grasping import candidates
from realsim_sim_bridge.grasping.antipodal import CandidateConfig, RaySurface
from realsim_sim_bridge.grasping.pad_contacts import pad_contacts
from realsim_sim_bridge.grasping.surroundings import Surroundings

MOST_TRIED = 20_000
"""Labels whose hands are placed in a scene; some seconds."""


def given_candidates(
    mesh: Mesh,
    T_table_obj: Array,
    surroundings: Surroundings,
    Ts_obj_grasp: Array,
    config: CandidateConfig,
    geometry: Hand,
    *,
    centred: bool = True,
) -> tuple[candidates.Candidates, Rows]:
    """Return those of given grasps that the hand can take where the object stands, and their rows.

    Args:
        mesh: the object [m].
        T_table_obj: (4, 4) where it stands; z of the table is up.
        surroundings: the other objects.
        Ts_obj_grasp: (N, 4, 4) with the origin where the middles of the pads are to meet [m].
        config: clearances, openings, and how far the hand may stand back.
        geometry: the hand.
        centred: move the hand along the closing axis to the middle of its contacts.

    Returns:
        The candidates (M,), and the row (M,) of each among the given ones. Their counts:
        given = without_contacts + too_near + too_wide + hand_in_table + hand_in_object
              + hand_in_neighbour + free; kept = free.

    Raises:
        InputError: the mesh has no area, or a transform is not rigid.
    """
    T_table_obj = se3.check_rigid(T_table_obj, "the object's pose on the table")
    Ts = np.asarray(Ts_obj_grasp, dtype=np.float64).reshape(-1, 4, 4)
    Ts = se3.check_rigid(Ts, "the given grasps").copy() if len(Ts) else Ts
    surface = RaySurface(mesh)
    open_hand = np.full(len(Ts), geometry.max_opening_m)
    contacts = pad_contacts(surface, Ts, open_hand, geometry, 1, 0.0)
    # Along the closing axis from the middle of the hand: finger 0 is at -y, finger 1 at +y.
    along = np.sum((contacts.points - Ts[:, None, :3, 3]) * Ts[:, None, :3, 1], axis=-1)
    widths = along[:, 1] - along[:, 0]
    if centred:
        Ts[:, :3, 3] += np.nan_to_num(along.mean(axis=1))[:, None] * Ts[:, :3, 1]
        needed = widths
    else:
        needed = 2.0 * np.abs(along).max(axis=1)

    most = geometry.max_opening_m - config.width_margin_m
    touched = contacts.both
    near, wide = touched & (widths < config.least_width_m), touched & (needed > most)
    wide &= ~near
    rows = np.flatnonzero(touched & ~near & ~wide)
    poses = candidates.HandPoses(
        Ts_obj_grasp=Ts[rows], widths_m=needed[rows], openings_m=open_hand[rows],
        contact_depths_m=np.zeros(len(rows)),
    )  # fmt: skip
    stand = candidates.Stand(surface, T_table_obj, surroundings.tree()[0], config, geometry)
    placed, reached = stand.placed(poses)
    free = reached == candidates.FREE
    counts = {
        "given": len(Ts),
        "without_contacts": int(np.sum(~touched)),
        "too_near": int(np.sum(near)),
        "too_wide": int(np.sum(wide)),
        "hand_in_table": int(np.sum(reached == candidates.IN_TABLE)),
        "hand_in_object": int(np.sum(reached == candidates.IN_OBJECT)),
        "hand_in_neighbour": int(np.sum(reached == candidates.IN_NEIGHBOUR)),
        "free": int(np.sum(free)),
        "kept": int(np.sum(free)),
    }
    found = candidates.Candidates(
        Ts_obj_grasp=placed.Ts_obj_grasp[free],
        widths_m=widths[rows][free],
        openings_m=placed.openings_m[free],
        contact_depths_m=placed.contact_depths_m[free],
        counts=counts,
    )
    return found, rows[free]


def standing_labels(
    labels: GraspLabels,
    mesh: Mesh,
    T_table_obj: Array,
    surroundings: Surroundings,
    config: CandidateConfig,
    geometry: Hand,
    rng: np.random.Generator,
) -> GraspLabels:
    """Return the labels whose grasps the hand can take where the object stands.

    Most of an object's labels come from below. Those that are left are what `select_rows` is to
    choose from for a scene. Of very many labels MOST_TRIED are looked at, chosen by chance.

    Args:
        labels: of the object; those in collision with it are left out.
        mesh: the object [m].
        T_table_obj: (4, 4) where it stands.
        surroundings: the other objects.
        config: clearances and openings.
        geometry: the hand.
        rng: the only source of chance.

    Raises:
        InputError: as `given_candidates`.
    """
    rows = np.flatnonzero(~labels.collision)
    if len(rows) > MOST_TRIED:
        rows = np.sort(rng.choice(rows, MOST_TRIED, replace=False))
    free = labels.rows(rows)
    _, standing = given_candidates(
        mesh, T_table_obj, surroundings, free.Ts_obj_grasp(), config, geometry
    )
    return free.rows(standing)
