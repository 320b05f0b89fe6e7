"""MuJoCo's viewer in a browser, on loopback only.

MuJoCo 4.0's server is open to the network and to the pages of any site, as `_on_loopback` says, without a password.
Here it answers only requests with its own host name and port, which rules out DNS rebinding, and only pages of its own
origin. Before anything is shown, the server is tested. If it answers anywhere but on loopback, or admits a foreign
request, it is closed.
"""

import contextlib
import http
import http.client
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.studio import (
    app,
    launch_web,
    messages,
    plugin,
    sim,  # pyright: ignore[reportAttributeAccessIssue] it is made as the package is imported
    viewer_protocol,
    web_viewer,
)
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.web import web_server

from lqrsim.errors import InputError
from lqrsim.view.viewer import PUSHES, Viewer

TESTED_VERSION = "4.0."  # MuJoCo's versions whose server is known
LOOPBACK = "127.0.0.1"
HOST_NAMES = LOOPBACK, "localhost"  # names by which requests may address the server
# No other page may read, embed or frame its responses.
PRIVATE_HEADERS = {"Cross-Origin-Resource-Policy": "same-origin", "Content-Security-Policy": "frame-ancestors 'none'"}
SHARING_HEADER = "Access-Control-Allow-Origin"
START_TIMEOUT = 10.0  # s, for the server to start
# A message about a dragged goal contains the first but not the second; a message about an earlier state contains both.
MOCAP, TIME = mujoco.mjtState.mjSTATE_MOCAP_POS.value, mujoco.mjtState.mjSTATE_TIME.value
RELEASE_AFTER = 0.5  # s without a message, after which a drag counts as released


@dataclass(eq=False)
class _SceneUpdate(messages.Snapshot):
    """From the simulation to the viewer: overlays and caption."""

    geoms: list[mujoco.MjvGeom]
    caption: str


@dataclass(eq=False)
class _KeyPress(messages.Event):
    """From the viewer to the simulation: a key that pushes the robot or moves the goal."""

    key: str
    azimuth: float


class _ViewerSide(plugin.ViewerPlugin):
    studio: app.App

    def __init__(self, owner: Viewer, title: str) -> None:
        self.owner, self.title, self.started = owner, title, threading.Event()

    @messages.handler
    def on_app(self, event: app.InitEvent) -> None:
        self.studio = event.app
        self.started.set()

    @messages.handler
    def on_scene_update(self, event: _SceneUpdate) -> None:
        self.viewer.extra_geoms[:] = event.geoms
        self.studio.status = f"{self.title}: {'; '.join(event.caption.splitlines())}"

    @messages.handler(priority=0)  # after the viewer's own handler
    def on_model(self, event: messages.PostModelEvent) -> None:
        self.owner.aim_camera(self.viewer.camera)
        self.viewer.perturb.select = self.owner.robot
        self.studio.step_control_state.set_speed(100 * self.owner.speed)

    @messages.handler
    def on_update(self, event: messages.UpdateEvent) -> None:
        perturb = self.viewer.perturb
        perturb.select = self.owner.hold(perturb.select)
        if not imgui.GetIO().WantCaptureKeyboard:
            if imgui.IsKeyChordPressed(imgui.Key.Enter):
                perturb.select = self.owner.hold(self.owner.other())
            for key in PUSHES:
                if imgui.IsKeyChordPressed(getattr(imgui.Key, key)):
                    self.viewer.send_to_sim(_KeyPress(key, self.viewer.camera.azimuth))


