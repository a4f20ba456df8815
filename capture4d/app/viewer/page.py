"""The page in the browser, by viser: the picture of a frame, and everything that chooses which."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from capture4d.app.viewer.clock import Clock
from capture4d.app.viewer.figures import FIGURES
from capture4d.app.viewer.panels import (
    ALL,
    FLAGGED,
    curve_rows,
    frame_line,
    frame_options,
    frames_with,
    legend,
    verdict_strip,
)
from capture4d.app.viewer.presenter import Picture, Presenter
from capture4d.app.viewer.scenery import set_scene
from capture4d.app.viewer.surfaces import Dots
from capture4d.app.viewer.take import SCAN
from capture4d.app.viewer.timeline import OPEN, curve_names
from capture4d.errors import InputError

__all__ = ["ViewerPage"]

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
MOST_SHOWN_HZ = 30.0
"""Frames a second that are sent at most."""
AHEAD = 3
"""Frames that are made ready while a take is played."""
CURVE_EVERY_S = 0.25
"""The mark in a curve follows no faster than this while a take is played."""
POINT_M = 0.004
LINES = ("#2f62c9", "#d9772b")


class ViewerPage:
    """The controls, and the thread that shows what they ask for.

    Args:
        server: a `viser.ViserServer`; untyped, for viser may be absent.
    """

    def __init__(self, server: Any, presenter: Presenter, *, look_every_s: float) -> None:
        self._server, self._presenter, self._every_s = server, presenter, look_every_s
        self._choice = presenter.first_choice()
        self._frame_ids = presenter.frame_ids
        self._frame = self._frame_ids[0]
        self._clock: Clock | None = None
        self._wake, self._closed, self._stale = threading.Condition(), False, True
        self._sending = False
        self._shown_seconds: list[float] = []
        self._handles: dict[tuple[int, str], Any] = {}
        self._marked_s = 0.0
        self._offsets = presenter.offsets_m()
        boxes = [presenter.box(number) for number in range(len(presenter.takes))]
        moved = np.stack([box + np.array([offset, 0.0, 0.0]) for box, offset in zip(boxes, self._offsets, strict=True)])
        set_scene(server, np.stack([moved[:, 0].min(axis=0), moved[:, 1].max(axis=0)]))
        self._add_controls()
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._show_forever, self._look_forever)]
        for thread in self._threads:
            thread.start()

    @property
    def frame(self) -> int:
        """The frame that is shown, or about to be."""
        return self._frame

    @property
    def seconds(self) -> Sequence[float]:
        """How long each of the last frames took from being asked for until it was handed to the network."""
        return self._shown_seconds

    def close(self) -> None:
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        for thread in self._threads:
            thread.join(timeout=10)

    def wait_until_shown(self, timeout_s: float = 30.0) -> bool:
        """Whether all that was asked for has been sent by then."""
        ends = time.monotonic() + timeout_s
        while time.monotonic() < ends:
            with self._wake:
                if not self._stale and not self._sending:
                    return True
            time.sleep(0.005)
        return False

    # --- what the user does --------------------------------------------------------------------------------------

    def go_to(self, frame_id: int) -> None:
        """Show the frame that is nearest to a number."""
        ids = np.array(self._frame_ids)
        self._ask(frame=int(ids[np.argmin(np.abs(ids - frame_id))]))

    def step(self, count: int, among: Sequence[int] | None = None) -> None:
        """Go so many frames on, of all or of some."""
        ids = list(self._frame_ids if among is None else among)
        if ids:
            row = int(np.searchsorted(ids, self._frame, side="left" if count < 0 else "right"))
            self._ask(frame=ids[(row + (count if count < 0 else count - 1)) % len(ids)])

    def play(self, speed: float) -> None:
        """Play from the frame that is shown; 0 stops."""
        fps = self._presenter.takes[0].fps
        with self._wake:
            started = Clock(self._frame_ids, fps, speed, self._frame, time.monotonic())
            self._clock = started if speed else None
            self._wake.notify_all()

    def choose(self, **changes: Any) -> None:
        """Show other layers, or other colours: what a `Choice` holds."""
        with self._wake:
            self._choice = replace(self._choice, **changes)
        self._ask()

    def _ask(self, frame: int | None = None) -> None:
        with self._wake:
            if frame is not None:
                self._frame = frame
                if self._clock is not None:
                    self._clock = replace(self._clock, from_frame=frame, started_s=time.monotonic())
            self._stale = True
            self._wake.notify_all()

    # --- threads -------------------------------------------------------------------------------------------------

    def _show_forever(self) -> None:
        last_s = 0.0
        while True:
            with self._wake:
                while not (self._stale or self._clock or self._closed):
                    self._wake.wait()
                if self._closed:
                    return
                clock, choice = self._clock, self._choice
                if clock is not None:
                    due = clock.frame(time.monotonic())
                    if due == self._frame and not self._stale:
                        self._wake.wait(timeout=1 / MOST_SHOWN_HZ / 2)
                        continue
                    self._frame = due
                frame, self._stale, self._sending = self._frame, False, True
            begun = time.monotonic()
            self._send(self._presenter.picture(frame, choice))
            self._sending = False
            self._shown_seconds = [*self._shown_seconds[-99:], time.monotonic() - begun]
            if clock is not None:
                for ahead in clock.next_frames(frame, AHEAD):
                    if time.monotonic() - last_s > 1 / MOST_SHOWN_HZ and clock.frame(time.monotonic()) != frame:
                        break
                    self._presenter.picture(ahead, choice)
                last_s = time.monotonic()
                time.sleep(max(0.0, 1 / MOST_SHOWN_HZ - (time.monotonic() - begun)))

    def _look_forever(self) -> None:
        """Look for new frames until the page is closed."""
        while True:
            with self._wake:
                if self._wake.wait_for(lambda: self._closed, timeout=self._every_s):
                    return
            try:
                if self._presenter.look():
                    self._renew()
            except (InputError, OSError) as error:  # a folder that is gone, or is being replaced
                self._faults.content = f"⚠ {error}"

    # --- what is sent --------------------------------------------------------------------------------------------

    def _send(self, picture: Picture) -> None:
        with self._server.atomic():
            for key, handle in self._handles.items():
                if picture.payloads.get(key) is None:
                    handle.visible = False
            for key, payload in picture.payloads.items():
                if payload is not None:
                    self._send_layer(key, payload)
        self._slider.value = picture.frame_id
        self._told.content = self._line(picture.frame_id)
        self._faults.content = "  \n".join(f"⚠ {fault}" for fault in picture.faults)
        if self._clock is None or time.monotonic() - self._marked_s > CURVE_EVERY_S:
            self._marked_s = time.monotonic()
            self._mark()

    def _send_layer(self, key: tuple[int, str], payload: bytes | Dots) -> None:
        number, layer = key
        handle = self._handles.get(key)
        name, place = f"/take {number}/{layer}", (self._offsets[number], 0.0, 0.0)
        kind = "glb" if isinstance(payload, bytes) else "dots"
        if handle is not None and getattr(handle, "_capture4d_kind", kind) == kind:
            if isinstance(payload, bytes):
                handle.glb_data = payload
            else:
                handle.points, handle.colors = payload.points, payload.colours
            handle.visible = True
            return
        scene = self._server.scene
        if isinstance(payload, bytes):
            handle = scene.add_glb(name, payload, position=place, cast_shadow=False, receive_shadow=False)
        else:
            handle = scene.add_point_cloud(
                name, payload.points, payload.colours, point_size=POINT_M, precision="float32", position=place
            )
        self._handles[key] = handle

    # --- the page ------------------------------------------------------------------------------------------------

    def _add_controls(self) -> None:
        gui, presenter = self._server.gui, self._presenter
        names = [take.name for take in presenter.takes]
        gui.set_panel_label(" beside ".join(names))
        with gui.add_folder("time"):
            self._add_time(gui)
        tabs = gui.add_tab_group()
        with tabs.add_tab("layers"):
            self._boxes: dict[str, Any] = {}
            self._layers_folder = gui.add_folder(None)
            self._add_layers()
            with gui.add_folder("colours"):
                self._add_colours(gui)
        with tabs.add_tab("frames"):
            self._add_frame_list(gui)
        with tabs.add_tab("curves"):
            self._add_curves(gui)
        self._faults = gui.add_markdown("")
        self._notes = gui.add_markdown(self._all_notes())

    def _add_time(self, gui: Any) -> None:
        first, last = self._frame_ids[0], self._frame_ids[-1]
        self._slider = gui.add_slider("frame", min=first, max=max(last, first + 1), step=1, initial_value=self._frame)
        self._strip = gui.add_html(verdict_strip(self._timelines, self._frame_ids))
        self._told = gui.add_markdown(self._line(self._frame))
        self._play = gui.add_checkbox("play", False)
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._steps = gui.add_button_group("step", ("◀", "▶", "◀ flagged", "flagged ▶"))

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # not what was set here
                self.go_to(int(self._slider.value))

        @self._play.on_update
        @self._speed.on_update
        def _(event: Any) -> None:
            self.play(float(self._speed.value) if self._play.value else 0.0)

        @self._steps.on_click
        def _(event: Any) -> None:
            pressed = self._steps.value
            among = frames_with(self._timelines[0], FLAGGED) if "flagged" in pressed else None
            self.step(-1 if "◀" in pressed else 1, among)

    def _add_frame_list(self, gui: Any) -> None:
        self._wanted = gui.add_dropdown("which", (FLAGGED, "failed", "check", "good", OPEN, ALL))
        self._list = gui.add_dropdown("go to", ("–",))
        self._fill_list()

        @self._wanted.on_update
        def _(event: Any) -> None:
            self._fill_list()

        @self._list.on_update
        def _(event: Any) -> None:
            number = self._list.value.partition(":")[0]
            if event.client is not None and number.isdecimal():
                self.go_to(int(number))

    def _fill_list(self) -> None:
        timeline = self._timelines[0]
        lines = frame_options(timeline, frames_with(timeline, self._wanted.value), self._frame)
        self._list.options = ("–", *lines)

    def _add_layers(self) -> None:
        with self._layers_folder:
            for layer in self._presenter.layers:
                if layer not in self._boxes:
                    box = self._server.gui.add_checkbox(layer, layer in self._choice.layers)
                    box.on_update(lambda _: self._choose_layers())
                    self._boxes[layer] = box
                    if layer == SCAN:
                        self._full = self._server.gui.add_checkbox("scan in full", False)
                        self._full.on_update(lambda _: self.choose(full=self._full.value))

    def _choose_layers(self) -> None:
        self.choose(layers=frozenset(layer for layer, box in self._boxes.items() if box.value))

    def _add_colours(self, gui: Any) -> None:
        paints = self._presenter.paints or ("plain",)
        first = self._choice.paint if self._choice.paint in paints else paints[0]
        self._paint = gui.add_dropdown("registration", paints, initial_value=first)
        self._high = gui.add_number("colours end at", self._choice.high, min=0.01, step=0.1)
        self._legend = gui.add_html(legend(self._choice))

        @self._paint.on_update
        def _(event: Any) -> None:
            paint = self._paint.value
            high = FIGURES[paint].high if paint in FIGURES else self._choice.high
            self.choose(paint=paint, high=high)
            self._high.value = high
            self._legend.content = legend(self._choice)

        @self._high.on_update
        def _(event: Any) -> None:
            low = FIGURES[self._choice.paint].low if self._choice.paint in FIGURES else 0.0
            if event.client is not None and self._high.value > low:
                self.choose(high=float(self._high.value))
                self._legend.content = legend(self._choice)

    def _add_curves(self, gui: Any) -> None:
        from viser import uplot

        self._measure = gui.add_dropdown("measure", self._measures())
        series = [uplot.Series(label="frame")]
        series += [
            uplot.Series(label=take.name, stroke=colour, width=1.5)
            for take, colour in zip(self._presenter.takes, LINES, strict=False)
        ]
        series.append(uplot.Series(label="now", stroke="#111111", width=0, points={"show": True, "size": 9}))
        self._rows: list[np.ndarray] = []
        self._plot = gui.add_uplot(
            self._curve_data(), tuple(series), scales=self._scales(), aspect=1.6,
            legend=uplot.Legend(show=len(self._presenter.takes) > 1),
        )  # fmt: skip

        @self._measure.on_update
        def _(event: Any) -> None:
            self._draw_curves()

    def _draw_curves(self) -> None:
        data = self._curve_data()
        self._plot.scales = self._scales()
        self._plot.data = data

    def _scales(self) -> dict[str, Any]:
        """Said, for uPlot finds none among numbers that are not known."""
        values = np.concatenate(self._rows[1:])
        known = values[np.isfinite(values)]
        low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
        room = 0.05 * (high - low) or 0.05 * abs(high) or 0.5
        ids = self._rows[0]
        first, last = float(ids[0]), float(max(ids[-1], ids[0] + 1))
        return {"x": {"time": False, "range": (first, last)}, "y": {"range": (low - room, high + room)}}

    def _measures(self) -> tuple[str, ...]:
        found = (name for timeline in self._timelines for name in curve_names(timeline))
        return tuple(dict.fromkeys(found)) or ("nothing measured",)

    def _curve_data(self) -> tuple[np.ndarray, ...]:
        self._rows = curve_rows(self._timelines, self._frame_ids, self._measure.value)
        return self._with_mark()

    def _with_mark(self) -> tuple[np.ndarray, ...]:
        """The curves, and the frame that is shown on the first that is known there."""
        ids, *rows = self._rows
        mark = np.full(len(ids), math.nan)
        at = int(np.argmin(np.abs(ids - self._frame)))
        known = [row[at] for row in rows if math.isfinite(row[at])]
        if known:
            mark[at] = known[0]
        return ids, *rows, mark

    def _mark(self) -> None:
        self._plot.data = self._with_mark()

    def _renew(self) -> None:
        """What has been written since goes into the controls, and the frame is shown as it is now."""
        self._frame_ids = self._presenter.frame_ids
        self._slider.min, self._slider.max = self._frame_ids[0], max(self._frame_ids[-1], self._frame_ids[0] + 1)
        self._strip.content = verdict_strip(self._timelines, self._frame_ids)
        had = {*self._boxes}
        self._add_layers()
        paints = self._presenter.paints
        if paints and self._paint.options != paints:
            self._paint.options = paints
        if not had & {"registration"} and "registration" in self._boxes:  # it has just begun
            self._boxes["registration"].value = True
            self.choose(paint=self._paint.value)
        measures = self._measures()
        if self._measure.options != measures:
            self._measure.options = measures
        self._fill_list()
        self._notes.content = self._all_notes()
        self._draw_curves()
        if self._clock is not None:
            with self._wake:
                self._clock = replace(self._clock, frame_ids=self._frame_ids)
        self._ask()

    @property
    def _timelines(self) -> list[Any]:
        return [take.timeline for take in self._presenter.takes]

    def _line(self, frame_id: int) -> str:
        return frame_line([take.name for take in self._presenter.takes], self._timelines, frame_id)

    def _all_notes(self) -> str:
        return "  \n".join(f"{take.name}: {note}" for take in self._presenter.takes for note in take.notes)
