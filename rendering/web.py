"""A page for browsers, MuJoCo's web viewer. The browser draws, not this machine."""

import copy
import threading
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any, Final, get_args

import mujoco
from mujoco.studio import launch_thread, messages, plugin, viewer_protocol, web_viewer
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.web import web_server
from mujoco.studio.web.state_payload import MAX_EXTRA_GEOMS

from ..models.errors import InputError
from .live import Aim, Lines, Pace, Press
from .stage import Stage

_HOST: Final = "127.0.0.1"
_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")
"""Of this machine in a browser's address, and of the near end of an `ssh -L`."""
_KEYS: Final[tuple[tuple[Any, Press], ...]] = (
    (imgui.Key.Space, "pause"),
    (imgui.Key.RightArrow, "step"),
    (imgui.Key.Minus, "slower"),
    (imgui.Key.KeypadSubtract, "slower"),
    (imgui.Key.Equal, "faster"),
    (imgui.Key.KeypadAdd, "faster"),
)
_COLUMN: Final = 90.0  # Left edge of values, in pixels of the panel


def refusal(host: str | None, origin: str | None) -> str | None:
    """The reason to refuse a request, by its headers; None if it is accepted.

    A page of another site may open a WebSocket to this machine. `Host`, the address that was
    opened, or `Origin`, the page that asks, then has that site's name. Only browsers send `Origin`.
    """
    here = (host or "").lower()
    name, _, port = here.rpartition(":")
    if (name if port.isdecimal() else here) not in _NAMES:
        return f"Host: expected {', '.join(_NAMES)}, got {host!r:.80}"
    if origin is not None and origin.lower() != f"http://{here}":
        return f"Origin: expected the page of this viewer, got {origin!r:.80}"
    return None


_serve: Final[Callable[..., Any]] = web_server.serve


def _guarded(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
    """MuJoCo's server of the page, which takes every request, with `refusal` before it."""

    def checked(connection: Any, request: Any) -> Any:
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        reason = refusal(hosts[0] if len(hosts) == 1 else None, ", ".join(origins) or None)
        if reason is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
        return process_request(connection, request)

    return _serve(*args, process_request=checked, **options)


web_server.serve = _guarded


class WebPage:
    """A stage in browsers, served on this machine's loopback alone: `Surface`.

    Port 0 takes the first free one from 8080 on; one in use raises `InputError`.
    """

    def __init__(self, stage: Stage, pace: Pace, port: int) -> None:
        if not 0 <= port <= 65535:
            raise InputError(f"port: expected 0 to 65535, got {port}")
        self._stage = stage
        self._panel = _Panel(pace, Aim(stage))
        self._scene = mujoco.MjvScene(stage.model, MAX_EXTRA_GEOMS)
        config = viewer_protocol.ViewerConfig(title="rotorgram", gfx="web", http_port=port)

        def serve(endpoint: Any) -> None:
            viewer = _LoopbackViewer(config, endpoint, model=stage.model, plugins=[self._panel])
            viewer_protocol.run_viewer_loop(viewer)

        self._handle = launch_thread.launch_thread(serve)
        self._handle.model = stage.model
        self._handle.data = stage.data
        try:
            while not self._panel.started.wait(0.05):
                self._handle.is_running()  # raises what the other thread has raised
        except RuntimeError:  # its own sentence names an option that is not ours
            raise InputError(f"port: expected a free one, got {port}, which is in use") from None
        self.port = self._panel.viewer.address[1]
        self.where = (
            f"at http://{_HOST}:{self.port}/ (from another machine after "
            f"ssh -L {self.port}:{_HOST}:{self.port} THIS-MACHINE)"
        )

    def show(self, lines: Lines) -> None:
        """Draw the stage as it is now, with these lines over it."""
        self._scene.ngeom = 0
        self._stage.decorate(self._scene)
        geoms = [copy.copy(geom) for geom in self._scene.geoms[: self._scene.ngeom]]
        self._handle.sync()
        self._handle.send_to_viewer(_Look(lines=lines, geoms=geoms))

    def is_running(self) -> bool:
        """Whether the page is served."""
        return bool(self._handle.is_running())

    def is_watched(self) -> bool:
        """Whether a browser has opened it and has the pointer over it."""
        return self._panel.watched.is_set()

    def close(self) -> None:
        """Stop serving it."""
        self._handle.close()


class _LoopbackViewer(web_viewer.WebViewer):  # type: ignore[misc]
    """MuJoCo's viewer on the loopback; by itself it binds every interface of the machine."""

    _host = property(lambda _: _HOST, lambda _, everywhere: None)  # an attribute that it sets

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        host, port = self._http_sock.getsockname()[:2]
        return str(host), int(port)

    def _start_server(self) -> None:
        host, port = self.address
        if not ip_address(host).is_loopback:  # another version of MuJoCo
            self._http_sock.close()
            self._tcp_sock.close()
            raise OSError(f"the web viewer would serve {host} port {port} to every machine")
        super()._start_server()


@dataclass(frozen=True, kw_only=True)
class _Look(messages.Snapshot):  # type: ignore[misc]
    """The scene besides its poses."""

    lines: Lines
    geoms: list[mujoco.MjvGeom]


class _Panel(plugin.ViewerPlugin):  # type: ignore[misc]
    """The overlay, with buttons. Lives in the viewer's thread."""

    def __init__(self, pace: Pace, aim: Aim) -> None:
        self._pace = pace
        self._aim = aim
        self._lines: Lines = []
        self.started = threading.Event()
        self.watched = threading.Event()

    @messages.handler  # type: ignore[untyped-decorator]
    def _on_viewer_init(self, _: plugin.ViewerInitEvent) -> None:
        self.started.set()

    @messages.handler  # type: ignore[untyped-decorator]
    def _on_look(self, look: _Look) -> bool:
        self._lines = look.lines
        self.viewer.extra_geoms[:] = look.geoms
        self._aim.apply(self.viewer.camera)
        return True

    @messages.handler  # type: ignore[untyped-decorator]
    def _on_build_gui(self, _: messages.BuildGuiEvent) -> None:
        if imgui.IsMousePosValid():  # of a browser: frames are built without one, too
            self.watched.set()
        imgui.SetNextWindowPos(imgui.Vec2(12, 12), int(imgui.Cond.FirstUseEver))
        imgui.SetNextWindowBgAlpha(0.75)
        # Without navigation space presses no button that was pressed before.
        names = ("AlwaysAutoResize", "NoNav", "NoTitleBar")
        flags = sum(int(getattr(imgui.WindowFlags, name)) for name in names)
        imgui.Begin("rotorgram", None, flags)
        for name, value in self._lines:
            imgui.Text(name)
            imgui.SameLine(_COLUMN)
            imgui.Text(value)
        presses: tuple[Press, ...] = get_args(Press)[: 4 if self._pace.period else 2]
        for press in presses:
            if press != "pause":
                imgui.SameLine()
            label = "Go on" if press == "pause" and self._pace.paused else press.capitalize()
            if imgui.Button(label):
                self._pace.press(press)
        imgui.End()
        for key, press in _KEYS:
            if imgui.IsKeyPressed(key, False):
                self._pace.press(press)
