"""Analytic labels: what closes, what is hit, which few are chosen, what the School makes of them.

The School's picture sheet: its figures are the sets', and its words do not overlap.
"""

import io
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from PIL import Image

from realsim.formats.graspnet import gripper_frame as frame
from realsim.formats.graspnet.grasp_labels import write_grasp_labels
from realsim.formats.grasps.scene_grasps import executed, untried_set
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import ObjectModel
from realsim.records.grasps import MEASURES
from realsim.robots.hand import find_hand
from realsim_sim_bridge.grasping.analytic import (
    AnalyticConfig,
    analytic_labels,
    gripper_boxes,
    select_rows,
)
from realsim_sim_bridge.grasping.analytic_given import given_candidates, standing_labels
from realsim_sim_bridge.grasping.candidates import CandidateConfig, Surroundings
from realsim_sim_bridge.grasping.force_closure import ClosureConfig, force_closure
from realsim_sim_bridge.school import SchoolConfig
from realsim_sim_bridge.school.school import run_school
from realsim_sim_bridge.school.sheet import left_after, school_sheet, sheet_figure
from realsim_sim_bridge.school.sheet_object import STOPS, stops_of
from realsim_sim_bridge.school.summary import summarise
from realsim_sim_bridge.slip.engines import MujocoSettings
from refusals import refused
from school_sessions import NAMES, scene
from tried_grasps import assert_same, tried_set
from trimesh_solids import ball, box, wedge

HAND = find_hand()
FEW = AnalyticConfig(points=12)
BOX = box((0.04, 0.06, 0.1))


def labels_of(mesh, config=FEW, seed=0):
    return analytic_labels(mesh, np.random.default_rng(seed), config)


@pytest.fixture(scope="module")
def of_box():
    return BOX, labels_of(BOX)


# --- laws -------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_labels(of_box):
    mesh, labels = of_box
    assert_same(labels_of(mesh), labels)


