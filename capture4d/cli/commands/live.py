"""`capture4d view` and `tryon`: pages that are open until they are ended."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from capture4d.app.tryon.config import TryOnConfig
from capture4d.app.viewer.config import ViewConfig
from capture4d.cli.exit_codes import GOOD
from capture4d.cli.options import MeshOptions, ProgressOptions, all_cores
from capture4d.settings import Count, Range

__all__ = ["TryOn", "View"]

Port = Annotated[int, Range(least=1, most=65535)]


@dataclass(frozen=True, kw_only=True)
class _Page:
    """Of commands that are a page in the browser."""

    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 lets everybody in who reaches this machine, without a password."""
    port: Port = 8080
    """Port to listen at, or the next that is free."""

    def served(self, title: str, add: Callable[[Any], Any]) -> int:
        """Keep a page open until the command is interrupted.

        Args:
            add: puts the page onto a server; what it returns is closed at the end.
        """
        import threading

        from capture4d.app.viewer.scenery import open_server

        server = open_server(self.host, self.port, title)
        page = None
        try:
            page = add(server)
            print(f"page: http://{self.host}:{server.get_port()} (Ctrl-C ends it)", flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                threading.Event().wait()
        finally:
            if page is not None:
                page.close()
            server.stop()
        return GOOD


@dataclass(frozen=True, kw_only=True)
class View(_Page, MeshOptions, ProgressOptions):
    """Look through a take or an animation in the browser, also while a run is going on: scans, registration, body."""

    folder: Annotated[Positional[Path], arg(metavar="WORK|CAPTURE")]
    """Work folder, finished or not, or a capture that nothing was made of yet."""
    beside: Path | None = None
    """Another one, that is shown beside it, frame by frame."""
    prepare: bool = False
    """Make the previews of all scans first; otherwise each is made when its frame is first looked at."""
    workers: Count = field(default_factory=all_cores)
    """Processes that make previews."""
    config: Annotated[ViewConfig, arg(name="")] = field(default_factory=ViewConfig)

    def __call__(self) -> int:
        from capture4d.app.viewer.previews import prepare
        from capture4d.app.viewer.take import open_take
        from capture4d.files.optional_packages import VISER, require_package

        require_package(VISER)
        places = [self.folder] if self.beside is None else [self.folder, self.beside]
        takes = [open_take(place, self.config) for place in places]
        if self.prepare:
            for take in takes:
                if take.capture is not None:
                    prepare(take.capture, take.previews, self.config.preview_mm, workers=self.workers)

        def add(server: Any) -> Any:
            from capture4d.app.viewer.page import ViewerPage
            from capture4d.app.viewer.presenter import Presenter

            presenter = Presenter(takes, self.config.memory_mb)
            return ViewerPage(server, presenter, look_every_s=self.config.look_every_s)

        return self.served(takes[0].name, add)


@dataclass(frozen=True, kw_only=True)
class TryOn(_Page):
    """Try a learned garment on in the browser: a person of any shape, posed with sliders or by clips, live."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """What `fit` wrote: WORK, or WORK/retarget; or the folder that `fit-styles` wrote."""
    poses: tuple[Path, ...] = ()
    """Motion files to choose from, .npz or .bvh."""
    wrinkles: Path | None = None
    """What `wrinkles train` wrote for the garment's template: shown when the pose rests."""
    exports: Path = Path("tryon")
    """Folder for what 'export this' writes: a work folder for each, 001, 002, ..."""
    config: Annotated[TryOnConfig, arg(name="")] = field(default_factory=TryOnConfig)

    def __call__(self) -> int:
        from capture4d.app.tryon.garments import open_garment
        from capture4d.app.tryon.session import Session
        from capture4d.errors import InputError
        from capture4d.files.optional_packages import VISER, require_package

        require_package(VISER)
        for path in self.poses:
            if not path.is_file():
                raise InputError("no such motion file", where=path)
        session = Session(open_garment(self.model), self.wrinkles)

        def add(server: Any) -> Any:
            from capture4d.app.tryon.page import TryOnPage

            return TryOnPage(server, session, self.poses, self.exports, self.config)

        return self.served(self.model.resolve().name, add)
