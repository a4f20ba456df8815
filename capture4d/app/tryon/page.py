"""The page in the browser, by viser: sliders of the pose, of the person and of the style, clips, and the garment."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.app.drawing.palette import SKIN
from capture4d.app.tryon.config import TryOnConfig
from capture4d.app.tryon.session import CLOTH, LiveFrame, Session
from capture4d.app.tryon.sliders import PoseSlider
from capture4d.app.viewer.scenery import set_scene
from capture4d.app.viewer.surfaces import surface_glb
from capture4d.errors import InputError

__all__ = ["TryOnPage"]

SLIDERS = "sliders"
TOLD_EVERY_S = 0.5
"""Between two texts about how fast it is."""


class TryOnPage:
    """The controls, and the thread in which everything is computed.

    Args:
        server: a `viser.ViserServer`; untyped, for viser may be absent.
        clips: motion files to choose from.
        exports: folder in which animations are written, one after the other.
    """

    def __init__(
        self, server: Any, session: Session, clips: Sequence[Path], exports: Path, config: TryOnConfig
    ) -> None:
        self._server, self._session, self._config = server, session, config
        self._clips, self._exports = {path.name: path for path in clips}, exports
        self._wake, self._closed = threading.Condition(), False
        self._changed, self._dress, self._clip, self._export = True, False, False, False
        self._rested = False
        self._row = 0
        self._speeds: list[float] = []
        self._told_s = 0.0
        first = session.resting()
        set_scene(server, np.stack([first.skin.min(axis=0), first.skin.max(axis=0)]))
        faces = session.tried.garment.template.faces
        scene = server.scene
        plain = {"cast_shadow": False, "receive_shadow": False}
        self._cloth = scene.add_mesh_simple(
            "/garment", first.vertices.astype(np.float32), faces, color=CLOTH, side="double", **plain
        )
        self._body = scene.add_mesh_simple(
            "/body", first.skin.astype(np.float32), session.tried.body.template.faces, color=SKIN, **plain
        )
        self._mapped: Any = None
        self._add_controls()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    @property
    def is_resting(self) -> bool:
        """Whether what is shown is the exact removal."""
        return self._rested

    @property
    def moving_hz(self) -> float:
        """Frames a second while it moved, of the last second or so."""
        return len(self._speeds) / sum(self._speeds) if self._speeds else 0.0

    def close(self) -> None:
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        self._thread.join(timeout=30)

    # --- controls ------------------------------------------------------------------------------------------------

    def _add_controls(self) -> None:
        gui, session = self._server.gui, self._session
        gui.set_panel_label(session.tried.path.resolve().name)
        self._said = gui.add_markdown("")
        with gui.add_folder("motion"):
            self._motion = gui.add_dropdown("moved by", (SLIDERS, *self._clips))
            self._frame = gui.add_slider("frame", min=0, max=1, step=1, initial_value=0, disabled=True)
            self._play = gui.add_checkbox("play", False, disabled=True)
        tabs = gui.add_tab_group()
        with tabs.add_tab("pose"):
            self._turns = self._add_turns(gui)
        with tabs.add_tab("person and style"):
            self._betas = [
                gui.add_slider(f"shape {number + 1}", min=low, max=high, step=0.01, initial_value=session.beta[number])
                for number, (low, high) in enumerate(session.tried.shape_ranges)
                if low < high
            ]
            self._varies = [low < high for low, high in session.tried.shape_ranges]
            self._styles = {
                name: gui.add_slider(
                    name, min=low, max=high, step=(high - low) / 200, initial_value=session.style[name]
                )
                for name, (low, high) in session.tried.style_ranges.items()
            }
        self._show_body = gui.add_checkbox("body", True)
        self._wrinkled = gui.add_checkbox("wrinkles", True, visible=session.has_wrinkles)
        self._button = gui.add_button("export this")
        self._written = gui.add_markdown("")
        for slider in (*self._betas, *self._styles.values()):
            slider.on_update(lambda _: self._wanted("_dress"))
        self._motion.on_update(lambda _: self._wanted("_clip"))
        self._wrinkled.on_update(lambda _: self._wanted("_changed"))
        self._button.on_click(lambda _: self._wanted("_export"))
        self._show_body.on_update(lambda _: setattr(self._body, "visible", self._show_body.value))
        self._play.on_update(lambda _: self._wanted("_changed"))

        @self._frame.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # not what was set here
                self._row = int(self._frame.value)
                self._wanted("_changed")

    def _add_turns(self, gui: Any) -> dict[str, Any]:
        found = {}
        for slider in self._session.sliders.sliders:
            found[slider.name] = gui.add_slider(
                slider.name, min=slider.low, max=slider.high, step=0.5, initial_value=0.0
            )
            found[slider.name].on_update(lambda event: self._turned(event))
        back = gui.add_button("rest pose")

        @back.on_click
        def _(event: Any) -> None:
            for each in found.values():
                each.value = 0.0
            self._wanted("_changed")

        return found

    def _turned(self, event: Any) -> None:
        if event.client is not None and self._session.clip is None:
            self._wanted("_changed")

    def _wanted(self, what: str) -> None:
        with self._wake:
            setattr(self, what, True)
            self._wake.notify_all()

    # --- the thread ----------------------------------------------------------------------------------------------

    def _live(self) -> None:
        moved_s = time.monotonic()
        while True:
            with self._wake:
                if not self._rested or self._playing:
                    waits = 0.0 if self._is_asked or self._playing else self._config.rest_after_s / 4
                    self._wake.wait_for(lambda: self._is_asked or self._closed, timeout=waits)
                else:
                    self._wake.wait_for(lambda: self._is_asked or self._playing or self._closed)
                if self._closed:
                    return
                changed, dress, clip, export = self._changed, self._dress, self._clip, self._export
                self._changed = self._dress = self._clip = self._export = False
            try:
                if clip:
                    self._take_clip()
                if dress:
                    self._session.dress(self._wanted_shape(), {name: each.value for name, each in self._styles.items()})
                if export:
                    self._write()
                if changed or dress or clip or self._playing:
                    moved_s = time.monotonic()
                    self._move()
                elif not self._rested and time.monotonic() - moved_s >= self._config.rest_after_s:
                    self._rest()
            except InputError as error:
                self._said.content = f"⚠ {error}"
                self._rested = True

    @property
    def _is_asked(self) -> bool:
        return self._changed or self._dress or self._clip or self._export

    @property
    def _playing(self) -> bool:
        return self._session.clip is not None and bool(self._play.value)

    def _wanted_shape(self) -> list[float]:
        beta, sliders = [*self._session.beta], iter(self._betas)
        for number, varies in enumerate(self._varies):
            if varies:
                beta[number] = float(next(sliders).value)
        return beta

    def _take_clip(self) -> None:
        name = self._motion.value
        count = self._session.play(self._clips.get(name))
        self._row = 0
        self._frame.max, self._frame.disabled, self._play.disabled = max(count - 1, 1), count < 2, count < 2
        self._frame.value = 0
        if not count:
            self._play.value = False

    def _move(self) -> None:
        begun = time.monotonic()
        session = self._session
        if session.clip is None:
            session.pose({slider.name: self._degrees(slider) for slider in session.sliders.sliders})
            frame = session.moving()
        else:
            if self._playing:
                self._row = (self._row + 1) % len(session.clip.frame_ids)
                self._frame.value = self._row
            frame = session.moving(min(self._row, len(session.clip.frame_ids) - 1))
        self._send(frame)
        self._rested = False
        took = time.monotonic() - begun
        self._speeds = [*self._speeds[-29:], took]
        if time.monotonic() - self._told_s > TOLD_EVERY_S:
            self._told_s = time.monotonic()
            self._said.content = f"moving: {self.moving_hz:.0f} frames a second"
        slowest = self._config.most_hz if session.clip is None else min(self._config.most_hz, session.clip.fps)
        time.sleep(max(0.0, 1 / slowest - took))

    def _degrees(self, slider: PoseSlider) -> float:
        """Within its range, which numbers that are typed may leave."""
        return min(max(float(self._turns[slider.name].value), slider.low), slider.high)

    def _rest(self) -> None:
        frame = self._session.resting(self._row)
        self._send(frame)
        self._rested = True
        assert frame.inside is not None
        inside, unlike = frame.inside, self._session.unlike_deg(self._row)
        self._said.content = (
            f"at rest: {inside.inside_percent:.2f} % inside the body, {inside.depth_max_mm:.1f} mm at most; "
            f"pose {unlike:.0f}° from the nearest that was learned"
        )

    def _send(self, frame: LiveFrame) -> None:
        mapped = frame.mapped if self._wrinkled.value else None
        with self._server.atomic():
            self._body.vertices = frame.skin.astype(np.float32)
            if mapped is not None:
                data = surface_glb(mapped)
                if self._mapped is None:
                    self._mapped = self._server.scene.add_glb("/wrinkled", data, cast_shadow=False)
                else:
                    self._mapped.glb_data = data
            else:
                self._cloth.vertices = frame.vertices.astype(np.float32)
            self._cloth.visible = mapped is None
            if self._mapped is not None:
                self._mapped.visible = mapped is not None

    def _write(self) -> None:
        self._button.disabled = True
        try:
            number = 1
            while (folder := self._exports / f"{number:03d}").exists():
                number += 1
            self._written.content = f"writing {folder} …"
            result = self._session.export(folder)
            self._written.content = f"{result.frames} frames in {folder}; `capture4d export {folder}` hands them on"
        except (InputError, OSError) as error:
            self._written.content = f"⚠ {error}"
        finally:
            self._button.disabled = False
