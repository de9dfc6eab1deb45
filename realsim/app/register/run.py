"""The registration of a session: read what is there, find the objects, write, draw."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import numpy as np

from realsim.app.console import Console
from realsim.app.register import from_review, results
from realsim.app.register.config import RegisterRequest
from realsim.app.register.files import costs_of, finish_interrupted, write_result
from realsim.app.register.inputs import RegisterInputs, read_inputs
from realsim.app.register.results import CameraChange, Registered, Remark
from realsim.app.reviewed import damage_words, review_of, stray_words
from realsim.app.stages import content_key, note, require_sound, take_models
from realsim.arrays import Array, evenly
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, ObjectModel, Scene
from realsim.registration.refinement.uncertainty import SeenPose, without_turns
from realsim.registration.register import Registration
from realsim.store import SessionStore
from realsim.store.provenance import is_current

STAGE = "register"
READ = (
    "rgb/*", "depth/*", "robot.jsonl", "calibration/hand_eye.json", "calibration/depth_bias.json",
    "registration/starts.json", "registration/masks/*", "review/journal.jsonl", "models/*",
)  # fmt: skip
"""Files of a session that a registration is made of."""
BESIDE = "the depth does not lie on the photographs, and labels would lie beside the object"
"""Why no pose is accepted then."""
COLOUR_VIEWS = 5
"""So many views, spread over the session, are held against their photographs: a third of a second
each where they do not fit, a tenth where they do."""
QUIET_KINDS = ("aligned", "unknown")
"""Kinds of findings that need no words."""
Amend = Callable[[Registered], Registered]
PIXEL_POINTS = 40
"""Vertices of a mesh over which the pixel uncertainty is averaged."""
STEP = 1e-6
"""Step of the numerical derivative [rad, m]."""


def register_session(store: SessionStore, console: Console) -> Scene:
    """Register the objects of a session and return the scene; see `run_register`."""
    return run_register(store, console, RegisterRequest()).scene


def run_register(
    store: SessionStore, console: Console, request: RegisterRequest, amend: Amend | None = None
) -> Registered:
    """Find the pose of every object in every view, and leave it in the session.

    The session's cameras become the refined ones; where they were claimed to be is kept, and a
    second run starts from there. With the same inputs nothing is computed again.

    Args:
        store: the session.
        console: where progress is shown.
        request: what was asked for.
        amend: changes the result before it is written; None = it stays as it is.

    Raises:
        InputError: no camera poses, nothing says what is there, or an object without a mesh.
        UnitError: a start is in other units than metres.
    """
    require_sound(store)
    finish_interrupted(store)
    with console.stage("register", "cameras" if request.hand_held else "inputs") as tick:
        inputs = read_inputs(store, request, tick)
    key = inputs.key if amend is None else content_key(inputs.key, "amended")
    if is_current(store, STAGE, key) and store.has(results.SCENE_FILE):
        return _as_it_was(store)
    starts = from_review.review_starts(store, None) if request.from_review else None
    result, told = _registered(store, console, request, inputs), list[str]()
    if starts is not None:
        result, told = from_review.stayed(store, starts, result)
        told = [*starts.words, *told]
    result = _with_review(store, inputs, told, result)
    models = inputs.models
    if amend is not None:
        result = amend(result)
    if request.library is not None:
        found = sorted({o.obj_id for o in result.scene.objects})
        copied = take_models(store, request.library, found) if found else ()
        if copied:
            console.say(f"models {', '.join(map(str, copied))} copied from {request.library}")
    with console.stage("register", "pictures and page"):
        pictures = _pictures(store, result, models)
        kept = from_review.keep_earlier(store) if from_review.is_precious(store) else None
        if kept is not None:
            console.say(f"the scene that was there stays in {kept}")
        write_result(store, result, models, pictures)
        if starts is not None:
            store.write_json(from_review.REVIEW_FILE, starts.to_json())
        else:
            store.remove(from_review.REVIEW_FILE)
    note(
        store, STAGE, console, request=asdict(request) | {"amended": amend is not None},
        config=inputs.settings(), inputs=READ, key=key, more_times=costs_of(result.report),
    )  # fmt: skip
    return result


def _with_review(
    store: SessionStore, inputs: RegisterInputs, told: Sequence[str], result: Registered
) -> Registered:
    """Return the result with what came of the review, and what it means for its decisions."""
    state = review_of(store)
    moved = [
        f"instance {placed.instance} was accepted by {entry.reviewer}, {mm:.2g} mm and "
        f"{deg:.2g} deg from here: that decision counts no longer, look at it again."
        for placed, entry, mm, deg in from_review.moved_since_accepted(result.scene.objects, state)
    ]
    instances = from_review.instances_ever(store) | {o.instance for o in result.scene.objects}
    views = {v.index for v in store.session.views}
    models = {int(p.stem[4:]) for p in store.path("models").glob("obj_[0-9]*.*")}
    strays = stray_words(state, instances, views, models | set(inputs.models))
    words = (*told, *moved, *strays, damage_words(store))
    remarks = [Remark(None, "review", w) for w in words if w]
    return replace(result, remarks=(*result.remarks, *remarks))


def _as_it_was(store: SessionStore) -> Registered:
    """Return the registration that is there, its cameras in place."""
    record = results.load_cameras(store)
    if record is not None and not results.is_same_cameras(
        store.session.Ts_world_cam, record.session
    ):
        store.set_cameras(store.session.intrinsics, record.session)
    return results.load_registered(store)


def _registered(
    store: SessionStore, console: Console, request: RegisterRequest, inputs: RegisterInputs
) -> Registered:
    """Return the result of the registration."""
    from realsim.registration.register import register_scene

    n = "what is there" if inputs.wanted is None else f"{len(inputs.wanted)} objects"
    up = store.extra.get("gravity_up_world")
    with console.stage("register", f"{n}, {len(inputs.views)} views") as tick:
        found = register_scene(
            store.session.name, store.session.intrinsics, inputs.frames(store), inputs.models,
            inputs.wanted, inputs.config, fixed=[f.frames for f in inputs.fixed.values()],
            gravity_up_world=None if up is None else np.array(up), progress=tick,
            told=console.doing,
        )  # fmt: skip
    result = as_registered(found, inputs, store.session.intrinsics, request)
    off = colour_remark(store, sorted(found.cameras))
    if off is None:
        return result
    # Poses fit the depth, but labels are drawn on photographs.
    objects = tuple(
        o if o.verdict != "accepted"
        else replace(o, verdict="doubtful", reasons=(*o.reasons, BESIDE))
        for o in result.scene.objects
    )  # fmt: skip
    scene = replace(result.scene, objects=objects)
    return replace(result, scene=scene, remarks=(*result.remarks, off))


def colour_remark(store: SessionStore, views: Sequence[int]) -> Remark | None:
    """Return what is wrong with how depth lies on colour; None = nothing, or it cannot be told.

    Args:
        store: the session.
        views: numbers of views with depth.
    """
    from realsim.registration import depth_alignment

    findings: list[depth_alignment.AlignmentFinding] = []
    for index in evenly(views, COLOUR_VIEWS):
        rgb = store.rgb(index)
        if rgb.min() < rgb.max():  # else no colour was recorded
            findings.append(
                depth_alignment.check_alignment(rgb, store.depth_m(index), store.session.intrinsics)
            )
    if not findings:
        return None
    found = depth_alignment.pooled_alignment(findings)
    return None if found.kind in QUIET_KINDS else Remark(None, found.kind, found.words)


def as_registered(
    found: Registration,
    inputs: RegisterInputs,
    intrinsics: CameraIntrinsics,
    request: RegisterRequest,
) -> Registered:
    """Return what a registration found with what was asked of it."""
    seen = found.seen or seen_at_their_word(found, inputs.models, intrinsics)
    left_out = [*inputs.left_out, *((None, w) for w in (*inputs.fixed_out, *inputs.models_out))]
    remarks = [Remark(k, "left_out", why) for k, why in left_out]
    # A finding of a view has an index as well, that of a robot pose a view.
    remarks += [
        Remark(getattr(f, "index", getattr(f, "view", None)), str(f.kind), f.words)
        for f in found.findings
    ]
    asked = {
        "method": request.method,
        "cameras_refined": bool(found.seen),
        "hand_held": request.hand_held,
        "views": list(inputs.views),
        "fixed_cameras": list(inputs.fixed),
        "depth_bias_taken_out": {
            "scale": inputs.config.bias.scale,
            "offset_per_m": inputs.config.bias.offset_per_m,
        },
    }
    return Registered(
        scene=found.scene, single_view=found.single_view,
        cameras=CameraChange(claimed=dict(inputs.claimed), refined=dict(found.cameras)),
        seen={k: dict(poses) for k, poses in seen.items()}, not_placed=found.not_placed,
        remarks=tuple(remarks), report={"asked": asked} | dict(found.report),
        fixed={name: inputs.fixed[name].change(T) for name, T in found.fixed_cameras.items()},
    )  # fmt: skip


def seen_at_their_word(
    found: Registration, models: dict[int, ObjectModel], intrinsics: CameraIntrinsics
) -> dict[int, dict[int, SeenPose]]:
    """Return the objects in every view whose cameras were not refined.

    The cameras count as exact: an object's uncertainty is its own, seen from there.
    """
    out: dict[int, dict[int, SeenPose]] = {}
    unknown = np.full((6, 6), np.nan)
    for index, T_world_cam in found.cameras.items():
        out[index] = {}
        for o in found.scene.objects:
            T_cam_obj = se3.invert(T_world_cam) @ o.T_world_obj
            covariance = unknown if o.covariance is None else o.covariance
            vertices = models[o.obj_id].mesh.vertices
            points = vertices[:: max(1, len(vertices) // PIXEL_POINTS)]
            shown = without_turns(covariance, models[o.obj_id].symmetry_axes, points)
            sigma = pixel_sigma(intrinsics, T_cam_obj, shown, points)
            out[index][o.instance] = SeenPose(
                T_cam_obj=T_cam_obj, covariance=covariance, sigma_px=sigma
            )
    return out


def pixel_sigma(
    intrinsics: CameraIntrinsics, T_cam_obj: Array, covariance: Array, points: Array
) -> float:
    """Return the RMS 1-sigma in the image of points (N, 3) of an object [px]; NaN = not known.

    sigma^2 = mean over the points of tr(J C J^T), J = d(u, v) / d(twist) by central differences.
    """
    columns: list[Array] = []
    for k in range(6):
        twist = STEP * np.eye(6)[k]
        ends = [
            camera.project(intrinsics, se3.transform(T_cam_obj @ se3.exp(s * twist), points))
            for s in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / (2 * STEP))
    J = np.stack(columns, axis=-1)
    J = J[np.isfinite(J).all((1, 2))]
    if len(J) == 0 or not np.all(np.isfinite(covariance)):
        return float("nan")
    return float(
        np.sqrt(np.mean(np.trace(J @ covariance @ np.swapaxes(J, 1, 2), axis1=1, axis2=2)))
    )


def _pictures(
    store: SessionStore, result: Registered, models: dict[int, ObjectModel]
) -> dict[str, bytes]:
    """Return every picture and the page, by path in the session."""
    from realsim.app.register.page import page_bytes
    from realsim.app.register.pictures import draw_pictures

    pictures = draw_pictures(store, result, models)
    named = {f"{results.PICTURES}/{name}": data for name, data in pictures.items()}
    return named | {results.PAGE_FILE: page_bytes(store, result, models, pictures)}
