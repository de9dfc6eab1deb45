"""The review in the browser: see a registered session, judge every object, sign the decision.

The server only ever appends to review/journal.jsonl; it changes no other file of the session.
"""

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from realsim import local_pages
from realsim.errors import InputError
from realsim.formats.bop.models import load_models
from realsim.records import ObjectPose, Scene
from realsim.review import content, journal
from realsim.review.journal import JOURNAL_FILE
from realsim.review.scene_nodes import GraspFilter, SceneConfig, SceneNodes
from realsim.store import SessionStore, load_grasps, load_scene

ALL_OBJECTS = "all objects"
GOOD_SCORE = 0.5
"""Grasps drawn at first: the good ones; all of them hide the objects."""
DECIDED = {"accept": "accepted", "reject": "rejected"}


@dataclass(frozen=True, eq=False, slots=True)
class _Card:
    """The panel of one object."""

    folder: viser.GuiFolderHandle
    text: viser.GuiMarkdownHandle
    comment: viser.GuiInputHandle[str]


class ReviewServer:
    """One session's review; `start` returns at once, the server runs in its own threads."""

    def __init__(
        self,
        store: SessionStore,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        config: SceneConfig | None = None,
    ) -> None:
        """Read what is shown; nothing listens yet.

        Args:
            store: a registered session.
            host: a loopback address; there is no login.
            port: where to listen; the next free one is taken if it is in use, 0 = any.
            config: how much is shown.

        Raises:
            InputError: the host is reachable from other machines, the session is not registered,
                or a model is missing.
        """
        self._host = local_pages.check_host(host, "the review")
        self._port = port
        self._config = config or SceneConfig()
        self.store = store
        self.scene: Scene = load_scene(store)
        self.models = load_models(store.folder / "models")
        missing = sorted({o.obj_id for o in self.scene.objects} - set(self.models))
        if missing:
            raise InputError(
                f"the scene holds objects {missing}, but {store.folder / 'models'} has no model "
                "of them; copy the models there."
            )
        instances = {o.instance for o in self.scene.objects}
        self.grasp_sets = [g for g in load_grasps(store) if g.instance in instances]
        self._server: viser.ViserServer | None = None
        self._nodes: SceneNodes | None = None
        self._cards: dict[int, _Card] = {}
        self._filter = GraspFilter(min_score=GOOD_SCORE)

    # --- decisions: what the buttons call -----------------------------------------------------

    @property
    def state(self) -> journal.ReviewState:
        """The replay of the journal as it stands on disk now."""
        return journal.replay(journal.read(self.store.path(JOURNAL_FILE)).entries)

    def accept(self, instance: int, reviewer: str, comment: str = "") -> journal.Entry:
        """Append: this object, as it stands now, is right."""
        return self._append("accept", instance, reviewer, comment)

    def reject(self, instance: int, reviewer: str, comment: str = "") -> journal.Entry:
        """Append: this object, as it stands now, is wrong."""
        return self._append("reject", instance, reviewer, comment)

    def comment(self, instance: int, reviewer: str, comment: str) -> journal.Entry:
        """Append a remark that decides nothing."""
        return self._append("comment", instance, reviewer, comment)

    def undo(self, instance: int, reviewer: str) -> journal.Entry:
        """Append: the last standing line on this object is taken back.

        Raises:
            InputError: there is none.
        """
        lines = [e for e in self.state.standing if e.instance == instance]
        if not lines:
            raise InputError(f"nothing is decided about instance {instance}; nothing to undo.")
        return self._append("undo", instance, reviewer, undoes=lines[-1].id)

    def _append(
        self,
        action: journal.Action,
        instance: int,
        reviewer: str,
        comment: str = "",
        undoes: str = "",
    ) -> journal.Entry:
        placed = self.scene.object(instance)
        entry = journal.new_entry(action, placed, reviewer, comment=comment, undoes=undoes)
        journal.append(self.store.path(JOURNAL_FILE), entry)
        self.refresh()
        return entry

    # --- running ------------------------------------------------------------------------------

    @property
    def url(self) -> str:
        """The address to open in a browser.

        Raises:
            InputError: the server is not started.
        """
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self._running().get_port()}"

    def _running(self) -> viser.ViserServer:
        if self._server is None:
            raise InputError("the review server is not running; call start() first.")
        return self._server

    def start(self) -> None:
        """Listen, and build the scene and the panel; returns when both are there."""
        if self._server is not None:
            return
        # Viser prints a banner with its address; the caller says what is to be said.
        with local_pages.local_origins_only(), contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(
                host=self._host, port=self._port, label="realsim review", verbose=False
            )
        local_pages.refuse_share(server)
        self._server = server
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._build_scene(server)
        self._build_panel(server)
        self.filter_grasps(self._filter)
        server.on_client_connect(lambda client: self.refresh())
        self.refresh()

    def stop(self) -> None:
        """Stop listening; the journal stays."""
        if self._server is not None:
            with contextlib.redirect_stdout(io.StringIO()):
                self._server.stop()
            self._server, self._nodes = None, None
            self._cards = {}

    # --- what is shown ------------------------------------------------------------------------

    def _build_scene(self, server: viser.ViserServer) -> None:
        config, nodes = self._config, SceneNodes(server, self._config)
        views = content.placed_views(self.store)
        with_depth = [v for v in views if self.store.has_depth(v.index)]
        fused = content.spread(with_depth, config.most_fused_views)
        nodes.add_objects(self.scene.objects, self.models)
        region = content.region_of(self.scene.objects, views, config.margin_m)
        points, colors = content.fused_cloud(
            self.store, fused, config.voxel_m, config.most_points, region
        )
        nodes.add_cloud(points, colors)
        nodes.add_cameras(self.store, content.spread(views, config.most_cameras))
        if self.scene.plane is not None:
            nodes.add_table(self.scene.plane)
        nodes.show_objects(True, by_verdict=False)
        self._nodes = nodes
        # World is a camera where a data set has no robot: up is the table's normal, not z.
        plane = self.scene.plane
        up = np.array([0.0, 0.0, 1.0]) if plane is None else plane.T_world_table[:3, 2]
        server.scene.set_up_direction(up)
        position, target = content.first_look(region, views, up)
        server.initial_camera.up = tuple(up)
        server.initial_camera.position = tuple(position)
        server.initial_camera.look_at = tuple(target)

    def _build_panel(self, server: viser.ViserServer) -> None:
        gui = server.gui
        self._header = gui.add_markdown("")
        self._reviewer = gui.add_text("Your name", "", hint="Decisions are signed.")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Objects"):
            for k, placed in enumerate(content.worst_first(self.scene.objects)):
                self._cards[placed.instance] = self._add_card(gui, placed, expand=k == 0)
        with tabs.add_tab("View"):
            self._add_switches(gui)
        self._message = gui.add_markdown("")

    def _add_card(self, gui: viser.GuiApi, placed: ObjectPose, expand: bool) -> _Card:
        """Add the panel of one object with its buttons."""
        i = placed.instance
        folder = gui.add_folder(self._title(placed), expand_by_default=expand)
        with folder:
            text = gui.add_markdown("")
            comment = gui.add_text("Comment", "")
            buttons = gui.add_button_group("Decide", ("Accept", "Reject", "Comment", "Undo"))
        card = _Card(folder, text, comment)
        actions: dict[str, Callable[[], journal.Entry]] = {
            "Accept": lambda: self.accept(i, self._reviewer.value, comment.value),
            "Reject": lambda: self.reject(i, self._reviewer.value, comment.value),
            "Comment": lambda: self.comment(i, self._reviewer.value, comment.value),
            "Undo": lambda: self.undo(i, self._reviewer.value),
        }
        buttons.on_click(lambda event: self._press(actions[buttons.value], card))
        return card

    def _press(self, action: Callable[[], journal.Entry], card: _Card) -> None:
        """Do what a button says; bad input is told in the panel."""
        try:
            entry = action()
        except InputError as error:
            self._message.content = f"**Not recorded:** {error}"
            return
        card.comment.value = ""
        self._message.content = f"Recorded: {entry.action} by {entry.reviewer}, {entry.time}."

    def _add_switches(self, gui: viser.GuiApi) -> None:
        """Add what is shown and which grasps."""
        meshes = gui.add_checkbox("Objects", True)
        verdicts = gui.add_checkbox("Colour by verdict", False)
        cloud = gui.add_checkbox("Measured points", True)
        cameras = gui.add_checkbox("Cameras", True, hint="Click one to look through it.")
        table = gui.add_checkbox("Table", True)
        names = {self._title(o): o.instance for o in self.scene.objects}
        with gui.add_folder("Grasps"):
            grasps = gui.add_checkbox("Show", True)
            score = gui.add_slider("Least score", 0.0, 1.0, 0.05, GOOD_SCORE)
            reachable = gui.add_checkbox("Reachable only", False)
            which = gui.add_dropdown("Of", (ALL_OBJECTS, *names), initial_value=ALL_OBJECTS)
            self._drawn = gui.add_markdown("")

        def redraw(_: Any) -> None:
            nodes = self._nodes
            if nodes is not None:
                nodes.show_objects(meshes.value, verdicts.value)
                nodes.show_cloud(cloud.value)
                nodes.show_cameras(cameras.value)
                nodes.show_table(table.value)

        def redraw_grasps(_: Any) -> None:
            self.filter_grasps(
                GraspFilter(
                    min_score=float(score.value),
                    reachable_only=reachable.value,
                    instance=names.get(which.value),
                    show=grasps.value,
                )
            )

        for switch in (meshes, verdicts, cloud, cameras, table):
            switch.on_update(redraw)
        for control in (grasps, score, reachable, which):
            control.on_update(redraw_grasps)

    def filter_grasps(self, chosen: GraspFilter) -> int:
        """Draw the grasps that pass the filter, and return how many are drawn."""
        self._filter = chosen
        if self._nodes is None:
            return 0
        drawn = self._nodes.draw_grasps(self.scene.objects, self.grasp_sets, chosen)
        self._drawn.content = f"{drawn} of {sum(len(g) for g in self.grasp_sets)} grasps drawn"
        return drawn

    def refresh(self) -> None:
        """Show the journal as it stands on disk: another server may have added to it."""
        if self._nodes is None or not self._cards:
            return
        found = journal.read(self.store.path(JOURNAL_FILE))
        state = journal.replay(found.entries)
        judged = journal.reviewed_scene(self.scene, state)
        decided = 0
        for placed in judged.objects:
            decision = state.decision(placed.instance, journal.subject_of(placed))
            decided += decision is not None
            card = self._cards[placed.instance]
            card.text.content = self._card_text(placed, state)
            card.folder.label = self._title(placed)
            self._nodes.color_object(placed.instance, placed.verdict)
        lines = [
            f"**{self.store.session.name}**: {decided} of {len(judged.objects)} objects judged"
        ]
        if found.damaged:
            lines.append(f"{len(found.damaged)} damaged journal line(s), left as they are")
        self._header.content = "  \n".join(lines)

    def _title(self, placed: ObjectPose) -> str:
        name = self.models[placed.obj_id].name
        return f"{placed.instance} {name}: {placed.verdict}"

    def _card_text(self, placed: ObjectPose, state: journal.ReviewState) -> str:
        """Return the panel text of one object: checks, reasons, decision, comments."""
        computed = self.scene.object(placed.instance)
        lines = [f"computed: **{computed.verdict}**"]
        lines += [f"- {reason}" for reason in computed.reasons]
        decision = state.decision(placed.instance, journal.subject_of(placed))
        if decision is not None:
            word = DECIDED[decision.action]
            lines.append(f"\n**{word}** by {decision.reviewer}, {decision.time[:16]}")
        for remark in state.comments(placed.instance):
            lines.append(f"> {remark.reviewer}: {remark.comment}\n")
        if placed.checks:
            lines.append("\n| check | value |\n|:--|--:|")
            lines += [f"| {name} | {value:.4g} |" for name, value in placed.checks.items()]
        return "\n".join(lines)
