"""What `realsim register` starts from: views, claimed cameras, models, what is known of poses."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim import __version__
from realsim.app.register.config import RegisterRequest, config_of
from realsim.app.register.files import write_claims
from realsim.app.register.fixed import FixedInput, read_fixed
from realsim.app.register.from_review import accepted_in, review_starts
from realsim.app.register.results import claimed_cameras, load_cameras
from realsim.app.reviewed import exclusion_words, review_of
from realsim.app.stages import content_key, session_models, take_models
from realsim.arrays import Array, Array32, evenly
from realsim.errors import InputError, UnitError
from realsim.records import ObjectModel, View
from realsim.records.calibration import DepthBias
from realsim.registration.search.records import Wanted
from realsim.store import SessionStore
from realsim.store.manifest import Manifest
from realsim.store.session_store import depth_path, rgb_path

if TYPE_CHECKING:
    from realsim.app.console import Tick
    from realsim.registration.config import RegistrationConfig
    from realsim.registration.evidence import DepthFrame

STARTS_FILE = "registration/starts.json"
MASKS = "registration/masks"
"""Where masks lie that starts speak of."""
FARTHEST_START_M = 4.0
"""Objects lie nearer to the cameras than this; millimetres would make it a thousand times more."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RegisterInputs:
    """Everything a registration is made from."""

    models: dict[int, ObjectModel]
    """Those that are wanted, or may be found."""
    wanted: list[Wanted] | None
    """None = whatever is there."""
    claimed: dict[int, Array]
    """View -> (4, 4) T_world_cam as claimed, of all views."""
    views: tuple[int, ...]
    """The views that take part."""
    left_out: tuple[tuple[int, str], ...]
    """Views that do not, and why."""
    config: "RegistrationConfig"
    key: str
    """Hash of all of it."""
    fixed: dict[str, FixedInput]
    """Cameras that stand still, by name."""
    fixed_out: tuple[str, ...]
    """Why others take no part."""
    models_out: tuple[str, ...]
    """Which models that were given are not sought, and why."""

    def settings(self) -> dict[str, Any]:
        """Return every setting in force, but for where things are kept between runs."""
        return asdict(replace(self.config, field_folder=None))

    def frames(self, store: SessionStore) -> "list[DepthFrame]":
        """Return the frames; an image is read when it is asked for: 256 of them are a gigabyte."""
        from realsim.registration.evidence import LazyFrame

        return [
            LazyFrame(
                k, self.claimed[k], lambda k=k: store.depth_m(k), read_rgb=lambda k=k: store.rgb(k)
            )
            for k in self.views
        ]


def read_inputs(
    store: SessionStore, request: RegisterRequest, tick: "Tick | None" = None
) -> RegisterInputs:
    """Return everything a registration is made from.

    Args:
        store: the session.
        request: what was asked for.
        tick: called while the views of a hand-held capture are aligned.

    Raises:
        InputError: nothing says what is there, an unknown model, no depth, no camera poses.
        UnitError: a start is in other units than metres.
    """
    available, models_out = _available(store, request)
    claimed = _claimed(store, request, tick)
    wanted = _wanted(store, request, available)
    if wanted is not None and not wanted:
        raise InputError(
            f"'{store.path(STARTS_FILE)}' names no object: 'starts' is empty. Give a "
            "row per object, name them by --object, or delete the file and ask for --find-all."
        )
    views, left_out = _views(store, request, claimed)
    if wanted is not None:
        _check_distances(wanted, [claimed[k] for k in views])
        ids = {w.obj_id for w in wanted}
        available = {k: m for k, m in available.items() if k in ids}
    _check_solids(available)
    if wanted and request.library is not None:
        take_models(store, request.library, sorted({w.obj_id for w in wanted}))
    fixed, fixed_out = read_fixed(store, request)
    config = config_of(store, request)
    constants = asdict(replace(config, field_folder=None, bias=DepthBias.none()))
    bias = config.bias
    key = content_key(
        __version__, constants, [bias.scale, bias.offset_per_m, bias.covariance.tolist()],
        {str(k): model_hash(m) for k, m in available.items()},
        _said(store, request),
        {str(k): claimed[k].tolist() for k in sorted(claimed)}, list(views),
        _image_hashes(store, views), str(store.session.intrinsics),
        store.extra.get("gravity_up_world"), *(f.key for f in fixed.values()),
        *models_out,
    )  # fmt: skip
    return RegisterInputs(
        models=available, wanted=wanted, claimed=claimed, views=views, left_out=left_out,
        config=config, key=key, fixed=fixed, fixed_out=tuple(fixed_out),
        models_out=models_out,
    )  # fmt: skip


