"""The panel to correct an object: by hand, by steps, by the depth, by points; another id, symmetry.

Everything happens on a translucent copy. Nothing is written before "Save the pose".
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import viser

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose
from realsim.review import journal
from realsim.review.placing import placing
from realsim.review.window import window_text
from realsim.review.window.browser import Draft
from realsim.review.window.moved_copy import Correction, MovedCopy
from realsim.review.window.three_points import PointPlacer

if TYPE_CHECKING:
    from realsim.review.window.window import Window

STEPS_MM, STEPS_DEG = ("1", "5", "20"), ("1", "5", "90")
FRAMES: dict[str, placing.Frame] = {"table": "table", "object": "object", "camera": "camera"}
SIGNS = ("\u2212x", "+x", "\u2212y", "+y", "\u2212z", "+z")
SYMMETRIES = {
    "no symmetry": "none",
    "of revolution about x": "x",
    "of revolution about y": "y",
    "of revolution about z": "z",
    "alike after half a turn about z": "z:2",
    "alike after a quarter turn about z": "z:4",
    "a box: half turns about all axes": "x:2 z:2",
    "as written below": "",
}
WAITING = "Drag the arrows, or use the steps, the buttons, or the keys. Nothing is written yet."


class CorrectPanel:
    """Moves a copy of the selected object, and writes one line when it is saved."""

    def __init__(self, window: "Window") -> None:
        """Build it in the container that is open.

        Args:
            window: whose panel it is.
        """
        self._window = window
        self._now: Correction | None = None
        self._is_busy, self._offered = False, -1
        self._copy = MovedCopy(window, self._dragged)
        self.points = PointPlacer(window, self._by_points, self._asked)
        gui = window.client.gui
        self._text = gui.add_markdown("Choose an object first.")
        self._begin = gui.add_button(
            "Correct this object", icon=viser.Icon.HAND_MOVE, hint="Key M."
        )
        self._mm = gui.add_dropdown("Step [mm]", STEPS_MM, initial_value="5")
        self._deg = gui.add_dropdown("Step [deg]", STEPS_DEG, initial_value="5")
        self._frame = gui.add_dropdown("Axes of", tuple(FRAMES))
        move = gui.add_button_group("Move", SIGNS, hint="Keys J L, K I, O U.")
        turn = gui.add_button_group("Turn", SIGNS, hint="Shift with the same keys.")
        self._snap = gui.add_button(
            "Snap by ICP", icon=viser.Icon.MAGNET, hint="Key T. It takes seconds."
        )
        self._table = gui.add_button("Put it on the table", icon=viser.Icon.ARROW_BAR_TO_DOWN)
        self._three = gui.add_button("Place by three points", icon=viser.Icon.POINTER)
        self._clicks = gui.add_button_group(
            "Clicks", ("Last click back", "Shift by one", "Stop"), visible=False
        )
        self._object: viser.GuiDropdownHandle[str] = gui.add_dropdown("It really is", ["-"])
        green, grey = window_text.verdict_rgb("accepted"), window_text.GREY
        self._save = gui.add_button("Save the pose", color=green, icon=viser.Icon.DEVICE_FLOPPY)
        self._back = gui.add_button("Put back", color=grey, icon=viser.Icon.ARROW_BACK_UP)
        with gui.add_folder("Symmetry of the model", expand_by_default=False):
            self._marks = gui.add_markdown("")
            self._symmetry = gui.add_dropdown("It is", tuple(SYMMETRIES))
            self._written = gui.add_text("Written", "", hint="none, z, z:4, x:2 z:2")
            mark = gui.add_button("Mark it", icon=viser.Icon.FLIP_VERTICAL)
        self._working = (self._begin, self._snap, self._table, self._three, self._save, self._back)
        self._begin.on_click(window.guarded(lambda _: self.begin()))
        self._frame.on_update(window.guarded(lambda _: self._turned()))
        move.on_click(window.guarded(lambda _: self._pressed(move.value, "move")))
        turn.on_click(window.guarded(lambda _: self._pressed(turn.value, "turn")))
        self._snap.on_click(window.guarded(lambda _: self.snap()))
        self._table.on_click(window.guarded(lambda _: self.to_table()))
        self._three.on_click(window.guarded(lambda _: self.by_points()))
        self._clicks.on_click(window.guarded(lambda _: self._click_answer(self._clicks.value)))
        self._object.on_update(window.guarded(lambda _: self._swapped()))
        self._save.on_click(window.guarded(lambda _: self.save()))
        self._back.on_click(window.guarded(lambda _: self.put_back()))
        mark.on_click(window.guarded(lambda _: self.mark()))

    # --- where the copy is ------------------------------------------------------------------------

    @property
    def moved(self) -> ObjectPose | None:
        """The object as it is being corrected; None = nothing is."""
        if self._now is None:
            return None
        pose = self._now.T_world_obj
        return replace(self._now.start, T_world_obj=pose, obj_id=self._now.obj_id)

    def begin(self) -> Correction:
        """Take a copy of the selected object, if there is none yet."""
        with self._window.lock:
            if self._now is None:
                placed = self._window.placed
                self._show(Correction(
                    start=placed, T_world_obj=placed.T_world_obj, obj_id=placed.obj_id
                ))  # fmt: skip
            assert self._now is not None, "it was shown"
            return self._now

    def nudge(self, axis: placing.Axis, sign: int, kind: placing.Kind) -> None:
        """Move the copy by one step."""
        self._require_idle()
        with self._window.lock:
            now = self.begin()
            step = 1e-3 * float(self._mm.value)
            if kind == "turn":
                step = float(np.radians(float(self._deg.value)))
            plane = self._window.session.registered.plane
            T = placing.nudged(
                now.T_world_obj, axis, sign * step, kind, FRAMES[self._frame.value],
                T_world_table=None if plane is None else plane.T_world_table,
                T_world_cam=self._window.stand.eye(),
                pivot_obj=placing.middle_of(self._model().mesh),
            )  # fmt: skip
            self._put(T, "steps")

    def to_table(self) -> None:
        """Lower or raise the copy until it touches the table."""
        self._require_idle()
        plane = self._window.session.registered.plane
        if plane is None:
            raise InputError("this scene has no table; move the object by steps instead.")
        with self._window.lock:
            now = self.begin()
            self._put(placing.on_table(now.T_world_obj, self._model().mesh, plane), "table")

    def snap(self) -> None:
        """Let the measured depth say where the copy belongs."""
        window = self._window
        now = self.begin()
        instance = now.start.instance
        with window.working("Snapping to the measured depth", window.session.name) as progress:
            snapper = window.session.snapper()
            found = snapper.snap(instance, now.obj_id, now.T_world_obj, progress=progress)
        with window.lock:
            if self._now is not now:
                raise InputError(
                    "the object was moved while it was snapped; the result is left out."
                )
            if found.is_better:
                self._put(found.T_world_obj, "icp", tuple(found.checks.items()))
        (window.say if found.is_better else window.refuse)(found.words)

    def by_points(self) -> None:
        """Take clicks: three on the model, three in the scene."""
        self._require_idle()
        with self._window.lock:
            now = self.begin()
            self._clicks.visible = True
            self.points.begin(self._model().mesh, now.T_world_obj)

    def put_back(self) -> None:
        """Take the copy away and forget it; nothing was written."""
        if self._now is not None:
            self._forget(self._now.start.instance)
            self._offer_models()
        self.set_aside()

    def set_aside(self) -> None:
        """Take the copy away; it is there again when its object is looked at."""
        with self._window.lock:
            self._end_clicks()
            if self._now is not None:
                self._now = None
                self._copy.hide()
                self._window.photographs.tell()
            self._tell()

    def save(self) -> None:
        """Write one line: where the object really is, or what it is."""
        self._require_idle()
        window = self._window
        with window.lock:
            now = self._now
            if now is None:
                raise InputError("nothing was moved; correct the object first.")
            is_other = now.obj_id != now.start.obj_id
            if not is_other and np.allclose(now.T_world_obj, now.start.T_world_obj, atol=1e-9):
                raise InputError("the object stands where it stood; nothing is to be saved.")
            said: dict[str, Any] = {"how": "+".join(now.how), "checks": dict(now.checks)}
            if is_other:
                said["obj_id"] = now.obj_id
            entry = window.session.decide(
                "swap" if is_other else "move", now.start, window.reviewer,
                pose=now.T_world_obj, **said,
            )  # fmt: skip
            words = self._words(now)
            self.put_back()
        window.decided(entry, words)

    def _require_idle(self) -> None:
        """Refuse a change while the answer to the last one is being computed.

        Raises:
            InputError: it is.
        """
        if self._is_busy:
            raise InputError("something is being computed, nothing was done; wait until it is.")

    def require_saved(self) -> None:
        """Refuse a decision on an object that is being moved.

        Raises:
            InputError: it is.
        """
        if self._now is not None:
            raise InputError("the object is being corrected: save the pose or put it back first.")

    def mark(self) -> None:
        """Write how the model is symmetric."""
        window = self._window
        text = SYMMETRIES[self._symmetry.value] or self._written.value
        entry = window.session.mark_symmetric(window.placed.obj_id, text, window.reviewer)
        window.decided(entry, f"{window.model_of(window.placed).name} is symmetric: {text}")

    # --- the window's events ----------------------------------------------------------------------

    def enable(self, is_on: bool) -> None:
        """Allow the buttons and their keys, or not while something takes long."""
        self._is_busy = not is_on
        for button in self._working:
            button.disabled = not is_on

    def selected(self) -> None:
        """Begin with another object."""
        window = self._window
        if window.selected is None:
            return
        self._offer_models()
        draft = window.browser.drafts.get(self._key(window.selected))
        if draft is not None and self._now is None:
            try:
                self._resume(draft)
            except InputError as error:
                self._forget(draft.instance)
                window.refuse(f"A correction that this browser kept is left out: {error}")
        self._tell()

    def refresh(self) -> None:
        """Show how the model is marked, and that somebody else has moved what is corrected here."""
        window, now = self._window, self._now
        if window.selected is None:
            return
        if now is not None and journal.subject_of(window.placed) != journal.subject_of(now.start):
            self._now = replace(now, start=window.placed)
            self._tell()
            self._tell_moved()
        if now is None and window.placed.obj_id != self._offered:
            self._offer_models()
        mark = window.standing.state.marks().get(window.placed.obj_id)
        own = window_text.symmetry_words(window.model_of(window.placed))
        self._marks.content = f"the model itself: {own}"
        if mark is not None:
            said = window_text.escaped(mark.symmetry)
            self._marks.content = f"marked **{said}** by {window_text.signed(mark)}"

    # --- how --------------------------------------------------------------------------------------

    def _key(self, instance: int) -> tuple[str, int]:
        return self._window.session.place, instance

    def _offer_models(self) -> None:
        """Let the object be what it is, or any other."""
        window = self._window
        names = [_choice(i, m) for i, m in sorted(window.content.models.items())]
        now = _choice(window.placed.obj_id, window.model_of(window.placed))
        self._object.options = tuple(dict.fromkeys((*names, now)))
        self._object.value, self._offered = now, window.placed.obj_id

    def _registered(self, instance: int) -> int:
        return self._window.session.registered.object(instance).obj_id

    def _forget(self, instance: int) -> None:
        key = self._key(instance)
        browser = self._window.browser
        browser.keep_drafts({k: d for k, d in browser.drafts.items() if k != key})

    def _show(self, now: Correction) -> None:
        """Draw the copy of a correction."""
        placed = replace(now.start, T_world_obj=now.T_world_obj)
        model = self._window.session.model(now.obj_id)
        self._copy.show(model, placed, self._axes(placed.T_world_obj))
        self._now = now
        self._tell()

    def _resume(self, draft: Draft) -> None:
        """Go on with a correction that was not saved."""
        window, placed = self._window, self._window.placed
        if draft.registered not in (-1, self._registered(placed.instance)):
            raise InputError(
                f"object {placed.instance} is another one since the scene was registered anew."
            )
        pose = se3.check_rigid(np.reshape(draft.pose, (4, 4)), "the correction that was kept")
        self._show(Correction(start=placed, T_world_obj=pose, obj_id=draft.obj_id, how=draft.how))
        window.photographs.tell()
        if journal.subject_of(placed) != draft.stood:
            self._tell_moved()
        else:
            window.say(f"Your correction of {self._model().name} goes on; it is not saved yet.")

    def _tell_moved(self) -> None:
        """Say that the object stands otherwise than when its correction was begun."""
        window, instance = self._window, self._window.placed.instance
        lines = window.standing.state.of(instance)
        name = window.model_of(window.placed).name
        what = (
            f"{lines[-1].reviewer} has changed {name}" if lines else f"{name} was registered anew"
        )
        window.refuse(
            f"{what} meanwhile. Your copy is kept: Save the pose puts yours in the place of what "
            "stands now, Put back forgets yours."
        )

    def _model(self) -> ObjectModel:
        assert self._now is not None, "the callers have begun"
        return self._window.session.model(self._now.obj_id)

    def _axes(self, T_world_obj: Array) -> Array:
        """Return the axes (3, 3) of the steps and of the gizmo, one a column, in world."""
        frame = FRAMES[self._frame.value]
        if frame == "object":
            return T_world_obj[:3, :3]
        if frame == "camera":
            return self._window.stand.eye()[:3, :3]
        plane = self._window.session.registered.plane
        return np.eye(3) if plane is None else plane.T_world_table[:3, :3]

    def _turned(self) -> None:
        """Other axes were chosen: the gizmo turns to them."""
        with self._window.lock:
            if self._now is not None:
                self._copy.place(self._now.T_world_obj, self._axes(self._now.T_world_obj))

    def _put(self, T: Array, how: str, checks: tuple[tuple[str, float], ...] = ()) -> None:
        assert self._now is not None, "the callers have begun"
        by = self._now.how if how in self._now.how else (*self._now.how, how)
        self._now = replace(self._now, T_world_obj=T, how=by, checks=checks)
        if self.points.is_on:  # they are clicked on the copy as it stood
            self._end_clicks()
            self._window.refuse("The copy has moved: begin the three points anew.")
        self._copy.place(T, self._axes(T))
        self._tell()
        self._window.photographs.tell()

    def _dragged(self, T: Array, is_over: bool) -> None:
        with self._window.lock:
            if self._now is None:
                return
            by = self._now.how if "gizmo" in self._now.how else (*self._now.how, "gizmo")
            self._now = replace(self._now, T_world_obj=T, how=by, checks=())
            self._window.photographs.tell()
            if is_over:
                # The gizmo turns with the object; its axes are those that were chosen.
                self._copy.place(T, self._axes(T))
                self._tell()

    def _pressed(self, label: str, kind: Literal["move", "turn"]) -> None:
        axis: placing.Axis = "x" if label[1] == "x" else "y" if label[1] == "y" else "z"
        self.nudge(axis, 1 if label[0] == "+" else -1, kind)

    def _swapped(self) -> None:
        with self._window.lock:
            now = self.begin()
            obj_id = int(self._object.value.split(" ", 1)[0])
            if obj_id == now.obj_id:
                return
            before, after = self._model(), self._window.session.model(obj_id)
            # The middles meet: models of one thing may have their origins anywhere.
            T = np.array(now.T_world_obj)
            T[:3, 3] += T[:3, :3] @ (placing.middle_of(before.mesh) - placing.middle_of(after.mesh))
            self._show(replace(now, obj_id=obj_id, T_world_obj=T))
            self._put(T, "swap")

    def _asked(self, text: str, with_model: bool) -> None:
        self._copy.see(with_model, False)
        self._text.content = text

    def _by_points(self, fit: placing.PointFit) -> None:
        with self._window.lock:
            self._end_clicks()
            if self._now is not None:
                self._put(fit.T_world_obj, "points")
        self._window.say(fit.words)

    def _click_answer(self, word: str) -> None:
        if word == "Last click back":
            self.points.back()
        elif word == "Shift by one":
            self.points.shift()
        else:
            self._end_clicks()
            self._tell()

    def _end_clicks(self) -> None:
        self.points.end()
        self._clicks.visible = False
        self._copy.see(True, True)

    def _words(self, now: Correction) -> str:
        far = placing.moved(now.start.T_world_obj, now.T_world_obj, self._model().mesh)
        words = f"moved {far.mm:.1f} mm, turned {far.deg:.1f} deg"
        if now.obj_id != now.start.obj_id:
            words = f"it is {self._model().name}; {words}"
        return words

    def _tell(self) -> None:
        now, kept = self._now, dict(self._window.browser.drafts)
        if now is not None and now.how:
            kept[self._key(now.start.instance)] = Draft(
                scene=self._window.session.place, instance=now.start.instance, obj_id=now.obj_id,
                stood=journal.subject_of(now.start), how=now.how,
                registered=self._registered(now.start.instance),
                pose=tuple(now.T_world_obj.ravel().tolist()),
            )  # fmt: skip
        self._window.browser.keep_drafts(kept)
        if self.points.is_on:
            return
        if self._now is None:
            self._text.content = "The object stands as it is in the journal."
            return
        name = window_text.escaped(self._model().name)
        self._text.content = f"**{name}**: {self._words(self._now)}.  \n{WAITING}"


def _choice(obj_id: int, model: ObjectModel) -> str:
    return f"{obj_id} {model.name}"