@pytest.mark.parametrize("mesh", [replace(BOX, faces=BOX.faces[:, ::-1]), ball(0.03, 3)])
def test_the_friction_is_that_of_the_measure_closure_friction(mesh):
    """Two ways to the same number: rays of 14,400 lines a point, and the hand's closing axis."""
    labels = labels_of(mesh)
    some = labels.rows(np.arange(0, len(labels), max(1, len(labels) // 300)))
    config, openings = ClosureConfig(levels=AnalyticConfig().levels), some.openings_m.astype(float)
    closure = force_closure(mesh, some.Ts_obj_grasp(), openings, config, HAND)
    same = np.abs(closure.closure_friction - some.friction) < 1e-6
    # Lines along an edge meet the one or the other face.
    assert len(some) > 50 and same.mean() > 0.97


# --- known answers ----------------------------------------------------------------------------


def test_what_closes_on_a_wedge_needs_the_friction_of_its_slopes():
    """A line across slopes at +-a, itself tilted by any angle, written out by hand."""
    half_angle = 0.25
    labels = labels_of(wedge(half_angle), AnalyticConfig(points=30))
    Ts = labels.Ts_obj_grasp()
    middle, y = Ts[:, :3, 3], Ts[:, :3, 1]
    y = y * np.sign(y[:, 1:2])
    needed, on_slopes = [], np.ones(len(y), dtype=bool)
    for side in (1, -1):
        n = np.array([-np.sin(half_angle), side * np.cos(half_angle), 0.0])
        edge = np.array([-0.02, side * 0.008, 0.0])
        with np.errstate(divide="ignore"):
            contact = middle + ((edge - middle) @ n / (y @ n))[:, None] * y
        on_slopes &= (np.abs(contact[:, 0]) < 0.0199) & (np.abs(contact[:, 2]) < 0.0299)
        needed.append(np.tan(np.arccos(np.clip(side * (y @ n), -1, 1))))
    needed = np.max(needed, axis=0)[on_slopes]
    level = np.ceil(needed * 10 - 1e-4) / 10
    assert on_slopes.sum() > 200 and needed.min() >= np.tan(half_angle) - 1e-6
    np.testing.assert_allclose(labels.friction[on_slopes], level, atol=1e-6)


def test_a_box_that_nothing_can_hold_has_no_label():
    labels = labels_of(box((0.3, 0.3, 0.3)))
    assert len(labels) == 0 and len(labels.points) == 12
    assert len(select_rows(labels, 10, np.random.default_rng(0))) == 0


def test_graspnets_gripper_has_the_boxes_of_its_collision_check():
    boxes = gripper_boxes(np.array([0.03]), np.array([0.05]))[0]
    np.testing.assert_allclose(boxes[0], [[-0.03, -0.035, -0.01], [-0.02, 0.035, 0.01]])
    np.testing.assert_allclose(boxes[1], [[-0.02, -0.035, -0.01], [0.03, -0.025, 0.01]])
    np.testing.assert_allclose(boxes[2], [[-0.02, 0.025, -0.01], [0.03, 0.035, 0.01]])


def test_a_palm_in_the_object_collides_with_it():
    """Wherever one of a dozen points of the gripper is in the box, the label says so."""
    half = np.array([0.03, 0.1, 0.1])
    labels = labels_of(box(2 * half))
    Ts = frame.graspnet_poses(labels.Ts_obj_grasp(), labels.depths_m)
    boxes = gripper_boxes(labels.depths_m.astype(float), labels.openings_m.astype(float))
    at = np.array([[a, b, c] for a in (0.1, 0.5, 0.9) for b in (0.1, 0.9) for c in (0.2, 0.8)])
    p = boxes[:, :, :1] + at * (boxes[:, :, 1:] - boxes[:, :, :1])
    inside = np.all(np.abs(se3.transform(Ts, p.reshape(len(Ts), -1, 3))) < half, axis=-1).any(1)
    assert inside.sum() > 100 and labels.collision[inside].all()
    assert (~labels.collision).sum() > 20


# --- the choice -------------------------------------------------------------------------------


def test_the_choice_is_free_spread_and_of_every_level(of_box):
    labels = of_box[1]
    rows = select_rows(labels, 60, np.random.default_rng(1))
    few = labels.rows(select_rows(labels, 60, np.random.default_rng(1)))
    assert len(few) == 60
    np.testing.assert_array_equal(few.index, labels.index[rows])
    np.testing.assert_array_equal(few.friction, labels.friction[rows])
    assert not labels.collision[rows].any()
    there = np.unique(labels.friction[~labels.collision])
    shares = [np.sum(labels.friction[rows] == f) for f in there]
    assert min(shares) >= min(4, 60 // len(there))
    chance = np.random.default_rng(2).choice(np.flatnonzero(~labels.collision), 60)

    def nearest(Ts):
        d = np.linalg.norm(Ts[:, None, :3, 3] - Ts[None, :, :3, 3], axis=-1)
        return np.median((d + np.eye(len(d))).min(axis=1))

    Ts = labels.Ts_obj_grasp()
    assert nearest(Ts[rows]) > 1.3 * nearest(Ts[chance])


# --- given grasps -----------------------------------------------------------------------------


def standing(mesh):
    return se3.from_translation([0.3, 0.1, -mesh.vertices[:, 2].min()])


def test_given_grasps_keep_their_contacts_and_their_friction(of_box):
    mesh, labels = of_box
    given = labels.rows(select_rows(labels, 80, np.random.default_rng(0)))
    Ts = given.Ts_obj_grasp()
    alone, config = Surroundings(), CandidateConfig()
    found, rows = given_candidates(mesh, standing(mesh), alone, Ts, config, HAND)
    counts = found.counts
    taken = ("without_contacts", "too_near", "too_wide", "hand_in_table", "hand_in_object",
             "hand_in_neighbour", "free")  # fmt: skip
    assert counts["given"] == 80 == sum(counts[name] for name in taken)
    assert len(rows) == counts["kept"] > 5
    closure = force_closure(
        mesh, found.Ts_obj_grasp, found.openings_m, ClosureConfig(levels=FEW.levels), HAND,
        contact_depths_m=found.contact_depths_m,
    )  # fmt: skip
    same = np.abs(closure.closure_friction - given.friction[rows]) < 1e-6
    assert same.mean() > 0.95
    middle = closure.axis_contacts.points.mean(axis=1)
    off = np.sum((middle - found.Ts_obj_grasp[:, :3, 3]) * found.Ts_obj_grasp[:, :3, 1], axis=1)
    assert np.abs(off).max() < 1e-6  # both fingers touch at once
    np.testing.assert_allclose(found.Ts_obj_grasp[:, :3, :3], Ts[rows, :3, :3], atol=1e-12)


def test_labels_that_stand_are_those_the_hand_can_take(of_box):
    mesh, labels = of_box
    T = standing(mesh)
    config, rng = CandidateConfig(), np.random.default_rng(0)
    found = standing_labels(labels, mesh, T, Surroundings(), config, HAND, rng)
    assert 20 < len(found) < (~labels.collision).sum() and not found.collision.any()
    Ts = found.rows(select_rows(found, 40, rng)).Ts_obj_grasp()
    again, rows = given_candidates(mesh, T, Surroundings(), Ts, config, HAND)
    assert len(rows) == len(Ts) == 40
    lowest = np.min((T @ again.Ts_obj_grasp)[:, 2, 3])
    assert lowest > 0 and again.counts["hand_in_table"] == 0


# --- in the School: those of the labels are tried, with the labels' friction ----------------------


LABELS = AnalyticConfig(points=40, view_step=2)
MODELS = {part(n).obj_id: part(n) for n in NAMES}


def config_of(**changed):
    config = SchoolConfig(max_candidates=12, analytic=LABELS)
    return replace(config, slip=replace(config.slip, engine=MujocoSettings()), **changed)


def test_labels_are_tried_and_keep_their_friction():
    sets = run_school(scene(), MODELS, config_of(), workers=1)
    for s in sets:
        friction = s.measures["closure_friction"]
        assert 0 < len(s) <= 12 and executed(s).any()
        assert np.all(np.isin(friction, LABELS.levels))
        assert s.parameters["analytic"]["from"] == "computed"
    assert len({float(f) for s in sets for f in s.measures["closure_friction"]}) > 1


def test_labels_of_a_file_are_taken_instead_and_told_apart(tmp_path):
    files = {}
    for obj_id, model in MODELS.items():
        files[obj_id] = tmp_path / f"{obj_id - 1:03d}_labels.npz"
        labels = analytic_labels(model.mesh, np.random.default_rng(3), LABELS)
        write_grasp_labels(files[obj_id], labels)
    cache = tmp_path / "cache"
    sets = run_school(
        scene(), MODELS, config_of(), workers=1, cache=cache, label_files=files, restart=True
    )
    for s in sets:
        assert s.parameters["analytic"]["from"] == files[s.obj_id].name
        assert executed(s).any()
    refused("labels", run_school, scene(), MODELS, config_of(), workers=1, cache=cache)


def model(obj_id=1, name="box"):
    return ObjectModel(obj_id=obj_id, name=name, mesh=box((0.05, 0.08, 0.1)))


def some_sets(n_sets=3, n=50, seed=0, **how):
    rng = np.random.default_rng(seed)
    return [tried_set(rng, n, obj_id=1, instance=k, **how) for k in range(n_sets)]


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


# --- what is counted --------------------------------------------------------------------------


def test_every_grasp_stopped_somewhere_and_fewer_are_left_each_time():
    sets = some_sets(5)
    stops = np.concatenate([stops_of(s) for s in sets])
    assert stops.min() >= 0 and stops.max() < len(STOPS)
    left = left_after(sets)
    assert left[0] == sum(len(s) for s in sets) and np.all(np.diff(left) <= 0)
    assert left[-1] == sum(int(np.sum(s.base_scores == 1)) for s in sets)
    found = summarise(sets)
    assert left[1] == found.with_trajectory
    assert left[2] == found.with_trajectory - found.outcomes["fail_close"]
    assert left[3] == left[2] - found.outcomes["fail_lift"]


# --- the picture ------------------------------------------------------------------------------


def test_the_same_sets_give_the_same_bytes_and_an_object_stands_as_it_is_told_to():
    s = some_sets(1, 6)
    png = school_sheet(s, {1: model()}, title="Tisch 1")
    again = school_sheet(s, {1: model()}, title="Tisch 1", Ts_up_obj={0: np.eye(4)})
    assert png == again and pixels(png).shape[1] == 1600
    turned = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    assert png != school_sheet(s, {1: model()}, title="Tisch 1", Ts_up_obj={0: turned})


def test_the_bars_of_the_label_hold_as_many_grasps_as_their_title_says():
    figure = sheet_figure(some_sets(), {1: model()}, "t", {})
    ax = next(ax for ax in figure.axes if "tried grasps" in ax.get_title("left"))
    assert f"of {sum(bar.get_height() for bar in ax.patches):.0f} tried" in ax.get_title("left")


@pytest.mark.parametrize("measures", [("margin",), tuple(MEASURES)])
def test_no_two_words_overlap_and_all_are_on_the_sheet(measures):
    name = "a name that is far too long for any panel of a sheet, with a number 000123"
    sets = [replace(s, instance=100 + s.instance) for s in some_sets(3, 30, measures=measures)]
    figure = sheet_figure(sets, {1: model(name=name)}, "A title that is also long " * 4, {})
    figure.canvas.draw()
    texts = [t for ax in figure.axes for t in (*ax.texts, ax.title, ax._left_title)]
    for ax in figure.axes:
        if ax.axison:
            texts += [ax.xaxis.label, ax.yaxis.label]
            for axis, (low, high) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
                texts += [t.label1 for t in axis.get_major_ticks() if low <= t.get_loc() <= high]
    shown = [t for t in (*texts, *figure.texts) if t.get_text().strip() and t.get_visible()]
    boxes = [(t.get_text(), t.get_window_extent()) for t in shown]
    width, height = figure.get_size_inches() * figure.dpi
    assert len(boxes) > 20
    for text, extent in boxes:
        assert extent.x0 >= 0 and extent.x1 <= width
        assert extent.y0 >= 0 and extent.y1 <= height, text
    for (a, extent), (b, other) in combinations(boxes, 2):
        across = min(extent.x1, other.x1) - max(extent.x0, other.x0)
        down = min(extent.y1, other.y1) - max(extent.y0, other.y0)
        assert across <= 0.5 or down <= 0.5, (a, b)


def test_the_hands_are_green_where_all_hold_and_red_where_none_does():
    def counted(score):
        """Return the green and the red pixels as if all grasps had been tried and had the score."""
        alike, slip = np.full(20, score), np.full((20, 4), 0.001)
        s = replace(
            some_sets(1, 20)[0], scores=alike, base_scores=alike, slip_m=slip, slip_rad=slip,
            reachable=np.ones(20, bool), measures={},
        )  # fmt: skip
        rgb = pixels(school_sheet([s], {1: model()}))[390:600]  # the object alone
        saturated = np.ptp(rgb, axis=-1) > 90
        red, green = rgb[saturated][:, :2].T
        return int(np.sum(green > red)), int(np.sum(red > green))

    green, red = counted(1.0)
    assert green > 500 and red == 0
    green, red = counted(0.0)
    assert red > 500 and green == 0


def test_a_set_that_is_empty_or_untried_has_its_panel_too():
    (empty,), (some,) = some_sets(1, 0, measures=()), some_sets(1, 5)
    untried = untried_set(some.Ts_obj_grasp, obj_id=2, instance=1)
    models = {1: model(), 2: model(2, "ünknown $x_1$")}
    figure = sheet_figure([empty, untried], models, "t", {})
    said = [t.get_text() for t in figure.texts]
    assert "no candidate" in said and "n = 5, not tried" in said
    assert "1  ünknown $x_1$" in said  # names are not taken for formulas
    assert len(pixels(school_sheet([], {}))) > 300


def test_an_object_without_a_model_and_too_many_are_named():
    refused("object 1 has grasps but no model", school_sheet, some_sets(1), {5: model(5)})
    refused("61 objects", school_sheet, some_sets(61, 1), {1: model()})