class _SimulationSide(plugin.SimPlugin):
    """The plugin on the simulation's side: all input goes to the Browser, none to MuJoCo's own simulation."""

    def __init__(self, owner: Viewer) -> None:
        self.owner, self.last_drag, self.edited = owner, 0.0, mujoco.MjData(owner.model)

    @messages.handler(priority=messages.Priority.CRITICAL)
    def on_key_press(self, event: _KeyPress) -> None:
        self.owner.push(PUSHES[event.key], event.azimuth)

    @messages.handler(priority=messages.Priority.CRITICAL)
    def on_perturb(self, event: messages.PerturbSnapshot) -> bool:
        self.last_drag = time.monotonic()
        self.owner.drag(event.state)
        return True

    @messages.handler(priority=messages.Priority.CRITICAL)
    def on_reset(self, event: messages.ResetEvent) -> bool:
        self.owner.request_restart()
        return True

    @messages.handler(priority=messages.Priority.CRITICAL)
    def on_control(self, event: messages.StepControlSnapshot) -> bool:
        self.owner.paused = event.pause_state != sim.PauseState.UNPAUSED
        self.owner.speed = max(event.speed / 100, 0.001)
        return True

    @messages.handler(priority=messages.Priority.CRITICAL)
    def on_edit(self, event: messages.StateEvent) -> bool:
        owner, model, kinds = self.owner, self.owner.model, event.state_sig
        is_drag = kinds & MOCAP and not kinds & TIME and event.state.size == mujoco.mj_stateSize(model, kinds)
        if owner.goal_body and is_drag:
            mujoco.mj_setState(model, self.edited, event.state, kinds)
            owner.move_goal(owner.space.of_world(self.edited.mocap_pos[model.body_mocapid[owner.goal_body]]))
        return True  # the rest of the state belongs to the simulation

    @messages.handler(priority=messages.Priority.CRITICAL)
    def on_load(self, event: messages.LoadModelEvent) -> bool:
        return True  # and so does the model

    @messages.handler
    def on_step(self, event: messages.StepEvent) -> None:
        if time.monotonic() - self.last_drag > RELEASE_AFTER:
            self.owner.drag(np.zeros(6))


class Browser(Viewer):
    """A viewer in a browser, to be used with `with`: its server runs as long as the block.

    There can be only one in a process: MuJoCo's user interface is global, and a second viewer may crash. Raises
    InputError if the port is taken, MuJoCo's version is not a tested one, or other machines can reach the server.

    Args:
      port: of the server; 0 takes the first free port from 8080 on. The other arguments but `title` are a Viewer's.
    """

    def __init__(self, *arguments: Any, port: int = 0, title: str = "", **options: Any) -> None:
        super().__init__(*arguments, **options)
        if not mujoco.__version__.startswith(TESTED_VERSION):
            known = f"{TESTED_VERSION}x, whose server can be kept to this machine"
            raise InputError(f"browser: got MuJoCo {mujoco.__version__}, want {known}; or a display, for a window")
        viewer_side = _ViewerSide(self, title)
        config = viewer_protocol.ViewerConfig(title=title, gfx="web", http_port=port)
        layout = app.Config(show_inspector=False)
        sockets: list[socket.socket] = []
        with _on_loopback(sockets):
            self._handle = launch_web.launch(config, plugins=[app.App(layout), viewer_side, _SimulationSide(self)])
            try:
                while not viewer_side.started.wait(0.02):
                    self._handle.is_running()  # re-raises an exception of the viewer's thread
                self.port = sockets[0].getsockname()[1] if sockets else port
                _check_private(self.port)
            except RuntimeError as error:
                raise InputError(f"--port: {error}") from None
            except BaseException:
                self._handle.close()
                raise
        self._handle.set_model(self.model, data=self.data)
        self.instructions = (
            f"Open http://localhost:{self.port}/ in a browser on this machine. From another one, run there first:\n"
            f"  ssh -L {self.port}:{LOOPBACK}:{self.port} THIS-MACHINE\n"
            "No other machine can reach it; other users of this one can. Ctrl-C ends it."
        )

    def __exit__(self, *_: object) -> None:
        self._handle.close()

    def refresh(self) -> bool:
        if self._handle.is_running():
            self._handle.sync()
        return self._handle.is_running()

    def show(self, time: float, qpos: np.ndarray) -> np.ndarray:
        place = super().show(time, qpos)
        geoms = [shape.set(mujoco.MjvGeom()) for shape in self.overlay_shapes()]
        self._handle.send_to_viewer(_SceneUpdate(geoms, self.caption))
        return place