# --- models and what is wanted ----------------------------------------------------------------


def _available(
    store: SessionStore, request: RegisterRequest
) -> tuple[dict[int, ObjectModel], tuple[str, ...]]:
    """Return all models that can be spoken of, the session's own before the library's.

    And in words which others were given.
    """
    from realsim.formats.bop.models import load_models
    from realsim.models.library_files import INFO_FILE, read_info

    library = {} if request.library is None else load_models(request.library)
    folder = store.folder / "models"
    own = {} if library and not folder.is_dir() else session_models(store)
    out = [
        f"model {i} of the library, '{m.name}', is not used: the session's model {i} is "
        f"'{own[i].name}'. Give one of them another id."
        for i, m in sorted(library.items()) if i in own and own[i].name != m.name
    ]  # fmt: skip
    for home in (folder, request.library) if request.find_all else ():
        if home is None or not (home / INFO_FILE).is_file():
            continue
        lost = sorted(read_info(home).keys() - own.keys() - library.keys())
        if lost:
            ids = ", ".join(map(str, lost))
            out.append(
                f"{home.name}/{INFO_FILE} lists models without a mesh, which are not sought: {ids}."
            )
    return library | own, tuple(out)


def _check_solids(models: Mapping[int, ObjectModel]) -> None:
    """Refuse a model without volume by its name, before the session takes it in."""
    from realsim.geometry.mesh_shape import mass_properties

    for k, model in sorted(models.items()):
        try:
            mass_properties(model.mesh, density=1.0)
        except InputError as error:
            raise InputError(
                f"object {k} ('{model.name}') cannot be registered: {error} Leave it out, or give "
                "it its thickness."
            ) from error


def _wanted(
    store: SessionStore, request: RegisterRequest, models: Mapping[int, ObjectModel]
) -> list[Wanted] | None:
    """Return what is wanted: as typed, else the session's starts, else whatever is there.

    Raises:
        InputError: nothing says it, or two things do.
    """
    from realsim.registration.hints import parse_objects, read_starts

    if request.from_review:
        if request.objects or request.find_all:
            raise InputError(
                "--from-review takes the objects from the reviewed scene: leave --object and "
                "--find-all away."
            )
        return review_starts(store, models).wanted(models)
    if request.find_all and request.objects:
        raise InputError(
            "--find-all finds out what is there, and --object says it: give one of both."
        )
    if request.find_all:
        return None
    if request.objects:
        return parse_objects(request.objects, models, store)
    if store.has(STARTS_FILE):
        return read_starts(store.path(STARTS_FILE), models, store)
    raise InputError(
        f"session '{store.folder}' does not say what is on the table. Say it in one of three "
        "ways: --object ID, once for every object (also NAME, 5x2 for two of them, or with a click "
        f"5@view3:640,360); a file {STARTS_FILE} with rough poses, clicks or boxes; or --find-all "
        f"to find out which of the {len(models)} models are there."
    )


def _said(store: SessionStore, request: RegisterRequest) -> list[Any]:
    """Return what was said of the objects, as it was said.

    Not the regions that were made of it: they move a little when cameras are refined.
    """
    if request.from_review:
        starts = review_starts(store, None)
        return ["review", starts.rows, starts.words, accepted_in(store)]
    if request.objects or request.find_all:
        return [list(request.objects), request.find_all]
    files = [store.path(STARTS_FILE), *sorted(store.path(MASKS).glob("*"))]
    return [[f.name, hashlib.sha256(f.read_bytes()).hexdigest()] for f in files]


def model_hash(model: ObjectModel) -> str:
    """Return the hash of everything of a model that a pose depends on."""
    digest = hashlib.sha256(model.mesh.vertices.tobytes())
    digest.update(model.mesh.faces.tobytes())
    digest.update(model.symmetries.tobytes())
    digest.update(repr((model.name, model.symmetry_axes)).encode())
    return digest.hexdigest()


def _check_distances(wanted: Sequence[Wanted], cameras: Sequence[Array]) -> None:
    """Raise if a start lies further from the cameras than any table-top: other units, likely."""
    eyes = np.stack(cameras)[:, :3, 3]
    for w in wanted:
        if w.T_start is None:
            continue
        distance = float(np.min(np.linalg.norm(eyes - w.T_start[:3, 3], axis=1)))
        if distance > FARTHEST_START_M:
            raise UnitError(
                f"the start of instance {w.instance} lies {distance:.3g} m from the nearest "
                f"camera; at most {FARTHEST_START_M:g} m is accepted. Metres are expected in "
                f"{STARTS_FILE} and in the camera poses: were millimetres given?"
            )


# --- cameras and views ------------------------------------------------------------------------


def _claimed(
    store: SessionStore, request: RegisterRequest, tick: "Tick | None"
) -> dict[int, Array]:
    """Return where the cameras are claimed to be.

    Raises:
        InputError: nobody claims it, or two do.
    """
    claimed = claimed_cameras(store)
    record = load_cameras(store)
    if request.hand_held and request.odometry:
        raise InputError(
            "--odometry holds the robot's poses against the depth images, and with --hand-held "
            "there is no robot: leave one of both away."
        )
    if not request.hand_held:
        if claimed:
            return claimed
        if not store.session.views:
            raise InputError(
                f"session '{store.folder}' holds no views (what `realsim check --repair` took out "
                "lies in its folder 'damaged'); capture them again."
            )
        raise InputError(
            f"no view of session '{store.folder}' has a camera pose yet: run "
            f"`realsim calibrate {store.folder}` first. A capture without a robot, the camera led "
            "by hand over the table, needs none: --hand-held."
        )
    if record is not None and set(claimed) <= set(record.claimed):
        return claimed  # an earlier run has found them
    if claimed or any(v.T_base_ee is not None for v in store.session.views):
        raise InputError(
            f"--hand-held finds the cameras from the depth images, but session '{store.folder}' "
            "has camera or robot poses, which are better. Leave --hand-held away."
        )
    return _hand_held(store, tick)


def _hand_held(store: SessionStore, tick: "Tick | None") -> dict[int, Array]:
    """Return the cameras of a capture without a robot, in the frame of its table."""
    from realsim.registration.odometry.hand_held import hand_held_poses
    from realsim.registration.views import SampleConfig

    indices = [v.index for v in store.session.views if store.has_depth(v.index)]
    if not indices:
        raise InputError(f"session '{store.folder}' has no view with depth.")
    depths: list[Array32] = []
    for done, index in enumerate(indices, start=1):
        depths.append(store.depth_m(index))
        if tick is not None:
            tick(done, len(indices))
    found = hand_held_poses(store.session.intrinsics, depths, SampleConfig())
    # As the session would give them back: a rotation is made orthonormal when a view is made.
    views = [View(index=k, T_world_cam=T) for k, T in zip(indices, found.Ts_world_cam, strict=True)]
    placed = {v.index: v.T_world_cam for v in views if v.T_world_cam is not None}
    # Kept at once: clicks are read through them, and the next run need not find them again.
    write_claims(store, placed)
    return placed


def _views(
    store: SessionStore, request: RegisterRequest, claimed: Mapping[int, Array]
) -> tuple[tuple[int, ...], tuple[tuple[int, str], ...]]:
    """Return the views that take part, and why others do not.

    Raises:
        InputError: there is none.
    """
    left_out: list[tuple[int, str]] = []
    usable: list[int] = []
    excluded = review_of(store).excluded_views()
    for view in store.session.views:
        if view.index in excluded:
            left_out.append((view.index, exclusion_words(excluded[view.index])))
        elif view.index not in claimed:
            left_out.append((view.index, "it has no camera pose."))
        elif not store.has_depth(view.index):
            left_out.append((view.index, "it was recorded without depth."))
        else:
            usable.append(view.index)
    if not usable:
        and_excluded = f" ({len(excluded)} are excluded by a reviewer)" if excluded else ""
        raise InputError(
            f"session '{store.folder}' has {len(store.session.views)} views{and_excluded}, and "
            "none with depth and a camera pose; registration needs at least one."
        )
    if request.views is not None:
        usable = evenly(usable, request.views)
    return tuple(usable), tuple(left_out)


def _image_hashes(store: SessionStore, views: Sequence[int]) -> list[str]:
    """Return the checksums of depth images and photographs, as listed when they were captured."""
    entries = Manifest(store.folder).entries
    paths = [path(k) for k in views for path in (depth_path, rgb_path)]
    return [entries[p].sha256 if p in entries else p for p in paths]