@contextlib.contextmanager
def _on_loopback(sockets: list[socket.socket]) -> Iterator[None]:
    """A block in which MuJoCo's server starts on loopback only, refuses uploads, and admits only its own pages.

    Three functions of MuJoCo are replaced in it, as there are no options. Without that, 4.0.0 does this:

    - `web_server.bind_public_socket`: the viewer passes `::` to it, and the server answers at 127.0.0.2, at ::1 and at
      the machine's addresses in the network.
    - `web_server.serve`, whose handlers are wrapped: a page of another site can open the WebSockets /state and /drop,
      which takes models; a request with another host name gets the model; and any page may read the answer
      (Access-Control-Allow-Origin).
    - `web_viewer._print_url_banner`: it prints an address in the network, where nothing answers, and warns of others.
    """
    bind, serve, banner = web_server.bind_public_socket, web_server.serve, web_viewer._print_url_banner

    def bind_private(host: str, port: int = 0) -> socket.socket:
        sockets.append(bind(LOOPBACK, port))
        return sockets[-1]

    def serve_few(
        handler: Callable[..., Any],
        *,
        process_request: Callable[..., Any],
        process_response: Callable[..., Any],
        **options: Any,
    ) -> Any:
        def admit(connection: Any, request: Any) -> Any:
            why = _refusal(request, sockets[-1].getsockname()[1])
            if why:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{why}\n")
            return process_request(connection, request)

        def answer(connection: Any, request: Any, response: Any) -> Any:
            response = process_response(connection, request, response) or response
            for name in (SHARING_HEADER, *PRIVATE_HEADERS):
                if name in response.headers:
                    del response.headers[name]
            response.headers.update(PRIVATE_HEADERS)
            return response

        return serve(handler, process_request=admit, process_response=answer, **options)

    web_server.bind_public_socket, web_server.serve = bind_private, serve_few
    web_viewer._print_url_banner = lambda host, port: None
    try:
        yield
    finally:
        web_server.bind_public_socket, web_server.serve = bind, serve
        web_viewer._print_url_banner = banner


def _refusal(request: Any, port: int) -> str:
    """The reason for which a request is refused; empty if it is admitted."""
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    ours = [f"{name}:{port}" for name in HOST_NAMES] + (list(HOST_NAMES) if port == 80 else [])
    if len(hosts) != 1 or hosts[0] not in ours:
        return f"the host of this server is {' or '.join(ours)}"
    if origins and origins != [f"http://{hosts[0]}"]:
        return "only pages of this server are admitted"
    return "uploads are refused" if request.path.split("?")[0] == "/drop" else ""


def _check_private(port: int) -> None:
    """Raises InputError unless the server answers on loopback only, and refuses foreign requests."""
    until = time.monotonic() + START_TIMEOUT
    while not _listens(LOOPBACK, port):  # the server starts on another thread
        if time.monotonic() > until:
            raise InputError(f"browser: the server does not answer at {LOOPBACK}:{port} after {START_TIMEOUT:g} s")
        time.sleep(0.02)
    for address in _other_addresses():
        if _listens(address, port):
            raise InputError(f"browser: others can reach the server at {address}, port {port}; it was closed")
    here = f"{LOOPBACK}:{port}"
    for path, host, origin in (
        ("/drop", here, f"http://{here}"),
        ("/state", here, "http://example.org"),
        ("/ui", here, f"http://{LOOPBACK}:{port % 65535 + 1}"),
        ("/", f"example.org:{port}", None),
        ("/model", f"example.org:{port}", None),
    ):
        if _request(path, host, origin, port)[0] != http.HTTPStatus.FORBIDDEN:
            who = origin or f"http://{host}"
            raise InputError(f"browser: the server admits {who} to {path}, port {port}; it was closed")
    for path in ("/", "/model"):
        if _request(path, here, None, port)[1]:
            raise InputError(f"browser: the server lets any page read {path}, port {port}; it was closed")


def _other_addresses() -> list[str]:
    """Addresses of this machine at which a server on all interfaces answers, and ours must not."""
    addresses = {"127.0.0.2", "::1"}  # a server on all interfaces answers there; a server on 127.0.0.1 does not
    with contextlib.suppress(OSError):
        addresses |= {str(entry[4][0]) for entry in socket.getaddrinfo(socket.gethostname(), None)}
    for family, elsewhere in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((elsewhere, 9))  # sends nothing, but selects the address that would be used
            addresses.add(probe.getsockname()[0])
    return sorted(addresses - {LOOPBACK})


def _request(path: str, host: str, origin: str | None, port: int) -> tuple[int, bool]:
    """Status of the answer, and whether other pages may read it. With an origin, a WebSocket is opened."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=START_TIMEOUT)
    with contextlib.closing(connection):
        headers = {"Host": host}
        if origin is not None:
            key = {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="}
            headers |= {"Connection": "Upgrade", "Upgrade": "websocket", "Origin": origin, **key}
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.getheader(SHARING_HEADER) is not None


def _listens(address: str, port: int) -> bool:
    try:
        socket.create_connection((address, port), timeout=1.0).close()
    except OSError:
        return False
    return True
